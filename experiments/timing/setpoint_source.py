"""The planner of the timing stand: arms the machine and keeps every joint in slow motion, so that the laws work.

``python -m experiments.timing.setpoint_source --profile aoro_fc8 --controller HOST:PORT --report-port N``.  A setpoint of 0.4 s every
50 ms, each joint swinging through a tenth of its range about where it stood.  Says on stdout, one JSON object a line,
every change of mode, and once a second what it has seen.  Exit codes: 0 stopped by SIGTERM or SIGINT, 2 usage, 3
profile.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import signal
import socket
import sys
import time
from collections.abc import Sequence
from typing import Final

from can_dbc.messages.crane import (
    CraneSetpoint,
    DatagramRefused,
    GrappleCommand,
    Knot,
    StateReport,
    decode,
    encode,
    udp_address,
)
from hil.harness.operator import Operator
from machine.faults import describe
from machine.joints import JOINTS
from machine.load import ProfileError, load_profile, profile_hash
from machine.modes import Mode
from machine.profile import Profile

EVERY_NS: Final = 50_000_000
TELL_NS: Final = 1_000_000_000
KNOTS_MS: Final = (0, 100, 200, 300, 400)
LEASE_MS: Final = 350
BEHIND_NS: Final = 2_000_000
"""A stamp lies this far back: a controller in the middle of its tick must not find it in the future."""
SWING: Final = 0.05
"""Share of a joint's range on either side of the start."""
REASON_MASK: Final = 0xFF
"""The detail stands above it."""
BRISKNESS: Final = 0.4
"""Share of the joint's speed and acceleration limits that the motion uses."""


class Swing:
    """The motion of one joint: ``start + reach * (1 - cos(w t)) / 2``, at rest at t = 0, towards the farther end."""

    def __init__(self, start: float, lower: float, upper: float, speed: float, acceleration: float) -> None:
        self.start = start
        self.reach = 2 * SWING * (upper - lower) * (1.0 if upper - start > start - lower else -1.0)
        half = abs(self.reach) / 2
        self.w = BRISKNESS * min(speed / half, math.sqrt(acceleration / half))

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity."""
        half, angle = self.reach / 2, self.w * t_s
        return self.start + half * (1.0 - math.cos(angle)), half * self.w * math.sin(angle)


class Planner:
    """Reports in, datagrams out; pure."""

    def __init__(self, profile: Profile) -> None:
        self._specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self._hash = profile_hash(profile)
        self.operator = Operator(self._hash, lambda _action, _report: None)
        self._swings: list[Swing] = []
        self._begin_ns = 0
        self._sequence = 0
        self.report: StateReport | None = None

    def hear(self, report: StateReport) -> bytes | None:
        """What the operator presses on this report, if anything."""
        self.report = report
        if report.mode not in (Mode.ARMED, Mode.ACTIVE):
            self._swings = []
        return self.operator.step(report)

    def setpoint(self, now_ns: int) -> bytes | None:
        """The setpoint of this moment; None while the machine is not armed."""
        report, stamp_ns = self.report, now_ns - BEHIND_NS
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
            )
        )

    def _from(self, reference: Sequence[float]) -> list[Swing]:
        """A blind joint has no position; it starts at 0, as the controller's own reference does."""
        starts = [0.0 if math.isnan(q) else q for q in reference]
        return [
            Swing(q, s.lower, s.upper, s.speed_limit, s.acceleration_limit)
            for q, s in zip(starts, self._specs, strict=True)
        ]

    def _knot(self, after_ms: int, t_s: float) -> Knot:
        positions, velocities = zip(*(swing.at(t_s) for swing in self._swings), strict=True)
        return Knot(1_000_000 * after_ms, positions, velocities)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.timing.setpoint_source", description="Keeps a machine in motion."
    )
    parser.add_argument("--profile", required=True)
    parser.add_argument("--controller", required=True, type=udp_address, metavar="HOST:PORT")
    parser.add_argument("--report-port", required=True, type=int)
    options = parser.parse_args(arguments)
    try:
        planner = Planner(load_profile(options.profile))
    except ProfileError as error:
        sys.stderr.write(f"planner: {error}\n")
        return 3
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", options.report_port))
        link.settimeout(0.02)
        gc.collect()
        gc.freeze()
        print("ready", flush=True)
        _serve(planner, link, options.controller, ended)
    return 0


def _serve(planner: Planner, link: socket.socket, controller: tuple[str, int], ended: list[int]) -> None:
    send_ns = tell_ns = 0
    mode = -1
    while not ended:
        try:
            message = decode(link.recv(2048))
        except (OSError, DatagramRefused):  # nobody there yet, or not for us
            message = None
        if isinstance(message, StateReport):
            if press := planner.hear(message):
                link.sendto(press, controller)
            if message.mode != mode:
                mode = message.mode
                _tell(planner, event="mode", why=describe(message.reason), reason=message.reason & REASON_MASK)
        now_ns = time.monotonic_ns()
        if now_ns >= send_ns and (datagram := planner.setpoint(now_ns)):
            send_ns = max(send_ns + EVERY_NS, now_ns)
            link.sendto(datagram, controller)
        if now_ns >= tell_ns and planner.report is not None:
            tell_ns = now_ns + TELL_NS
            _tell(planner, event="report")


def _tell(planner: Planner, **more: str | int) -> None:
    report = planner.report
    assert report is not None
    state = {"mode": Mode(report.mode).name, "stops": planner.operator.stops, "refused": report.refused}
    facts = {"stamp_ns": report.stamp_ns, "refusal": describe(report.refusal)}
    print(json.dumps(more | state | facts), flush=True)


if __name__ == "__main__":
    sys.exit(main())
