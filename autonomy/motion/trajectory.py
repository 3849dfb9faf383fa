"""Smooth, synchronised, sway-aware joint motions between poses.

A leg is a straight line in poses.  Its progress has velocity ramps of ``smoothstep5`` with a cruise between
them, so velocity, acceleration and jerk are zero at both ends (as s = 35t^4-84t^5+70t^6-20t^7 of machines.md
1.6, whose peak it equals without cruise, but faster over long ways).  The ramp and the duration are the
shortest that keep every joint inside its limits and leave less than ``SWAY_M`` of swing: for a pendulum of
frequency w under the pin's acceleration a the amplitude that stays is |integral a(t) e^(iwt) dt| / w.  Legs
over different coordinates may overlap.  Failure: ``machine.kinematics.Unreachable``.  No clock: a plan is a
function of its own time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.motion.arm import Arm, Pose

STEP_S: Final = 0.02
SWAY_M: Final = 0.03
PENDULUM_S: Final = (1.5, 1.65, 1.8, 1.95, 2.1)
"""Periods of the empty and the loaded grapple (machines.md 5), with some spread."""
_RAMPS: Final = (0.5, 0.42, 0.34, 0.27, 0.21, 0.16)
_SHORTEST_S: Final = 0.6
_GRID: Final = np.linspace(0.0, 1.0, 121)
_RISE_LEFT_M: Final = 0.12
"""How far under its height a rising grapple may still be when it starts to move sideways."""
_WAY_LEFT_M: Final = 0.35
"""How far from the point under it a grapple may be when it starts to go down."""

Axes = tuple[float, ...]


def progress(tau: np.ndarray, ramp: float) -> np.ndarray:
    """Progress 0..1 over ``tau`` = time / duration (clipped); ``ramp`` in (0, 0.5] is each ramp's share."""
    tau = np.clip(tau, 0.0, 1.0)
    top = 1.0 / (1.0 - ramp)

    def rising(t: np.ndarray) -> np.ndarray:
        w = np.minimum(t / ramp, 1.0)
        way: np.ndarray = top * (ramp * w**4 * (2.5 - 3.0 * w + w * w) + np.maximum(t - ramp, 0.0))
        return way

    return np.where(tau <= 0.5, rising(tau), 1.0 - rising(1.0 - tau))


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A joint motion at rest at both ends: positions and velocities every ``STEP_S``, cubics between."""

    position: list[Axes]
    velocity: list[Axes]

    @property
    def duration_s(self) -> float:
        """Time of the last point."""
        return (len(self.position) - 1) * STEP_S

    @property
    def goal(self) -> Axes:
        """Joint positions at the end."""
        return self.position[-1]

    def at(self, time_s: float) -> tuple[Axes, Axes]:
        """Joint positions and velocities at a time; before the start and past the end it stands still."""
        i = int(time_s // STEP_S)
        if i < 0 or i >= len(self.position) - 1:
            return self.position[0 if i < 0 else -1], (0.0,) * len(self.goal)
        s = time_s / STEP_S - i
        q, v = [], []
        for p0, p1, v0, v1 in zip(*self.position[i : i + 2], *self.velocity[i : i + 2], strict=True):
            m0, m1 = v0 * STEP_S, v1 * STEP_S
            c2, c3 = 3.0 * (p1 - p0) - 2.0 * m0 - m1, m0 + m1 - 2.0 * (p1 - p0)
            q.append(p0 + s * (m0 + s * (c2 + s * c3)))
            v.append((m0 + s * (2.0 * c2 + 3.0 * s * c3)) / STEP_S)
        return tuple(q), tuple(v)


def _table(position: np.ndarray) -> Trajectory:
    velocity = np.gradient(position, STEP_S, axis=0)
    velocity[0] = velocity[-1] = 0.0
    return Trajectory([tuple(q) for q in position.tolist()], [tuple(v) for v in velocity.tolist()])


def hold(q: Sequence[float]) -> Trajectory:
    """Standing still at a joint position."""
    return _table(np.array([q, q], dtype=float))


def _load(arm: Arm, position: np.ndarray, step: float) -> float:
    """By how much a motion sampled every ``step`` is to be stretched in time to keep the arm's limits (1 =
    just).
    """
    velocity = np.gradient(position, step, axis=0)
    acceleration = np.gradient(velocity, step, axis=0)
    speed = np.max(np.abs(velocity) / arm.speed)
    return float(max(speed, np.sqrt(np.max(np.abs(acceleration) / arm.acceleration))))


def _sway_m(pin_xy: np.ndarray, duration_s: float) -> float:
    """Greatest swing that stays after the pin went along (n, 2) points, evenly spaced in time."""
    step = duration_s / (len(pin_xy) - 1)
    acceleration = np.gradient(np.gradient(pin_xy, step, axis=0), step, axis=0)
    time = np.arange(len(pin_xy)) * step
    omega = 2.0 * np.pi / np.array(PENDULUM_S)
    left = np.exp(1j * np.outer(omega, time)) @ acceleration * step / omega[:, None]
    return float(np.max(np.linalg.norm(np.abs(left), axis=1)))


@dataclass(frozen=True, slots=True)
class _Leg:
    """A straight way in poses with its timing."""

    start: np.ndarray
    way: np.ndarray
    duration_s: float
    ramp: float

    def progress_at(self, time_s: np.ndarray) -> np.ndarray:
        if self.duration_s == 0.0:
            return np.zeros_like(time_s)
        return progress(time_s / self.duration_s, self.ramp)

    def time_left(self, left: float) -> float:
        """The time from which the progress that is left is at most ``left`` (a share)."""
        done = self.progress_at(_GRID * self.duration_s)
        return float(np.argmax(done >= 1.0 - left)) / (len(_GRID) - 1) * self.duration_s


def _leg(arm: Arm, start: Pose, goal: Pose) -> _Leg:
    first, way = np.array(start), np.array(goal) - np.array(start)
    if np.max(np.abs(way)) < 1e-6:
        return _Leg(first, way, 0.0, 0.5)
    q = arm.joints(first + _GRID[:, None] * way)
    slew, r = (first[:2] + _GRID[:, None] * way[:2]).T
    pin = np.column_stack([r * np.cos(slew), r * np.sin(slew)])
    best = (np.inf, 0.5)
    for ramp in _RAMPS:
        done = progress(_GRID, ramp)
        timed = np.column_stack([np.interp(done, _GRID, column) for column in q.T])
        duration = max(_SHORTEST_S, _load(arm, timed, _GRID[1]))
        xy = np.column_stack([np.interp(done, _GRID, column) for column in pin.T])
        while duration < best[0] and _sway_m(xy, duration) > SWAY_M:
            duration *= 1.05
        best = min(best, (duration, ramp))
    return _Leg(first, way, *best)


def _run(arm: Arm, legs: Sequence[tuple[float, _Leg]]) -> Trajectory:
    """The sum of legs, each from its starting time, slowed down as a whole if their overlap asks for it."""
    end_s = max(at + leg.duration_s for at, leg in legs)

    def sampled(stretch: float) -> np.ndarray:
        time = np.arange(int(np.ceil(end_s * stretch / STEP_S)) + 2) * STEP_S / stretch
        ways = sum(leg.progress_at(time - at)[:, None] * leg.way for at, leg in legs)
        return arm.joints(legs[0][1].start + ways)

    q = sampled(1.0)
    load = _load(arm, q, STEP_S)
    return _table(q if load <= 1.0 else sampled(load * 1.005))


def straight(arm: Arm, start: Pose, goal: Pose) -> Trajectory:
    """A straight line in poses; vertical when only the height differs."""
    return _run(arm, [(0.0, _leg(arm, start, goal))])


def travel(arm: Arm, start: Pose, goal: Pose, height_m: float, free_m: float = 0.0) -> Trajectory:
    """To ``height_m``, over, and down to the goal, with rounded corners.

    With ``free_m`` the pin may rise on the way, as long as it is up ``free_m`` before the goal; without, it goes
    sideways only when it is almost up.
    """
    up = _leg(arm, start, start.at_height(height_m))
    over = _leg(arm, start.at_height(height_m), goal.at_height(height_m))
    down = _leg(arm, goal.at_height(height_m), goal)
    rise, drop = abs(up.way[2]), abs(down.way[2])
    way_m = float(np.hypot(over.way[0] * max(start.r_m, goal.r_m), over.way[1]))
    over_at = up.time_left(_RISE_LEFT_M / rise) if rise > _RISE_LEFT_M else 0.0
    if 0.0 < free_m < way_m:
        over_at = max(0.0, up.duration_s - over.time_left(free_m / way_m))
    down_at = over_at + (over.time_left(_WAY_LEFT_M / way_m) if way_m > _WAY_LEFT_M else 0.0)
    down_at = max(down_at, up.duration_s if drop else 0.0)
    return _run(arm, [(0.0, up), (over_at, over), (down_at, down)])


def follow(arm: Arm, start: Pose, path: Callable[[float], Pose], end_s: float, blend_s: float) -> Trajectory:
    """A motion along given poses over time; what ``start`` is off the path at time 0 fades out within
    ``blend_s``.
    """
    time = np.arange(int(np.ceil(end_s / STEP_S)) + 1) * STEP_S
    nominal = np.array([path(t) for t in time])
    fade = 1.0 - progress(time / blend_s, 0.5)
    return _table(arm.joints(nominal + fade[:, None] * (np.array(start) - nominal[0])))
