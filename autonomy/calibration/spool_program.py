"""Spool programs of one valve function: piecewise linear commands over time, each for one question.

Commands in percent of full command, + moves the joint in its positive direction; time in s from the program's start.
Every program begins and ends neutral, crosses the dead-band of the profile in a step (nothing moves there) and opens
the valve at half the rate that the controller allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from can_dbc.messages.crane import MAX_KNOTS, SpoolKnot
from machine.profile import JointSpec

OPENING_FACTOR: Final = 2.0
"""The opening grows this many times faster than the acceleration limit; the controller allows four times."""
END_GUARD_S: Final = 0.001
"""A program is over this long before its end: every program ends neutral."""
STEP_S: Final = 0.005
"""A step inside the dead-band takes one control period."""
BELOW_DEADBAND_PCT: Final = 4.0
"""How far below the profile's dead-band a slow program begins: a valve may open this much earlier."""
WIGGLE_PCT_S, WIGGLE_ABOVE_PCT = 14.0, 20.0
SWEEP_PCT_S, SWEEP_ABOVE_PCT = 7.0, 16.0
STAIRCASE_SPEED_SHARES: Final = (0.3, 0.55, 0.8)
"""Steady speeds of the staircase, as shares of the speed limit, by the profile's valve map."""
HOLD_S: Final = 0.9
PULSE_OPENING_FACTOR: Final = 0.5
"""A pulse opens and closes as gently as the planner's motions: an abrupt one loses 0.05 s of its travel to the pump."""
PULSES: Final = ((0.12, 0.4), (0.35, 0.9), (0.7, 1.6))
"""Turns of a rotator without an encoder, there and back: share of its speed limit and angle [rad].  The slow turns
reveal the dead-band, and each is short enough for the earlier ones to resolve its half turns.
"""


@dataclass(frozen=True, slots=True)
class SpoolProgram:
    """Corner points (time [s], command [%]) joined by straight lines; neutral before the first and after the last."""

    points: tuple[tuple[float, float], ...]

    @property
    def duration_s(self) -> float:
        """Time of its end."""
        return self.points[-1][0]

    def at(self, time_s: float) -> float:
        """The command at a time."""
        points = self.points
        if not points[0][0] <= time_s <= points[-1][0]:
            return 0.0
        for (t0, p0), (t1, p1) in pairwise(points):
            if time_s <= t1:
                return p0 + (p1 - p0) * ((time_s - t0) / (t1 - t0))  # exact at either end: neutral is 0
        return 0.0

    def window(self, time_s: float, horizon_s: float) -> tuple[SpoolKnot, ...]:
        """Knots from ``time_s`` on; at the end of the window the program continues or is neutral."""
        if time_s > self.duration_s - END_GUARD_S:
            return (SpoolKnot(0, 0.0),)
        end_s = min(time_s + horizon_s, self.duration_s)
        inside = [t for t, _ in self.points if time_s < t < end_s]
        times = [time_s, *inside[: MAX_KNOTS - 2], end_s]
        knots: list[SpoolKnot] = []
        for t in times:
            after_ns = round((t - time_s) * 1e6) * 1000
            if not knots or after_ns > knots[-1].after_ns:
                knots.append(SpoolKnot(after_ns, self.at(t)))
        return tuple(knots)

    def closing(self, time_s: float, closing_s: float) -> SpoolProgram:
        """A program that goes straight to neutral from the command at ``time_s``."""
        return SpoolProgram(((time_s, self.at(time_s)), (time_s + closing_s, 0.0)))


def deadband_pct(spec: JointSpec, side: int) -> float:
    """The profile's dead-band of a side (+1, -1)."""
    return spec.valve.deadband_plus_pct if side > 0 else spec.valve.deadband_minus_pct


def command_for(spec: JointSpec, side: int, speed: float) -> float:
    """The command [%, without sign] that the profile's valve map gives for a speed on that side."""
    full = spec.valve.full_speed_plus if side > 0 else spec.valve.full_speed_minus
    deadband = deadband_pct(spec, side)
    return deadband + (100.0 - deadband) * min(1.0, speed / full)


