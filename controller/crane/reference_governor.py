"""The reference governor: what the joints are to do now, at a rate of time that the machine can follow.

Inputs: accepted setpoints and the tick's time.  Outputs: ``position`` and ``velocity`` of every joint's reference now,
and ``lead_velocity``, its velocity at the moment at which a command given now shows at the joint (for the
feed-forward).  Without a trajectory the reference is the joints' position.  The trajectory's time runs at the rate of
`TimeScaling`; while it is behind the planner's clock, a new setpoint is joined to the end of what is
still to be done.

Whatever the setpoints say, no joint's reference is faster than its speed limit, and its speed grows by no more than
`GROWTH_FACTOR` times its acceleration limit: each setpoint may begin a little off the last one's path, and a planner
that goes on so would drive the reference as fast as it likes.  A reference that is off its trajectory goes there as
fast as these limits let it; one that is on it is the trajectory to the last bit.  It may stop at once, so that it
never goes beyond its trajectory.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Final

from can_dbc.messages.crane import MAX_KNOTS, CraneSetpoint
from controller.laws.valve_map import ValveMap
from machine.joints import JOINTS, N_JOINTS
from machine.profile import SPEED_HEADROOM_SHARE, Profile, joint

# -- The reference between the planner's knots: cubic Hermite curves, evaluated at any time without allocation.
#
# Inputs: an accepted crane setpoint and a time.  Outputs: position and velocity of every joint at that time, and the
# extremes of one piece.  The curve is extended linearly before the first knot and rests at the last position after the
# last.  Limits are checked elsewhere (`controller.crane.trajectory_check`).


HISTORY_KNOTS: Final = 40
"""Knots of earlier setpoints that a trajectory keeps while its time is behind the planner's: two of each setpoint."""
_CAPACITY_KNOTS: Final = MAX_KNOTS + HISTORY_KNOTS + 2
_S_PER_NS: Final = 1e-9


class Trajectory:
    """Knots of fixed storage, and the cubics between them."""

    __slots__ = ("_n", "_position", "_times_ns", "_velocity")

    def __init__(self) -> None:
        self._n = 0
        self._times_ns = array("q", [0] * _CAPACITY_KNOTS)
        self._position = array("d", [0.0] * (_CAPACITY_KNOTS * N_JOINTS))
        self._velocity = array("d", [0.0] * (_CAPACITY_KNOTS * N_JOINTS))

    def load(self, setpoint: CraneSetpoint) -> None:
        """Copy the knots of a decoded setpoint (1 to 16, times strictly growing)."""
        self._n = len(setpoint.knots)
        for i, (after_ns, position, velocity) in enumerate(setpoint.knots):
            self._times_ns[i] = setpoint.stamp_ns + after_ns
            for j in range(N_JOINTS):
                self._position[i * N_JOINTS + j] = position[j]
                self._velocity[i * N_JOINTS + j] = velocity[j]

    def extend(self, newer: Trajectory, from_ns: int) -> None:
        """Continue as ``newer`` from its first knot; keeps the knots before that and not before ``from_ns``.

        The curve up to that knot stays what it was.  Where ``newer`` begins at another place the curve steps, as the
        reference does that changes to another trajectory: a cubic between two knots that lie close together would turn
        the step into a speed that no joint has.
        """
        times, first_ns = self._times_ns, newer._times_ns[0]
        end = 0
        while end < self._n and times[end] < first_ns:
            end += 1
        if end:
            end = self._cut(end, first_ns)
        start = max(0, end - HISTORY_KNOTS)
        while start + 1 < end and times[start + 1] <= from_ns:
            start += 1
        for i in range(start, end):
            self._copy(i - start, self, i)
        for i in range(newer._n):
            self._copy(end - start + i, newer, i)
        self._n = end - start + newer._n

    def _cut(self, end: int, time_ns: int) -> int:
        """End the curve at ``time_ns``, after the first ``end`` knots; returns the number of knots."""
        times, p, v = self._times_ns, self._position, self._velocity
        before, at = (end - 1) * N_JOINTS, end * N_JOINTS
        if end == self._n:  # it rests at its last position
            for j in range(N_JOINTS):
                p[at + j], v[at + j] = p[before + j], 0.0
            times[end] = times[end - 1]
            if not any(v[before : before + N_JOINTS]):
                times[end] = time_ns
                return end + 1
            for j in range(N_JOINTS):
                p[at + N_JOINTS + j], v[at + N_JOINTS + j] = p[before + j], 0.0
            times[end + 1] = time_ns
            return end + 2
        h = (times[end] - times[end - 1]) * _S_PER_NS
        share = (time_ns - times[end - 1]) * _S_PER_NS / h
        for j in range(N_JOINTS):
            a, b = before + j, at + j
            p[b], v[b] = hermite(p[a], v[a], p[b], v[b], h, share)
        times[end] = time_ns
        return end + 1

    def _copy(self, to: int, other: Trajectory, knot: int) -> None:
        self._times_ns[to] = other._times_ns[knot]
        a, b = to * N_JOINTS, knot * N_JOINTS
        for j in range(N_JOINTS):
            self._position[a + j], self._velocity[a + j] = other._position[b + j], other._velocity[b + j]

    @property
    def end_ns(self) -> int:
        """Time of the last knot."""
        return self._times_ns[self._n - 1]

    @property
    def ends_at_rest(self) -> bool:
        """Whether the last knot has no velocity."""
        first = (self._n - 1) * N_JOINTS
        return not any(self._velocity[first : first + N_JOINTS])

    def fill(self, joints: Sequence[int], now_ns: int, position: list[float], velocity: list[float]) -> None:
        """Write position [rad, m] and velocity [per second] of ``joints`` at ``now_ns`` into their places."""
        times, n = self._times_ns, self._n
        p, v = self._position, self._velocity
        if now_ns <= times[0]:
            ahead_s = (now_ns - times[0]) * _S_PER_NS
            for j in joints:
                position[j], velocity[j] = p[j] + v[j] * ahead_s, v[j]
            return
        if now_ns > times[n - 1]:
            last = (n - 1) * N_JOINTS
            for j in joints:
                position[j], velocity[j] = p[last + j], 0.0
            return
        k = 1
        while times[k] < now_ns:
            k += 1
        h = (times[k] - times[k - 1]) * _S_PER_NS
        share = (now_ns - times[k - 1]) * _S_PER_NS / h
        for j in joints:
            b = k * N_JOINTS + j
            a = b - N_JOINTS
            position[j], velocity[j] = hermite(p[a], v[a], p[b], v[b], h, share)


