"""A dress rehearsal before the first tick: every path is walked once on a controller that is then thrown away.

CPython specialises code that has run, the allocator grows and pages are touched at the first use; all of that belongs
before the first deadline, and before garbage collection is switched off.  The scratch loop has a bus that goes nowhere
and an own clock; what it is fed (all inputs of the DBC at zero, an armed machine, a held pose, nonsense) means nothing.
"""

from __future__ import annotations

import itertools
import socket
from collections.abc import Sequence
from typing import Final

from can_dbc.bus import BaseBus
from can_dbc.canopen import Wire
from can_dbc.codec import MessageCodec
from can_dbc.e2e import Sender
from can_dbc.frame import Frame
from can_dbc.nmea2000 import fast_packet
from can_dbc.setpoint import CraneSetpoint, Datagram, GrappleCommand, Knot, OperatorAction, OperatorCommand, encode
from can_dbc.vehicle_datagrams import DriveSetpoint, Steering
from controller.config import Settings
from controller.loop import Loop
from controller.step import Controller
from controller.timing import LoopTiming
from machine.joints import JOINTS
from machine.modes import Mode
from machine.profile import joint

TICKS: Final = 400
VALUES: Final = {"GnssPositionData": {"Method": 4}, "EncArtic": {"Position": 8192}}
"""What is not at zero, or no drive setpoint would be obeyed: a fix, and a carrier that is straight."""
_LEASE_NS: Final = 100_000_000


class NowhereBus(BaseBus):
    """Hands out the frames it is given and takes every frame."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.waiting: list[Frame] = []

    def fileno(self) -> int:
        return -1

    def drain(self, frames: list[Frame]) -> int:
        taken = len(self.waiting)
        frames += self.waiting
        self.waiting.clear()
        return taken

    def send(self, key: int, data: bytes) -> bool:
        return True

    def send_all(self, frames: Sequence[Wire]) -> int:
        return len(frames)

    def flush(self) -> None:
        self.waiting.clear()

    def reopen(self) -> bool:
        return True


class _Talker:
    """One message at zero, or as near to it as its range allows; a time stamp moves."""

    def __init__(self, codec: MessageCodec) -> None:
        wanted = VALUES.get(codec.name, {})
        self._values = [_nearest(wanted.get(s.name, 0), s.minimum, s.maximum) for s in codec.signals]
        self._codec, self._alive = codec, codec.index.get("TimeStamp", -1)
        self._sender = Sender(codec.data_ids) if codec.data_ids else None
        self._count = 0

    def frames(self, now_ns: int) -> list[Frame]:
        """The message at ``now_ns``; a long one comes as the frames of a fast packet."""
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


def rehearse(settings: Settings, controller: Controller) -> None:
    """Walks through every path with ``controller``, which must not be used afterwards."""
    crane, machine = NowhereBus("crane"), NowhereBus("machine")
    buses = [crane, machine] if controller.carrier.bus else [crane]
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner,
    ):
        heard.bind(("127.0.0.1", 0))
        planner.bind(("127.0.0.1", 0))
        planner.setblocking(False)
        clock = itertools.count(1_000_000_000, 1_000)
        address = heard.getsockname()
        loop = Loop(
            controller, buses, planner, [address], address, LoopTiming(controller), settings.period_ns,
            settings.sync_lead_ns, clock.__next__, lambda _deadline_ns: None, notify="",
        )  # fmt: skip
        _play(loop, settings, crane, machine, planner.getsockname())
        loop.leave()
        loop.close()


def _play(loop: Loop, settings: Settings, crane: NowhereBus, machine: NowhereBus, planner: tuple[str, int]) -> None:
    controller, period_ns = loop.controller, settings.period_ns
    talkers = [(machine if slot.machine else crane, _Talker(slot.codec)) for _, slot in controller.inputs_in_use]
    middle = tuple((joint(settings.profile, j).lower + joint(settings.profile, j).upper) / 2 for j in JOINTS)
    still = (0.0,) * len(JOINTS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(TICKS):
            now_ns = 1_000_000_000 + k * period_ns
            for bus, talker in talkers:
                bus.waiting += talker.frames(now_ns)
            stamp = (k + 1, settings.profile_hash, now_ns)
            said: list[Datagram]
            if k % 4 == 0:
                controller.supervisor.mode = Mode.ACTIVE if k > TICKS // 2 else Mode.ARMED
                knots = (Knot(0, middle, still), Knot(2 * period_ns, middle, still))
                crane_work = CraneSetpoint(*stamp, _LEASE_NS, GrappleCommand(k // 4 % 3), False, knots)
                drive = DriveSetpoint(
                    *stamp, _LEASE_NS, Steering(k // 8 % 2), 1e-4, 1e-4, 0.1, 0.01, 0.2, (0.35,) * 4, k % 3 == 0,
                    False, k % 16 == 0,
                )  # fmt: skip
                said = [crane_work, drive] if k % 8 == 0 else []
            else:
                said = [OperatorCommand(*stamp, tuple(OperatorAction)[k % len(OperatorAction)])]
            for message in said:
                sender.sendto(encode(message, settings.key), planner)
            sender.sendto(b"nonsense", planner)
            loop.tick(now_ns, 0)
            _work(controller, crane_work, drive, period_ns, now_ns)


def _work(controller: Controller, crane_work: CraneSetpoint, drive: DriveSetpoint, period_ns: int, now_ns: int) -> None:
    """The laws as in a motion: inputs at zero stop the machine before they would get their turn."""
    crane, vehicle = controller.crane, controller.carrier.vehicle
    crane.follower.candidate.load(crane_work)
    crane.follower.take(now_ns, False)
    crane.leased = True
    crane.refer(True, 1.0, now_ns)
    crane.control(True, 1.0, False, 1.0, now_ns, period_ns)
    if vehicle is not None:
        vehicle.setpoint = drive
        vehicle.control(True, False, 1.0, now_ns)
        vehicle.judge(True, now_ns)
        vehicle.control(False, True, 1.0, now_ns)
