"""Spool programs of one valve function: piecewise linear commands over time, each for one question.

Commands in percent of full command, + moves the joint in its positive direction; time in s from the program's start.
Every program begins and ends neutral, crosses the dead-band in a step (nothing moves there) and opens the valve at half
the rate that the controller allows.  The first program of a valve, its wiggle, knows nothing and begins at neutral.
What the others take from a `JointSpec` may be the profile's or what the wiggles found; what the controller accepts is
always judged by the profile's (`Allowed`).

A program ends with a moment at `REST_PCT`: inside every dead-band, but not neutral, because a spool follows its command
by up to a third of a second later, and until then guard and controller shall see that it is meant to be open.
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
"""How far below the known dead-band a slow program begins: a valve may open this much earlier."""
REST_PCT, REST_S = 0.5, 0.4
"""The command and the time with which a program ends: the longest dead time (0.25 s), spool and a sample."""
WIGGLE_PCT_S, WIGGLE_TOP_PCT = 10.0, 50.0
"""The widest dead-band is 30 % of the stroke; a slow joint behind it needs the rest to show a motion."""
SWEEP_PCT_S, SWEEP_ABOVE_PCT = 7.0, 16.0
REACHED_SHARE: Final = 0.9
"""A joint that cannot reach its speed limit is tested up to this share of its full speed."""
MOST_SHARE: Final = 0.98
"""Share of the greatest command that the controller accepts: commands are cut to 0.05 %."""
STAIRCASE_SPEED_SHARES: Final = (0.3, 0.55, 0.8)
"""Steady speeds of the staircase, as shares of the speed limit, by the profile's valve map."""
HOLD_S: Final = 0.9
PULSE_OPENING_FACTOR: Final = 0.5
"""A pulse opens and closes as gently as the planner's motions: an abrupt one loses 0.05 s of its travel to the pump."""
TURN_SEARCH_PCT_S: Final = 30.0
TURN_TOPS_PCT: Final = (30.0, 37.0, 44.0, 52.0, 62.0)
"""Rate and tops of the ramps that search the dead-band of a joint without an encoder, one after the other until it has
turned: none turns it by more than a radian, whatever its valve."""
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
        """Return the command at a time."""
        points = self.points
        if not points[0][0] <= time_s <= points[-1][0]:
            return 0.0
        for (t0, p0), (t1, p1) in pairwise(points):
            if time_s <= t1:
                return p0 + (p1 - p0) * ((time_s - t0) / (t1 - t0))  # exact at either end: neutral is 0
        return 0.0

    def window(self, time_s: float, horizon_s: float) -> tuple[SpoolKnot, ...]:
        """Return the knots from ``time_s`` on; at the end of the window the program continues or is neutral."""
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
        """Return a program that goes straight to neutral from the command at ``time_s``."""
        return SpoolProgram(((time_s, self.at(time_s)), (time_s + closing_s, 0.0)))

    def ending(self, time_s: float, closing_s: float, edge_pct: float = REST_PCT) -> SpoolProgram:
        """Return a program that closes the valve from ``time_s`` on, down to a known edge of its dead-band, and ends as
        every program does.
        """
        at, end_s = self.at(time_s), time_s + closing_s
        side = 1.0 if at > 0.0 else -1.0
        rest, edge = side * REST_PCT, side * min(max(REST_PCT, edge_pct), abs(at))
        shut_s = end_s + (STEP_S if edge != rest else 0.0)
        edges = ((time_s, at), (end_s, edge)) + (((shut_s, rest),) if edge != rest else ())
        return SpoolProgram((*edges, (shut_s + REST_S, rest), (shut_s + REST_S + STEP_S, 0.0)))


def deadband_pct(spec: JointSpec, side: int) -> float:
    """Return the profile's dead-band of a side (+1, -1)."""
    return spec.valve.deadband_plus_pct if side > 0 else spec.valve.deadband_minus_pct


def side_limit(spec: JointSpec, side: int) -> float:
    """Compute the greatest speed of a test to a side [rad/s, m/s]: the speed limit, or what the valve can reach."""
    full = spec.valve.full_speed_plus if side > 0 else spec.valve.full_speed_minus
    return min(spec.speed_limit, REACHED_SHARE * full)


def command_for(spec: JointSpec, side: int, speed: float) -> float:
    """Compute the command [%, without sign] that the profile's valve map gives for a speed on that side."""
    full = spec.valve.full_speed_plus if side > 0 else spec.valve.full_speed_minus
    deadband = deadband_pct(spec, side)
    return deadband + (100.0 - deadband) * min(1.0, speed / full)


@dataclass(frozen=True, slots=True)
class Allowed:
    """What the controller accepts of the programs of a joint, by the profile that it runs.

    ``deadbands_pct`` and ``most_pct`` (greatest command) are of the plus and the minus side.
    """

    deadbands_pct: tuple[float, float]
    most_pct: tuple[float, float]
    rate_pct_s: float

    def deadband_pct(self, side: int) -> float:
        """Return the dead-band of a side, inside which a command may step."""
        return self.deadbands_pct[0 if side > 0 else 1]

    def top_pct(self, side: int, percent: float) -> float:
        """Cut a command to what is accepted."""
        return min(percent, self.most_pct[0 if side > 0 else 1])


def allowed_by(spec: JointSpec) -> Allowed:
    """Compute what a controller with this joint in its profile accepts (`controller.crane.spool_test_run`), less a
    margin.
    """
    fastest = max(spec.valve.full_speed_plus, spec.valve.full_speed_minus)
    most = [MOST_SHARE * command_for(spec, side, spec.speed_limit) for side in (1, -1)]
    rate_pct_s = 100.0 * OPENING_FACTOR * spec.acceleration_limit / fastest
    return Allowed((deadband_pct(spec, 1), deadband_pct(spec, -1)), (most[0], most[1]), rate_pct_s)


