"""mach0 of a machine with a carrier, as one part of the controller: what it brings, what is said on it, how it is.

On a machine that stands still there is none.  The carrier stands with its brake on until `controller.carrier.vehicle` puts a
command of its laws in the place of ``STANDING``.
"""

from __future__ import annotations

from can_dbc.canopen import Wire
from can_dbc.codec import Database, DbcError, load
from can_dbc.frame import Frame
from can_dbc.tick_record import BusReading
from controller.bus_watch import BusWatch
from controller.carrier.inputs import MachineReceived
from controller.carrier.outputs import STANDING, MachineWriter
from controller.config import ConfigError
from machine.modes import Mode
from machine.reasons import Reason


class MachineBus:
    """``received``, ``watch`` and ``command`` of mach0; raises ConfigError."""

    __slots__ = ("_writer", "command", "received", "watch")

    def __init__(self, databases: tuple[Database, Database] | None = None) -> None:
        """``databases``, machine and gnss, are read when they are not given."""
        try:
            machine, gnss = databases or (load("machine"), load("gnss"))
        except DbcError as error:
            raise ConfigError(str(error)) from error
        self.received = MachineReceived(machine, gnss)
        self.watch = BusWatch(1)
        self.command = STANDING
        self._writer = MachineWriter(machine, self.received.address)

    def read(self, frames: list[Frame], reading: BusReading, sent: bool, now_ns: int) -> None:
        """A tick's frames and reading; ``sent``: there was something to send in the tick before."""
        self.watch.read(reading, sent, now_ns)
        if self.watch.recovered:
            self.received.forget()
        self.received.read([] if self.watch.lost else frames, now_ns)

    def write(self, mode: Mode, reason: Reason, half_speed: bool, now_ns: int, frames: list[Wire]) -> None:
        """What is to be sent in this tick, into the emptied ``frames``."""
        frames.clear()
        self._writer.write(self.command, mode, reason, half_speed, now_ns, frames)

    def farewell(self) -> list[Wire]:
        """The last frames of a process that ends: brake on, arms held, and an alive sign that says so."""
        frames: list[Wire] = []
        if not self.received.address.lost:
            self._writer.commands(STANDING, frames)
            frames.append(self._writer.alive(Mode.BOOT, Reason.CONTROLLER_ENDED, False))
        return frames
