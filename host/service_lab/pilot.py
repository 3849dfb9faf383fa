"""Operator, planner and bus observer in one: arms the machine, slews the crane slowly, and records the bus.

Runs at real-time priority between controller and plant, and polls every 2 ms.
"""

from __future__ import annotations

import contextlib
import itertools
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from can_dbc.bus.factory import open_bus
from can_dbc.bus.reconnector import Reconnector
from can_dbc.dbc import codec
from can_dbc.frame import Frame
from can_dbc.messages import operator_link
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile, profile_check, profile_hash
from machine.profile import joint
from machine.status.modes import Mode

POLL_S: Final = 0.002
LEASE_NS: Final = 200_000_000
PERIOD_NS: Final = 50_000_000
SPEED_RAD_S: Final = 0.15
RISE_S: Final = 1.0
SPOOLS: Final = ("SpoolSlew", "SpoolLift", "SpoolTilt", "SpoolExt")


class Valve(NamedTuple):
    """One ValveFbA frame: time, state of the node, largest opening in percent."""

    stamp_ns: int
    state: int
    opening_pct: float


class Pilot:
    """`until` runs the loop; ``valves`` and ``modes`` hold the observations since `clear`."""

    def __init__(
        self,
        profile_name: str,
        setpoint_port: int,
        operator: Path,
        report_port: int,
        bus_address: str,
        key: bytes | None = None,
    ) -> None:
        profile = load_profile(profile_name)
        self.deadband_pct = min(
            min(joint(profile, j).valve.deadband_plus_pct, joint(profile, j).valve.deadband_minus_pct)
            for j in JOINTS[: len(SPOOLS)]
        )
        self._hash, self._check, self._key = profile_hash(profile), profile_check(profile_name), key
        self._feedback, self._command, self._arm, self._guard = messages = [
            codec.load("crane").message(name) for name in ("ValveFbA", "ValveCmdA", "ValveCmdB", "GuardStat")
        ]
        self._bus = open_bus(bus_address, filters=[m.key for m in messages])
        self._link_watch = Reconnector(self._bus)
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind(("127.0.0.1", report_port))
        self._link.setblocking(False)
        self._controller, self._operator = ("127.0.0.1", setpoint_port), operator
        self._numbers = itertools.count(1)
        self._begin: tuple[int, tuple[float, ...]] | None = None
        self._sign = 1.0
        self._next_ns = 0
        self.report: StateReport | None = None
        self.clear()

    def clear(self) -> None:
        """Clear the observations.  ``disarmed_ns`` is the time at which the arm key was withdrawn; ``guarded_ns`` is
        the time of the guard's last message.
        """
        self.valves: list[Valve] = []
        self.modes: set[Mode] = set()
        self.commands = 0
        self.armed_after_ns = self.disarmed_ns = self.guarded_ns = 0
        self.mode_when_disarmed = Mode.BOOT

    def press(self, action: OperatorAction) -> None:
        """Press a button of the operator."""
        now_ns = time.monotonic_ns()
        with contextlib.suppress(OSError):  # no controller now
            command = OperatorCommand(next(self._numbers), self._hash, now_ns, action, self._check)
            operator_link.send(encode(command), self._operator)

    def swing(self) -> None:
        """Start to slew the crane slowly from its present position towards the far side."""
        assert self.report
        self._begin = (time.monotonic_ns(), self.report.reference)
        self._sign = -1.0 if self.report.position[0] > 0.0 else 1.0

    def rest(self) -> None:
        """Stop sending setpoints."""
        self._begin = None

    def until(self, reached: Callable[[], object], seconds: float) -> bool:
        """Run until ``reached`` is true; False after ``seconds``."""
        limit_s = time.monotonic() + seconds
        while not reached():
            if time.monotonic() > limit_s:
                return False
            self._poll()
            time.sleep(POLL_S)
        return True

    def opening_pct(self) -> float:
        """Return the largest opening now [%]."""
        return self.valves[-1].opening_pct if self.valves else 0.0

    def _poll(self) -> None:
        now_ns = time.monotonic_ns()
        frames: list[Frame] = []
        self._bus.drain(frames)
        for frame in frames:
            self._observe(frame)
        self._link_watch.watch(now_ns)
        while True:
            try:
                message = decode(self._link.recv(2048), self._key)
            except BlockingIOError:
                break
            except (DatagramRefused, ConnectionRefusedError):
                continue
            if isinstance(message, StateReport):
                self.report = message
                self.modes.add(Mode(message.mode))
        if self._begin and now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            self._send(encode(self._setpoint(now_ns, *self._begin), self._key))

    def _observe(self, frame: Frame) -> None:
        if frame.key == self._feedback.key:
            values = self._feedback.named(self._feedback.decode(frame.data))
            opening = max(abs(values[name]) for name in SPOOLS)
            self.valves.append(Valve(frame.stamp_ns, int(values["State"]), opening))
        elif frame.key == self._command.key:
            self.commands += 1
        elif frame.key == self._guard.key:
            self.guarded_ns = frame.stamp_ns
        elif self._arm.named(self._arm.decode(frame.data))["ArmKey"]:
            self.armed_after_ns, self.disarmed_ns = frame.stamp_ns, 0
        elif not self.disarmed_ns:
            self.disarmed_ns = frame.stamp_ns
            self.mode_when_disarmed = Mode(self.report.mode) if self.report else Mode.BOOT

    def _setpoint(self, now_ns: int, begin_ns: int, origin: tuple[float, ...]) -> CraneSetpoint:
        knots = []
        for after_ns in range(0, 500_000_000, 100_000_000):
            t = (now_ns - begin_ns + after_ns) * 1e-9
            rising = min(t, RISE_S)
            angle_rad = SPEED_RAD_S * (rising * rising / (2.0 * RISE_S) + t - rising)
            position = (origin[0] + self._sign * angle_rad, *origin[1:])
            velocity = (self._sign * SPEED_RAD_S * rising / RISE_S, *[0.0] * (len(origin) - 1))
            knots.append(Knot(after_ns, position, velocity))
        return CraneSetpoint(
            next(self._numbers), self._hash, now_ns, LEASE_NS, GrappleCommand.NEUTRAL, False, tuple(knots)
        )

    def _send(self, data: bytes) -> None:
        self._link.sendto(data, self._controller)
