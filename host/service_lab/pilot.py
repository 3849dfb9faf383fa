"""Operator, planner and onlooker in one: arms the machine, swings the crane slowly, and writes down what the bus shows.

Runs at real-time priority between controller and plant, looks every 2 ms, and keeps the longest time it did not look:
the guest as a whole, or this process, stood still for so long, and what happened then proves nothing.
"""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from can_dbc.bus.factory import open_bus
from can_dbc.bus.reconnector import LostLink
from can_dbc.dbc import codec
from can_dbc.frame import Frame
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.profile import joint

LOOK_S: Final = 0.002
LEASE_NS: Final = 400_000_000
PERIOD_NS: Final = 50_000_000
SPEED_RAD_S: Final = 0.15
RISE_S: Final = 1.0
SPOOLS: Final = ("SpoolSlew", "SpoolLift", "SpoolTilt", "SpoolExt")


class Valve(NamedTuple):
    """One ValveFbA: when, the node's state, the largest opening in percent."""

    stamp_ns: int
    state: int
    opening_pct: float


class Pilot:
    """`until` turns the wheel; everything seen since `forget` is in ``valves``, ``modes`` and ``gap``."""

    def __init__(self, profile_name: str, setpoint_port: int, report_port: int, bus_address: str) -> None:
        profile = load_profile(profile_name)
        self.deadband_pct = min(
            min(joint(profile, j).valve.deadband_plus_pct, joint(profile, j).valve.deadband_minus_pct)
            for j in JOINTS[: len(SPOOLS)]
        )
        self._hash = profile_hash(profile)
        self._feedback, self._command, self._arm, self._guard = messages = [
            codec.load("crane").message(name) for name in ("ValveFbA", "ValveCmdA", "ValveCmdB", "GuardStat")
        ]
        self._bus = open_bus(bus_address, filters=[m.key for m in messages])
        self._link_watch = LostLink(self._bus)
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind(("127.0.0.1", report_port))
        self._link.setblocking(False)
        self._controller = ("127.0.0.1", setpoint_port)
        self._numbers = itertools.count(1)
        self._begin: tuple[int, tuple[float, ...]] | None = None
        self._sign = 1.0
        self._next_ns = 0
        self.report: StateReport | None = None
        self.forget()

    def forget(self) -> None:
        """Begin a new page.  ``farewell_ns`` is when the arm key was withdrawn, and in which mode; ``guarded_ns`` is
        when the guard last said something.
        """
        self.valves: list[Valve] = []
        self.modes: set[Mode] = set()
        self.commands = 0
        self.armed_after_ns = self.farewell_ns = self.guarded_ns = 0
        self.mode_at_farewell = Mode.BOOT
        self.gaps: list[tuple[int, int]] = []
        self._looked_ns = time.monotonic_ns()

    def press(self, action: OperatorAction) -> None:
        """What a human's button does."""
        now_ns = time.monotonic_ns()
        self._send(encode(OperatorCommand(next(self._numbers), self._hash, now_ns, action)))

    def swing(self) -> None:
        """Begin to turn the crane slowly from where it stands towards the far side."""
        assert self.report
        self._begin = (time.monotonic_ns(), self.report.reference)
        self._sign = -1.0 if self.report.position[0] > 0.0 else 1.0

    def rest(self) -> None:
        """Send no more setpoints."""
        self._begin = None

    def until(self, reached: Callable[[], object], seconds: float) -> bool:
        """Turn until ``reached`` answers true; False when the time is over."""
        limit_s = time.monotonic() + seconds
        while not reached():
            if time.monotonic() > limit_s:
                return False
            self._turn()
            time.sleep(LOOK_S)
        return True

    def opening_pct(self) -> float:
        """The largest opening now."""
        return self.valves[-1].opening_pct if self.valves else 0.0

    def stood_still_ms(self, begin_ns: int, end_ns: int) -> float:
        """The longest time without a look that touches the window."""
        return max((b - a for a, b in self.gaps if b >= begin_ns and a <= end_ns), default=0) * 1e-6

    def _turn(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns > 10_000_000:
            self.gaps.append((self._looked_ns, now_ns))
        self._looked_ns = now_ns
        frames: list[Frame] = []
        self._bus.drain(frames)
        for frame in frames:
            self._see(frame)
        self._link_watch.watch(now_ns)
        while True:
            try:
                message = decode(self._link.recv(2048))
            except BlockingIOError:
                break
            except (DatagramRefused, ConnectionRefusedError):
                continue
            if isinstance(message, StateReport):
                self.report = message
                self.modes.add(Mode(message.mode))
        if self._begin and now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            self._send(encode(self._setpoint(now_ns, *self._begin)))

    def _see(self, frame: Frame) -> None:
        if frame.key == self._feedback.key:
            values = self._feedback.named(self._feedback.decode(frame.data))
            opening = max(abs(values[name]) for name in SPOOLS)
            self.valves.append(Valve(frame.stamp_ns, int(values["State"]), opening))
        elif frame.key == self._command.key:
            self.commands += 1
        elif frame.key == self._guard.key:
            self.guarded_ns = frame.stamp_ns
        elif self._arm.named(self._arm.decode(frame.data))["ArmKey"]:
            self.armed_after_ns, self.farewell_ns = frame.stamp_ns, 0
        elif not self.farewell_ns:
            self.farewell_ns = frame.stamp_ns
            self.mode_at_farewell = Mode(self.report.mode) if self.report else Mode.BOOT

    def _setpoint(self, now_ns: int, begin_ns: int, origin: tuple[float, ...]) -> CraneSetpoint:
        knots = []
        for after_ns in range(0, 500_000_000, 100_000_000):
            t = (now_ns - begin_ns + after_ns) * 1e-9
            rising = min(t, RISE_S)
            way = SPEED_RAD_S * (rising * rising / (2.0 * RISE_S) + t - rising)
            position = (origin[0] + self._sign * way, *origin[1:])
            velocity = (self._sign * SPEED_RAD_S * rising / RISE_S, *[0.0] * (len(origin) - 1))
            knots.append(Knot(after_ns, position, velocity))
        return CraneSetpoint(
            next(self._numbers), self._hash, now_ns, LEASE_NS, GrappleCommand.NEUTRAL, False, tuple(knots)
        )

    def _send(self, data: bytes) -> None:
        self._link.sendto(data, self._controller)
