"""The setpoint source of the timing testbed: arms the machine and moves every joint slowly, so that the laws work.

``python -m experiments.timing.setpoint_source --profile aoro_fc8 --controller HOST:PORT --report-port N --key-file K``

It sends a setpoint of 0.4 s every 50 ms, in which each joint swings through a tenth of its range.  It prints a JSON
line for every change of mode, and once a second the newest report, until SIGTERM or SIGINT.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from can_dbc.messages import operator_link
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused, read_key
from can_dbc.messages.udp_address import address_argument
from hil.harness.operator import Operator
from hil.harness.processes import announce_ready
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_check, profile_hash
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.modes import Mode

SEND_PERIOD_NS: Final = 50_000_000
PRINT_PERIOD_NS: Final = 1_000_000_000
KNOTS_MS: Final = (0, 100, 200, 300, 400)
LEASE_MS: Final = 200
STAMP_AGE_NS: Final = 2_000_000
"""Age of a time stamp when it is sent: a controller in the middle of its tick must not find it in the future."""
SWING_SHARE: Final = 0.05
"""Amplitude of the swing as a share of the joint's range."""
REASON_MASK: Final = 0xFF
"""The bits above it hold the detail."""
SPEED_SHARE: Final = 0.4
"""Share of the joint's speed and acceleration limits used by the motion."""


class Swing:
    """The motion of one joint: ``start + reach * (1 - cos(w t)) / 2``, at rest at t = 0, towards the farther end.

    ``rises``: towards the upper end wherever the range allows it, as a boom that sinks takes the grapple to the ground.
    """

    def __init__(
        self, start: float, lower: float, upper: float, speed: float, acceleration: float, rises: bool = False
    ) -> None:
        self.start = start
        reach = 2 * SWING_SHARE * (upper - lower)
        self.reach = reach if upper - start > (reach if rises else start - lower) else -reach
        half = abs(self.reach) / 2
        self.w = SPEED_SHARE * min(speed / half, math.sqrt(acceleration / half))

    def at(self, t_s: float) -> tuple[float, float]:
        """Return position and velocity."""
        half, angle = self.reach / 2, self.w * t_s
        return self.start + half * (1.0 - math.cos(angle)), half * self.w * math.sin(angle)


class SetpointSource:
    """Reports in, datagrams out; pure."""

    def __init__(self, profile: Profile, key: bytes | None = None, check: int = 0) -> None:
        self._key = key
        self._specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self._hash = profile_hash(profile)
        self.operator = Operator(self._hash, lambda _action, _report: None, profile_check=check)
        self._swings: list[Swing] = []
        self._begin_ns = 0
        self._sequence = 0
        self.report: StateReport | None = None

    def receive(self, report: StateReport) -> bytes | None:
        """Receive a report; returns the command of the emulated operator, if any."""
        self.report = report
        if report.mode not in (Mode.ARMED, Mode.ACTIVE):
            self._swings = []
        return self.operator.step(report)

    def setpoint(self, now_ns: int) -> bytes | None:
        """Return the setpoint to send now; None while the machine is not armed."""
        report, stamp_ns = self.report, now_ns - STAMP_AGE_NS
        if report is None or report.mode not in (Mode.ARMED, Mode.ACTIVE):
            return None
        if not self._swings:
            self._swings, self._begin_ns = self._from(report.reference), stamp_ns
        self._sequence += 1
        begin_s = (stamp_ns - self._begin_ns) * 1e-9
        knots = tuple(self._knot(ms, begin_s + 1e-3 * ms) for ms in KNOTS_MS)
        return encode(
            CraneSetpoint(
                self._sequence, self._hash, stamp_ns, LEASE_MS * 1_000_000, GrappleCommand.NEUTRAL, False, knots
            ),
            self._key,
        )

    def _from(self, reference: Sequence[float]) -> list[Swing]:
        """Make the swings; a joint without an encoder has no position and starts at 0, as the controller's reference
        does.
        """
        starts = [0.0 if math.isnan(q) else q for q in reference]
        return [
            Swing(q, s.lower, s.upper, s.speed_limit, s.acceleration_limit, rises=j is Joint.LIFT)
            for j, q, s in zip(JOINTS, starts, self._specs, strict=True)
        ]

    def _knot(self, after_ms: int, t_s: float) -> Knot:
        positions, velocities = zip(*(swing.at(t_s) for swing in self._swings), strict=True)
        return Knot(1_000_000 * after_ms, positions, velocities)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.timing.setpoint_source", description="Keep a machine in motion."
    )
    parser.add_argument("--profile", required=True)
    parser.add_argument("--controller", required=True, type=address_argument, metavar="HOST:PORT")
    parser.add_argument("--operator", required=True, type=Path, metavar="FILE")
    parser.add_argument("--report-port", required=True, type=int)
    parser.add_argument("--key-file", required=True, type=Path)
    options = parser.parse_args(arguments)
    key = read_key(options.key_file)
    source = SetpointSource(load_profile(options.profile), key, profile_check(options.profile))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", options.report_port))
        link.settimeout(0.02)
        ended = announce_ready()
        send_ns = next_print_ns = 0
        mode = -1
        while not ended:
            try:
                message = decode(link.recv(2048), key)
            except (OSError, DatagramRefused):  # no controller yet, or another datagram
                message = None
            if isinstance(message, StateReport):
                if press := source.receive(message):
                    with contextlib.suppress(OSError):  # it has ended
                        operator_link.send(press, options.operator)
                if message.mode != mode:
                    mode = message.mode
                    _print(source, event="mode", why=describe(message.reason), reason=message.reason & REASON_MASK)
            now_ns = time.monotonic_ns()
            if now_ns >= send_ns and (datagram := source.setpoint(now_ns)):
                send_ns = max(send_ns + SEND_PERIOD_NS, now_ns)
                link.sendto(datagram, options.controller)
            if now_ns >= next_print_ns and source.report is not None:
                next_print_ns = now_ns + PRINT_PERIOD_NS
                _print(source, event="report")
    return 0


def _print(source: SetpointSource, **more: str | int) -> None:
    report = source.report
    assert report is not None
    state = {"mode": Mode(report.mode).name, "refused": report.refused, "refusal": describe(report.refusal)}
    print(json.dumps(more | state | {"stamp_ns": report.stamp_ns}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