def _ramp(spec: JointSpec, side: int, rate_pct_s: float, over_pct: float, back: bool) -> SpoolProgram:
    """Up through the edge of the dead-band at a steady rate, to ``over_pct`` beyond it, and back or closed."""
    low = max(0.0, deadband_pct(spec, side) - BELOW_DEADBAND_PCT)
    top = deadband_pct(spec, side) + over_pct
    up_s = (top - low) / rate_pct_s
    points = [(0.0, 0.0), (STEP_S, low), (STEP_S + up_s, top)]
    if back:
        points.append((STEP_S + 2.0 * up_s, low))
    end_s = points[-1][0] + STEP_S
    return SpoolProgram(tuple((t, side * p) for t, p in (*points, (end_s, 0.0))))


def wiggle(spec: JointSpec, side: int) -> SpoolProgram:
    """Open slowly until the joint moves; the run ends the program then."""
    return _ramp(spec, side, WIGGLE_PCT_S, WIGGLE_ABOVE_PCT, back=False)


def sweep(spec: JointSpec, side: int) -> SpoolProgram:
    """Slowly out of the dead-band and back into it: both edges of the hysteresis and the foot of the metering curve."""
    return _ramp(spec, side, SWEEP_PCT_S, SWEEP_ABOVE_PCT, back=True)


def reversed_sweep(program: SpoolProgram, time_s: float) -> SpoolProgram:
    """A sweep that reverses at ``time_s`` instead of at its top."""
    (t0, p0), (t1, p1), (_, _), (_, _), _ = program.points
    top = program.at(time_s)
    end_s = time_s + (time_s - t1)
    return SpoolProgram(((t0, p0), (t1, p1), (time_s, top), (end_s, p1), (end_s + STEP_S, 0.0)))


def staircase(spec: JointSpec, side: int) -> SpoolProgram:
    """Three steady speeds, each long enough for the oil to settle, then closed."""
    return _staircase(spec, side, STAIRCASE_SPEED_SHARES, HOLD_S, OPENING_FACTOR)


def pulse(spec: JointSpec, side: int, share: float, hold_s: float) -> SpoolProgram:
    """One steady speed for ``hold_s``, a ``share`` of the speed limit by the profile's valve map, then closed."""
    return _staircase(spec, side, (share,), hold_s, PULSE_OPENING_FACTOR)


def _staircase(spec: JointSpec, side: int, shares: Sequence[float], hold_s: float, factor: float) -> SpoolProgram:
    rate_pct_s = 100.0 * factor * spec.acceleration_limit
    rate_pct_s /= max(spec.valve.full_speed_plus, spec.valve.full_speed_minus)
    before = max(0.0, deadband_pct(spec, side) - 0.5)
    points = [(0.0, 0.0), (STEP_S, before)]
    for share in shares:
        level = command_for(spec, side, share * spec.speed_limit)
        t = points[-1][0] + max((level - before) / rate_pct_s, STEP_S)
        points += [(t, level), (t + hold_s, level)]
        before = level
    floor = max(0.0, deadband_pct(spec, side) - 0.5)
    t = points[-1][0] + (before - floor) / rate_pct_s
    points += [(t, floor), (t + STEP_S, 0.0)]
    return SpoolProgram(tuple((t, side * p) for t, p in points))


def predicted_travel(program: SpoolProgram, spec: JointSpec, side: int) -> float:
    """Travel of the joint by the profile's valve map [rad, m], with its sign."""
    full = spec.valve.full_speed_plus if side > 0 else spec.valve.full_speed_minus
    deadband = deadband_pct(spec, side)
    way, step_s = 0.0, 0.01
    for i in range(int(program.duration_s / step_s) + 1):
        opening = max(0.0, abs(program.at(i * step_s)) - deadband) / (100.0 - deadband)
        way += opening * full * step_s
    return side * way