def _edge(side: int, low: float, allowed: Allowed) -> list[tuple[float, float]]:
    """Go from neutral to ``low``, inside the dead-band: a step as far as the controller lets it be one, then a line."""
    points = [(0.0, 0.0)]
    stepped = min(low, max(0.0, allowed.deadband_pct(side) - 0.5))
    if stepped > 0.0:
        points.append((STEP_S, stepped))
    if low > stepped:
        points.append((points[-1][0] + (low - stepped) / allowed.rate_pct_s, low))
    return points


def _shut(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Append the end of a program: a step to rest, and neutral once the spool has followed."""
    end_s = points[-1][0] + STEP_S
    return [*points, (end_s, REST_PCT), (end_s + REST_S, REST_PCT), (end_s + REST_S + STEP_S, 0.0)]


def _signed(side: int, points: Sequence[tuple[float, float]]) -> SpoolProgram:
    return SpoolProgram(tuple((t, side * p) for t, p in points))


def wiggle(spec: JointSpec, side: int, allowed: Allowed | None = None) -> SpoolProgram:
    """Open the valve from neutral, slowly, until the joint moves; the run ends the program then."""
    top = (allowed or allowed_by(spec)).top_pct(side, WIGGLE_TOP_PCT)
    return _signed(side, _shut([(0.0, 0.0), (top / WIGGLE_PCT_S, top)]))


def turn_search(spec: JointSpec, side: int, top_pct: float, allowed: Allowed | None = None) -> SpoolProgram:
    """Open the valve from neutral steadily up to a top, then close it."""
    top = (allowed or allowed_by(spec)).top_pct(side, top_pct)
    return _signed(side, _shut([(0.0, 0.0), (top / TURN_SEARCH_PCT_S, top)]))


def sweep(spec: JointSpec, side: int, allowed: Allowed | None = None) -> SpoolProgram:
    """Go slowly out of the dead-band and back: both edges of the hysteresis and the foot of the metering curve."""
    allowed = allowed or allowed_by(spec)
    low = max(0.0, deadband_pct(spec, side) - BELOW_DEADBAND_PCT)
    top = allowed.top_pct(side, deadband_pct(spec, side) + SWEEP_ABOVE_PCT)
    points = _edge(side, low, allowed)
    up_s = (top - low) / SWEEP_PCT_S
    begin_s = points[-1][0]
    return _signed(side, _shut([*points, (begin_s + up_s, top), (begin_s + 2.0 * up_s, low)]))


def rises(program: SpoolProgram, time_s: float) -> bool:
    """Tell whether a sweep is on its slow way up."""
    return program.points[-6][0] < time_s < program.points[-5][0]


def reversed_sweep(program: SpoolProgram, time_s: float) -> SpoolProgram:
    """Make a sweep reverse at ``time_s`` instead of at its top."""
    *edge, begin, _, _, _, _, _ = program.points
    side = 1 if program.points[-2][1] > 0.0 else -1
    top, down_s = abs(program.at(time_s)), time_s - begin[0]
    points = [(t, abs(p)) for t, p in (*edge, begin)]
    return _signed(side, _shut([*points, (time_s, top), (time_s + down_s, abs(begin[1]))]))


def staircase(spec: JointSpec, side: int, allowed: Allowed | None = None) -> SpoolProgram:
    """Hold three steady speeds, each long enough for the oil to settle, then close the valve."""
    return steady(spec, side, STAIRCASE_SPEED_SHARES, HOLD_S, allowed)


def pulse(spec: JointSpec, side: int, share: float, hold_s: float, allowed: Allowed | None = None) -> SpoolProgram:
    """Hold one steady speed for ``hold_s``, a ``share`` of the speed limit by the valve map, then close the valve."""
    return steady(spec, side, (share,), hold_s, allowed, PULSE_OPENING_FACTOR / OPENING_FACTOR)


def steady(
    spec: JointSpec,
    side: int,
    shares: Sequence[float],
    hold_s: float,
    allowed: Allowed | None = None,
    gentle: float = 1.0,
) -> SpoolProgram:
    """Hold steady speeds, ``shares`` of the speed limit by the valve map, each for ``hold_s``; the opening grows
    ``gentle`` times as fast as usual.
    """
    allowed = allowed or allowed_by(spec)
    own = allowed_by(spec).rate_pct_s
    rate_pct_s = gentle * min(own, allowed.rate_pct_s)
    before = floor = max(0.0, deadband_pct(spec, side) - 0.5)
    points = _edge(side, before, allowed)
    for share in shares:
        level = allowed.top_pct(side, command_for(spec, side, share * side_limit(spec, side)))
        t = points[-1][0] + max((level - before) / rate_pct_s, STEP_S)
        points += [(t, level), (t + hold_s, level)]
        before = level
    t = points[-1][0] + max((before - floor) / rate_pct_s, STEP_S)
    return _signed(side, _shut([*points, (t, floor)]))


def predicted_travel(program: SpoolProgram, spec: JointSpec, side: int) -> float:
    """Predict the travel of the joint by the profile's valve map [rad, m], with its sign."""
    full = spec.valve.full_speed_plus if side > 0 else spec.valve.full_speed_minus
    deadband = deadband_pct(spec, side)
    travel, step_s = 0.0, 0.01
    for i in range(int(program.duration_s / step_s) + 1):
        opening = max(0.0, abs(program.at(i * step_s)) - deadband) / (100.0 - deadband)
        travel += opening * full * step_s
    return side * travel
