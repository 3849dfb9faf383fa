"""The reference between the planner's knots: cubic Hermite curves, evaluated at any time without allocation.

Inputs: an accepted crane setpoint and a time.  Outputs: position and velocity of every joint at that time, and the
extremes of one piece.  The curve is extended linearly before the first knot and rests at the last position after the
last.  Limits are checked elsewhere (`controller.crane.trajectory_check`).
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Final

from can_dbc.messages.crane import MAX_KNOTS, CraneSetpoint
from machine.joints import N_JOINTS

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
            for joint in range(N_JOINTS):
                self._position[i * N_JOINTS + joint] = position[joint]
                self._velocity[i * N_JOINTS + joint] = velocity[joint]

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
    """Position and velocity at the fraction ``s`` of a cubic from (p0, v0) to (p1, v1) in ``h`` seconds."""
    c2 = 3.0 * (p1 - p0) - h * (2.0 * v0 + v1)
    c3 = h * (v0 + v1) - 2.0 * (p1 - p0)
    return p0 + s * (h * v0 + s * (c2 + s * c3)), v0 + s * (2.0 * c2 + 3.0 * s * c3) / h


def peak_speed(p0: float, v0: float, p1: float, v1: float, h: float) -> float:
    """Greatest speed on the cubic: its velocity is a parabola, so the ends or the vertex have it."""
    c2 = 3.0 * (p1 - p0) - h * (2.0 * v0 + v1)
    c3 = h * (v0 + v1) - 2.0 * (p1 - p0)
    peak = max(abs(v0), abs(v1))
    if c3 != 0.0:
        s = -c2 / (3.0 * c3)
        if 0.0 < s < 1.0:
            peak = max(peak, abs(v0 + s * (2.0 * c2 + 3.0 * s * c3) / h))
    return peak


def extremes(p0: float, v0: float, p1: float, v1: float, h: float) -> tuple[float, float]:
    """Least and greatest position on the cubic: the ends or where its velocity is zero."""
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
