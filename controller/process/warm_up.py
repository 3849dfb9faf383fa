"""Warm-up before the first tick: every code path runs once on a controller that is then discarded.

CPython specializes code that has run, the allocator grows, and pages are touched at the first use; all of this must
happen before the first deadline and before garbage collection is switched off.  The loop of the warm-up has a bus
without a network and its own clock; its inputs (all messages of the DBC at zero, an armed machine, a held pose, invalid
data) have no meaning.
"""

from __future__ import annotations

import itertools
import socket
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from can_dbc.bus.base import BaseBus
from can_dbc.dbc.codec import MessageCodec
from can_dbc.frame import Frame, RawFrame
from can_dbc.messages import operator_link
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import Datagram, encode
from can_dbc.messages.record_ring import RecordRing
from can_dbc.messages.vehicle import DriveSetpoint, Steering
from can_dbc.protocols.e2e import Sender
from can_dbc.protocols.nmea2000 import fast_packet
from controller.config import Settings
from controller.process.loop import Loop
from controller.process.operator_socket import OperatorSocket
from controller.process.timing import LoopTiming
from controller.step import Controller
from machine.joints import JOINTS
from machine.profile import joint
from machine.status.modes import Mode

TICKS: Final = 400
VALUES: Final = {"GnssPositionData": {"Method": 4}, "EncArtic": {"Position": 8192}}
"""Values that are not zero, because a drive setpoint needs them: an RTK fix, and a straight carrier."""
_LEASE_NS: Final = 100_000_000
_MEMORY: Final = Path("/dev/shm")  # only mkdtemp makes names in it  # nosec B108


class NullBus(BaseBus):
    """Delivers the frames in ``waiting`` and accepts every frame sent."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.waiting: list[Frame] = []

    def fileno(self) -> int:
        return -1

    def drain(self, frames: list[Frame]) -> int:
        count = len(self.waiting)
        frames += self.waiting
        self.waiting.clear()
        return count

    def send(self, key: int, data: bytes) -> bool:
        return True

    def send_all(self, frames: Sequence[RawFrame]) -> int:
        return len(frames)

    def flush(self) -> None:
        self.waiting.clear()

    def reopen(self) -> bool:
        return True


class _MessageSource:
    """One message at zero, or as near to it as its range allows; its time stamp changes."""

    def __init__(self, codec: MessageCodec) -> None:
        signal_values = VALUES.get(codec.name, {})
        self._values = [_nearest(signal_values.get(s.name, 0), s.minimum, s.maximum) for s in codec.signals]
        self._codec, self._alive = codec, codec.index.get("TimeStamp", -1)
        self._sender = Sender(codec.data_ids) if codec.data_ids else None
        self._count = 0

    def frames(self, now_ns: int) -> list[Frame]:
        """Encode the message at ``now_ns``; a long message is a fast packet of several frames."""
        self._count += 1
        if self._alive >= 0:
            self._values[self._alive] = self._count
        key, data = self._codec.key, self._codec.encode(*self._values)
        if len(data) > 8:
            return [Frame(now_ns, key, part) for part in fast_packet(data, self._count % 8)]
        return [Frame(now_ns, key, self._sender.protect(data) if self._sender else data)]


def _nearest(value: float, least: float | None, most: float | None) -> float:
    if least is not None and value < least:
        return least
    return most if most is not None and value > most else value


def warm_up(settings: Settings, controller: Controller, key: bytes | None = None) -> None:
    """Run every code path of ``controller``, which must not be used afterwards; ``key`` as for `Loop`."""
    crane, machine = NullBus("crane"), NullBus("machine")
    buses = [crane, machine] if controller.carrier_bus else [crane]
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner,
        tempfile.TemporaryDirectory(dir=_MEMORY if _MEMORY.is_dir() else None) as folder,
    ):
        receiver.bind(("127.0.0.1", 0))
        planner.bind(("127.0.0.1", 0))
        planner.setblocking(False)
        clock = itertools.count(1_000_000_000, 1_000)
        address = receiver.getsockname()
        operator = Path(folder, "operator")
        loop = Loop(
            controller,
            buses,
            planner,
            OperatorSocket(operator),
            [address],
            RecordRing(Path(folder, "ticks")),
            LoopTiming(controller),
            settings.period_ns,
            settings.sync_lead_ns,
            clock.__next__,
            lambda _deadline_ns: None,
            notify="",
            key=key,
        )
        _run_ticks(loop, settings, crane, machine, planner.getsockname(), operator, key)
        loop.shut_down()
        loop.close()


def _run_ticks(
    loop: Loop,
    settings: Settings,
    crane: NullBus,
    machine: NullBus,
    planner: tuple[str, int],
    operator: Path,
    key: bytes | None,
) -> None:
    controller, period_ns = loop.controller, settings.period_ns
    sources = [
        (machine if state.machine else crane, _MessageSource(state.codec)) for _, state in controller.inputs_in_use
    ]
    middle = tuple((joint(settings.profile, j).lower + joint(settings.profile, j).upper) / 2 for j in JOINTS)
    still = (0.0,) * len(JOINTS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(TICKS):
            now_ns = 1_000_000_000 + k * period_ns
            for bus, source in sources:
                bus.waiting += source.frames(now_ns)
            stamp = (k + 1, settings.profile_hash, now_ns)
            messages: list[Datagram]
            if k % 4 == 0:
                controller.supervisor.mode = Mode.ACTIVE if k > TICKS // 2 else Mode.ARMED
                knots = (Knot(0, middle, still), Knot(2 * period_ns, middle, still))
                crane_setpoint = CraneSetpoint(*stamp, _LEASE_NS, GrappleCommand(k // 4 % 3), False, knots)
                drive = DriveSetpoint(
                    *stamp,
                    _LEASE_NS,
                    Steering(k // 8 % 2),
                    1e-4,
                    1e-4,
                    0.1,
                    0.01,
                    0.2,
                    (0.35,) * 4,
                    k % 3 == 0,
                    False,
                    k % 16 == 0,
                )
                messages = [crane_setpoint, drive] if k % 8 == 0 else []
            else:
                messages = []
                pressed = OperatorCommand(*stamp, tuple(OperatorAction)[k % len(OperatorAction)])
                operator_link.send(encode(pressed), operator)
            for message in messages:
                sender.sendto(encode(message, key), planner)
            sender.sendto(b"invalid", planner)
            loop.tick(now_ns, 0)
            _run_laws(controller, crane_setpoint, drive, period_ns, now_ns)


def _run_laws(
    controller: Controller, crane_setpoint: CraneSetpoint, drive: DriveSetpoint, period_ns: int, now_ns: int
) -> None:
    """Run the laws as in a motion; inputs at zero stop the machine before the tick reaches them."""
    crane, vehicle = controller.crane, controller.vehicle
    crane.governor.candidate.load(crane_setpoint)
    crane.governor.accept(now_ns, False)
    crane.leased = True
    crane.update_reference(True, 1.0, now_ns)
    crane.control(True, 1.0, False, 1.0, now_ns, period_ns)
    if vehicle is not None:
        vehicle.setpoint = drive
        vehicle.control(True, False, 1.0, now_ns)
        vehicle.check(True, now_ns)
        vehicle.control(False, True, 1.0, now_ns)