def hermite(p0: float, v0: float, p1: float, v1: float, h: float, s: float) -> tuple[float, float]:
    """Compute position and velocity at the fraction ``s`` of a cubic from (p0, v0) to (p1, v1) in ``h`` seconds."""
    c2 = 3.0 * (p1 - p0) - h * (2.0 * v0 + v1)
    c3 = h * (v0 + v1) - 2.0 * (p1 - p0)
    return p0 + s * (h * v0 + s * (c2 + s * c3)), v0 + s * (2.0 * c2 + 3.0 * s * c3) / h


def peak_speed(p0: float, v0: float, p1: float, v1: float, h: float) -> float:
    """Compute the greatest speed on the cubic: its velocity is a parabola, so the ends or the vertex have it."""
    c2 = 3.0 * (p1 - p0) - h * (2.0 * v0 + v1)
    c3 = h * (v0 + v1) - 2.0 * (p1 - p0)
    peak = max(abs(v0), abs(v1))
    if c3 != 0.0:
        s = -c2 / (3.0 * c3)
        if 0.0 < s < 1.0:
            peak = max(peak, abs(v0 + s * (2.0 * c2 + 3.0 * s * c3) / h))
    return peak


def extremes(p0: float, v0: float, p1: float, v1: float, h: float) -> tuple[float, float]:
    """Find the least and greatest position on the cubic: the ends or where its velocity is zero."""
    c2 = 3.0 * (p1 - p0) - h * (2.0 * v0 + v1)
    c3 = h * (v0 + v1) - 2.0 * (p1 - p0)
    low, high = min(p0, p1), max(p0, p1)
    a, b, c = 3.0 * c3, 2.0 * c2, h * v0
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        return low, high
    # The form with q has no cancellation and needs no special case for a parabola that is nearly a line.
    q = -0.5 * (b + discriminant**0.5) if b >= 0.0 else -0.5 * (b - discriminant**0.5)
    for numerator, denominator in ((q, a), (c, q)):
        if denominator != 0.0:
            s = numerator / denominator
            if 0.0 < s < 1.0:
                p = p0 + s * (h * v0 + s * (c2 + s * c3))
                low, high = min(low, p), max(high, p)
    return low, high


# -- Time scaling: the trajectory's time runs at a rate of at most 1, so that the crane can stay on its path.
#
# A planner's motion may need more oil than the pump gives, and a degraded machine may only move at half speed.  Slowing
# single joints would leave the path; slowing the trajectory's time slows all of them together.  The rate follows the
# reference's velocity one valve delay ahead and changes smoothly.  The time behind the planner's clock is bounded;
# beyond the bound the laws' own limits act (`controller.laws.crane`).


