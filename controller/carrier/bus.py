"""mach0 of a machine with a carrier: its inputs, its monitor and the frames that are sent on it.

A machine on a fixed base has none.  ``command`` is `STANDING` (brake on) until `controller.carrier.vehicle` replaces it
by a command of its laws.
"""

from __future__ import annotations

from can_dbc.dbc.codec import Database, load
from can_dbc.frame import Frame, RawFrame
from can_dbc.messages.tick_record import BusReading
from controller.bus_io import BusMonitor
from controller.carrier.inputs import CarrierInputs
from controller.carrier.outputs import STANDING, CarrierWriter
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import ConfigError


class CarrierBus:
    """``inputs``, ``monitor`` and ``command`` of mach0."""

    __slots__ = ("_writer", "command", "inputs", "monitor")

    def __init__(self, databases: tuple[Database, Database] | None = None) -> None:
        """``databases`` (machine and gnss) are loaded when they are not given.

        Raises:
            ConfigError: a database cannot be loaded.
        """
        try:
            machine, gnss = databases or (load("machine"), load("gnss"))
        except ConfigError as error:
            raise ConfigError(error.code, str(error)) from error
        self.inputs = CarrierInputs(machine, gnss)
        self.monitor = BusMonitor(1)
        self.command = STANDING
        self._writer = CarrierWriter(machine, self.inputs.address)

    def decode(self, frames: list[Frame], reading: BusReading, sent: bool, now_ns: int) -> None:
        """Decode the frames of a tick; ``sent``: the previous tick had frames to send."""
        self.monitor.update(reading, sent, now_ns)
        if self.monitor.recovered:
            self.inputs.forget()
        self.inputs.decode([] if self.monitor.frames_lost else frames, now_ns)

    def encode(self, mode: Mode, reason: Reason, half_speed: bool, now_ns: int, frames: list[RawFrame]) -> None:
        """Replace ``frames`` by the frames of this tick."""
        frames.clear()
        self._writer.encode(self.command, mode, reason, half_speed, now_ns, frames)

    def shutdown_frames(self) -> list[RawFrame]:
        """The last frames before the process ends: brake on, arms held, and an alive sign with the reason."""
        frames: list[RawFrame] = []
        if not self.inputs.address.lost:
            self._writer.commands(STANDING, frames)
            frames.append(self._writer.alive(Mode.BOOT, Reason.CONTROLLER_ENDED, False))
        return frames