FLOW_SHARE: Final = 0.96
"""Share of the pump's flow that a reference may use; corrections need the rest."""
SPEED_SHARE: Final = 0.9
"""Share of a law's greatest speed that a reference may use."""
RATE_CHANGE_1_S: Final = 2.0
MAX_BEHIND_NS: Final = 800_000_000


class TimeScaling:
    """``rate``: seconds of trajectory time per second; ``behind_ns``: how far it is behind the tick's time."""

    __slots__ = ("_fastest", "_flow", "_flow_minus", "_flow_plus", "_speed", "behind_ns", "rate")

    def __init__(self, profile: Profile) -> None:
        specs = [joint(profile, j) for j in JOINTS]
        self._flow = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s
        self._flow_plus = tuple(s.valve.flow_plus for s in specs)
        self._flow_minus = tuple(s.valve.flow_minus for s in specs)
        self._fastest = tuple(s.speed_limit for s in specs)
        self._speed = tuple(SPEED_SHARE * SPEED_HEADROOM_SHARE * s.speed_limit for s in specs)
        self.reset()

    def reset(self) -> None:
        """Put the trajectory on time."""
        self.rate = 1.0
        self.behind_ns = 0

    def step(self, lead_velocity: Sequence[float], valves: Sequence[ValveMap], cap: float, elapsed_ns: int) -> None:
        """Run one tick with the reference's velocities at rate 1, one delay ahead; ``cap`` scales the speed limits."""
        target_rate, flow = 1.0, 0.0
        for j, velocity in enumerate(lead_velocity):
            if velocity >= 0.0:
                speed = velocity
                flow += speed * self._flow_plus[j] * valves[j].arm
            else:
                speed = -velocity
                flow += speed * self._flow_minus[j] * valves[j].arm
            limit = min(cap * self._speed[j], self._fastest[j])
            if speed * target_rate > limit:
                target_rate = limit / speed
        if flow * target_rate > self._flow:
            target_rate = self._flow / flow
        if self.behind_ns >= MAX_BEHIND_NS:
            target_rate = 1.0
        change = RATE_CHANGE_1_S * elapsed_ns * 1e-9
        self.rate = min(max(target_rate, self.rate - change), self.rate + change, 1.0)
        self.behind_ns += int((1.0 - self.rate) * elapsed_ns)


# -- The governor


GROWTH_FACTOR: Final = 4.0
"""A joint's command may change this many times faster than the planner's acceleration limit (`controller.laws.joint`);
a reference that is faster still would only run ahead of it."""
_SAME_PLACE: Final = 1e-9


class ReferenceGovernor:
    """Trajectory with time scaling.

    Load a setpoint into ``candidate``, check it against `planned` or the present reference, then `accept` it.
    """

    __slots__ = (
        "_before",
        "_before_speed",
        "_elapsed_s",
        "_growth",
        "_last_ns",
        "_leads",
        "_off",
        "_plan",
        "_plan_velocity",
        "_scaling",
        "_speed",
        "_unscaled_lead",
        "_valves",
        "candidate",
        "lead_velocity",
        "position",
        "trajectory",
        "velocity",
    )

    def __init__(self, profile: Profile, valves: Sequence[ValveMap], leads_ns: Sequence[int]) -> None:
        self._valves = valves
        self._leads = tuple((ns, tuple(j for j in JOINTS if leads_ns[j] == ns)) for ns in sorted(set(leads_ns)))
        self._scaling = TimeScaling(profile)
        specs = [joint(profile, j) for j in JOINTS]
        self._speed = tuple(s.speed_limit for s in specs)
        self._growth = tuple(GROWTH_FACTOR * s.acceleration_limit for s in specs)
        self._last_ns = 0
        self._elapsed_s = 0.0
        """Time from the tick before to this one."""
        self._before, self._before_speed = [0.0] * N_JOINTS, [0.0] * N_JOINTS
        """Reference of the tick before and its mean speed on the way there; NaN before the first."""
        self._off = False
        """Whether a joint's reference has yet to come to its trajectory."""
        self.trajectory, self.candidate = Trajectory(), Trajectory()
        self.position = [float("nan")] * N_JOINTS
        self.velocity = [0.0] * N_JOINTS
        self.lead_velocity = [0.0] * N_JOINTS
        self._unscaled_lead = [0.0] * N_JOINTS
        """``lead_velocity`` at rate 1."""
        self._plan, self._plan_velocity = [0.0] * N_JOINTS, [0.0] * N_JOINTS

    @property
    def rate(self) -> float:
        """Seconds of trajectory time per second."""
        return self._scaling.rate

    @property
    def behind_ns(self) -> int:
        """How far the trajectory's time is behind the planner's."""
        return self._scaling.behind_ns

    def hold(self, j: int, position: float, now_ns: int) -> None:
        """Keep a joint that follows no trajectory at ``position``."""
        self.position[j] = self._before[j] = position
        self.velocity[j] = self.lead_velocity[j] = self._unscaled_lead[j] = 0.0
        self._scaling.reset()
        self._last_ns = now_ns
        self._elapsed_s = 0.0
        self._off = False

    def planned(self, now_ns: int) -> tuple[Sequence[float], Sequence[float]]:
        """Return the position and velocity that the planner gave for now; a new setpoint continues them."""
        self.trajectory.fill(JOINTS, now_ns, self._plan, self._plan_velocity)
        return self._plan, self._plan_velocity

    def accept(self, now_ns: int, continues: bool) -> None:
        """Follow the candidate; when it ``continues`` the plan, what is still to be done comes first."""
        if continues and self._scaling.behind_ns:
            self.trajectory.extend(self.candidate, now_ns - self._scaling.behind_ns)
        else:
            self.trajectory, self.candidate = self.candidate, self.trajectory
            self._scaling.reset()

    def follow(self, now_ns: int, cap: float) -> None:
        """Compute the reference of this tick, again after every setpoint accepted in it; ``cap`` scales the speed
        limits.
        """
        scaling, trajectory = self._scaling, self.trajectory
        elapsed_ns, self._last_ns = now_ns - self._last_ns, now_ns
        if elapsed_ns:
            scaling.step(self._unscaled_lead, self._valves, cap, elapsed_ns)
            self._leave_tick(elapsed_ns * 1e-9)
        rate, time_ns = scaling.rate, now_ns - scaling.behind_ns
        trajectory.fill(JOINTS, time_ns, self.position, self.velocity)
        for lead_ns, joints in self._leads:
            trajectory.fill(joints, time_ns + int(rate * lead_ns), self._plan, self._unscaled_lead)
        self._off = False
        for j in range(N_JOINTS):
            self._bound(j, rate)
        if scaling.behind_ns and self._caught_up(now_ns):
            scaling.reset()

    def _leave_tick(self, elapsed_s: float) -> None:
        """Make the present reference that of the tick before, ``elapsed_s`` ago."""
        before_s, self._elapsed_s = self._elapsed_s, elapsed_s
        for j in range(N_JOINTS):
            travel = self.position[j] - self._before[j]
            if travel != travel:  # it has just begun, where the trajectory is
                self._before_speed[j] = self.velocity[j]
            else:
                self._before_speed[j] = travel / before_s if before_s > 0.0 else 0.0
            self._before[j] = self.position[j]

    def _bound(self, j: int, rate: float) -> None:
        """Scale a joint's velocities, and keep its reference within its limits of speed and growth."""
        before, limit, elapsed_s = self._before[j], self._speed[j], self._elapsed_s
        step, was = self.position[j] - before, self._before_speed[j]
        velocity, lead = rate * self.velocity[j], rate * self._unscaled_lead[j]
        fastest = min(limit, max(was if step > 0.0 else -was, 0.0) + self._growth[j] * elapsed_s)
        if abs(step) > fastest * elapsed_s:
            self._off = True
            self.position[j] = before + math.copysign(fastest * elapsed_s, step)
        self.velocity[j] = min(max(velocity, -limit), limit)
        self.lead_velocity[j] = min(max(lead, -limit), limit)

    def _caught_up(self, now_ns: int) -> bool:
        """Tell whether reference and plan rest at the same place, so that nothing is left to catch up with."""
        plan, velocity = self.planned(now_ns)
        return (
            not any(self.velocity)
            and not any(velocity)
            and all(abs(p - r) < _SAME_PLACE for p, r in zip(plan, self.position, strict=True))
        )

    def at_rest(self, now_ns: int) -> bool:
        """Tell whether the trajectory's last knot is reached, or nothing moves."""
        return not self._off and (now_ns - self._scaling.behind_ns >= self.trajectory.end_ns or not any(self.velocity))

    def ended_moving(self, now_ns: int) -> bool:
        """Tell whether the trajectory ended with a velocity."""
        return now_ns - self._scaling.behind_ns > self.trajectory.end_ns and not self.trajectory.ends_at_rest
