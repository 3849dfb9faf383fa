"""Smooth, synchronized joint motions between poses with little residual swing of the grapple.

A leg is a straight line in poses, driven by a time law of `autonomy.motion.time_law`.  Legs over different
coordinates may overlap; a motion has at most one leg that moves the pin sideways, so that leg's law decides about the
swing.  Failure: ``machine.geometry.kinematics.Unreachable``.  No clock: a plan is a function of its own time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.time_law import MIN_DURATION_S, PathGeometry, swing_free_law
from machine.geometry.kinematics import Unreachable
from machine.joints import Joint

STEP_S: Final = 0.02
_GENTLE_SHARE: Final = 0.5
"""Share of the acceleration limits that `joint_motion` uses."""
_PROGRESS_GRID: Final = np.linspace(0.0, 1.0, 81)
_RISE_LEFT_M: Final = 0.12
"""Rise that may be left when a grapple begins to move sideways."""
_APPROACH_LEFT_M: Final = 0.35
"""Horizontal distance that may be left when a grapple begins to descend."""
_TOLERANCE: Final = 1e-6
_MAX_FURTHER_STRETCH: Final = 2.0
"""A motion that needs more than this beyond its first stretch cannot be slowed."""
_STRETCH_TOLERANCE: Final = 0.004
"""A stretched motion may exceed a limit of `Arm` by this share (accelerations by twice as much): they leave 1 % at
least to the machine's own."""
_MAX_SLOPE, _MAX_CURVATURE = 2.1875, 7.5132
"""Greatest slope and curvature of `smooth_progress`."""

Axes = tuple[float, ...]


def smooth_progress(tau: np.ndarray) -> np.ndarray:
    """Compute the progress 0..1 over ``tau`` = time / duration (clipped), at rest up to the jerk at both ends
    (docs/reference/machines.md section 1.6)."""
    t = np.clip(tau, 0.0, 1.0)
    progress: np.ndarray = t**4 * (35.0 + t * (-84.0 + t * (70.0 - 20.0 * t)))
    return progress


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
        """Interpolate joint positions and velocities at a time; at rest before the start and past the end."""
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


def _curve(position: np.ndarray) -> CubicSpline:
    """Return positions every ``STEP_S``, from rest to rest, as a curve with continuous acceleration."""
    return CubicSpline(np.arange(len(position)) * STEP_S, position, bc_type="clamped")


def _sampled_trajectory(position: np.ndarray) -> Trajectory:
    curve = _curve(position)
    return Trajectory([tuple(q) for q in position.tolist()], [tuple(v) for v in curve(curve.x, 1).tolist()])


def with_rotation(arm: Arm, motion: Trajectory, from_s: float, by_rad: float) -> Trajectory | None:
    """Return the motion with the rotator turned by ``by_rad`` more between a time and its end; None where the rest of
    it is too short for that.
    """
    position, velocity = np.array(motion.position), np.array(motion.velocity)
    span_s = motion.duration_s - from_s
    if span_s < float(np.sqrt(_MAX_CURVATURE * abs(by_rad) / arm.acceleration[Joint.ROT])) or span_s <= 0.0:
        return None
    time = (np.arange(len(position)) * STEP_S - from_s) / span_s
    done = smooth_progress(time)
    position[:, Joint.ROT] += by_rad * done
    t = np.clip(time, 0.0, 1.0)
    velocity[:, Joint.ROT] += by_rad * 140.0 * t**3 * (1.0 - t) ** 3 / span_s
    if np.max(np.abs(velocity[:, Joint.ROT])) > arm.speed[Joint.ROT]:
        return None
    return Trajectory([tuple(q) for q in position.tolist()], [tuple(v) for v in velocity.tolist()])


def with_quick_rotation(arm: Arm, motion: Trajectory) -> Trajectory:
    """Return the motion with its rotator turn made in one quick move, at the time when half of it was due.

    For a rotator without an encoder: the valve's opening is known to a few per mille of its stroke, which loses a third
    of a slow turn (measured on the plant: 6 deg of 23 over 6 s) and nothing of a quick one.
    """
    position, velocity = np.array(motion.position), np.array(motion.velocity)
    angle = position[:, Joint.ROT]
    turn = float(angle[-1] - angle[0])
    speed, push = arm.speed[Joint.ROT], arm.acceleration[Joint.ROT]
    span_s = max(_MAX_SLOPE * abs(turn) / speed, float(np.sqrt(_MAX_CURVATURE * abs(turn) / push)), MIN_DURATION_S)
    quicker = span_s < motion.duration_s and _MAX_SLOPE * abs(turn) / span_s > np.max(np.abs(velocity[:, Joint.ROT]))
    if not quicker or np.ptp(angle) > abs(turn) + _TOLERANCE:
        return motion
    half_s = float(np.argmin(np.abs(angle - angle[0] - 0.5 * turn))) * STEP_S
    begin_s = min(max(half_s - 0.5 * span_s, 0.0), motion.duration_s - span_s)
    t = np.clip((np.arange(len(position)) * STEP_S - begin_s) / span_s, 0.0, 1.0)
    position[:, Joint.ROT] = angle[0] + turn * smooth_progress(t)
    velocity[:, Joint.ROT] = turn * 140.0 * t**3 * (1.0 - t) ** 3 / span_s
    return Trajectory([tuple(q) for q in position.tolist()], [tuple(v) for v in velocity.tolist()])


def hold(q: Sequence[float]) -> Trajectory:
    """Return a hold at a joint position."""
    return _sampled_trajectory(np.array([q, q], dtype=float))


class TimeLaw(Protocol):
    """Progress along a path over time."""

    @property
    def duration_s(self) -> float:
        """Time of its end."""

    def progress(self, time_s: np.ndarray) -> np.ndarray:
        """Compute the progress (0 to 1) at times; 0 before and 1 after the motion."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A straight path in poses with its time law; None where start and goal are the same."""

    start: np.ndarray
    delta: np.ndarray
    law: TimeLaw | None

    @property
    def duration_s(self) -> float:
        """Duration of the leg alone."""
        return self.law.duration_s if self.law else 0.0

    def progress_at(self, time_s: np.ndarray) -> np.ndarray:
        """Compute the progress at times from the leg's own start."""
        return self.law.progress(time_s) if self.law else np.zeros_like(time_s)

    def times_left(self, *left: float) -> list[float]:
        """Find the times from which on at most these shares of the progress are left."""
        done = self.progress_at(_PROGRESS_GRID * self.duration_s)
        return [float(_PROGRESS_GRID[np.argmax(done >= 1.0 - share)]) * self.duration_s for share in left]


def make_leg(arm: Arm, start: Pose, goal: Pose, law: Callable[[PathGeometry], TimeLaw] = swing_free_law) -> Leg:
    """Make the straight path from start to goal, driven by a time law."""
    start_pose, delta = np.array(start), np.array(goal) - np.array(start)
    if np.max(np.abs(delta)) < _TOLERANCE:
        return Leg(start_pose, delta, None)
    return Leg(start_pose, delta, law(_path_geometry(arm, start_pose, delta)))


def _path_geometry(arm: Arm, first: np.ndarray, delta: np.ndarray) -> PathGeometry:
    return PathGeometry(arm, first + _PROGRESS_GRID[:, None] * delta)


def superposed(arm: Arm, legs: Sequence[tuple[float, Leg]]) -> Trajectory:
    """Sum up legs, each from its starting time, slowed down as a whole if their overlap exceeds the limits."""
    end_s = max(at + leg.duration_s for at, leg in legs)

    def sampled(duration_s: float) -> np.ndarray:
        steps = max(1, int(np.ceil(duration_s / STEP_S)))
        time = np.linspace(0.0, end_s, steps + 1)
        return arm.joints(legs[0][1].start + sum(leg.progress_at(time - at)[:, None] * leg.delta for at, leg in legs))

    return within_limits(arm, sampled, end_s, arm.sampled_acceleration if len(legs) == 1 else arm.acceleration)


def within_limits(
    arm: Arm, sampled: Callable[[float], np.ndarray], end_s: float, accelerations: np.ndarray | None = None
) -> Trajectory:
    """Return a motion of ``end_s``, or longer if the arm's limits (or these ``accelerations``) require it.

    ``sampled(duration_s)`` gives its joint vectors (n, 5) every ``STEP_S``, from rest to rest.

    Raises:
        machine.geometry.kinematics.Unreachable: no duration keeps the motion within the limits.
    """
    accelerations = arm.acceleration if accelerations is None else accelerations
    q, duration_s = sampled(end_s), end_s
    load = _time_stretch(arm, q, accelerations)
    if load <= 1.0:
        return _sampled_trajectory(q)
    # The slower motion is sampled elsewhere on its path and may need a little more: it is checked again.
    stretched_s = load * duration_s
    longest_s = _MAX_FURTHER_STRETCH * stretched_s
    while stretched_s <= longest_s:
        q, duration_s = sampled(stretched_s), stretched_s
        load = _time_stretch(arm, q, accelerations)
        if load <= 1.0 + _STRETCH_TOLERANCE:
            return _sampled_trajectory(q)
        stretched_s = max(load * duration_s, duration_s + STEP_S)
    raise Unreachable("no duration keeps the motion within the limits of the joints", "motion.over-limits")


def _time_stretch(arm: Arm, position: np.ndarray, accelerations: np.ndarray) -> float:
    """Compute the factor by which a motion sampled every ``STEP_S`` must be stretched in time to keep the arm's limits
    and these ``accelerations`` (1 = just within).
    """
    curve = _curve(position)
    velocity, acceleration = curve(curve.x, 1), curve(curve.x, 2)
    speed = max(np.max(np.abs(velocity) / arm.speed), np.max(arm.pump_load(position, velocity)))
    return float(max(speed, np.sqrt(np.max(np.abs(acceleration) / accelerations))))


def straight_line(arm: Arm, start: Pose, goal: Pose, shaped: bool = True) -> Trajectory:
    """Plan a straight line in poses; vertical when only the height differs.

    ``shaped=False``, for comparison, takes as long without regard to swing: it is the fastest law, evenly slowed.
    """
    line = make_leg(arm, start, goal)
    motion = superposed(arm, [(0.0, line)])
    if shaped or line.law is None:
        return motion
    plain = swing_free_law(_path_geometry(arm, line.start, line.delta), shaped=False).slowed(motion.duration_s)
    return superposed(arm, [(0.0, Leg(line.start, line.delta, plain))])


def travel_over(arm: Arm, start: Pose, goal: Pose, height_m: float, free_m: float = 0.0) -> Trajectory:
    """Travel up to ``height_m``, over, and down to the goal, with rounded corners.

    With ``free_m`` the pin may rise while it moves sideways, as long as it is up ``free_m`` before the goal; without,
    it moves sideways only when it is almost up.
    """
    up = make_leg(arm, start, start.at_height(height_m))
    over = make_leg(arm, start.at_height(height_m), goal.at_height(height_m))
    down = make_leg(arm, goal.at_height(height_m), goal)
    rise, drop = abs(up.delta[2]), abs(down.delta[2])
    travel_m = float(np.hypot(over.delta[0] * max(start.r_m, goal.r_m), over.delta[1]))
    over_at = up.times_left(_RISE_LEFT_M / rise)[0] if rise > _RISE_LEFT_M else 0.0
    if 0.0 < free_m < travel_m:
        over_at = max(0.0, up.duration_s - over.times_left(free_m / travel_m)[0])
    down_at = over_at + (over.times_left(_APPROACH_LEFT_M / travel_m)[0] if travel_m > _APPROACH_LEFT_M else 0.0)
    down_at = max(down_at, up.duration_s if drop else 0.0)
    return superposed(arm, [(0.0, up), (over_at, over), (down_at, down)])


def joint_motion(arm: Arm, start: Sequence[float], goal: Sequence[float]) -> Trajectory:
    """Move every joint straight from start to goal, synchronized and gentle, whatever the arm's reach."""
    start_position, delta = np.array(start, dtype=float), np.array(goal, dtype=float) - np.array(start, dtype=float)
    tau = np.linspace(0.0, 1.0, 121)
    done = smooth_progress(tau)
    speed = np.gradient(done, tau[1])
    steepest = float(np.max(np.abs(np.gradient(speed, tau[1]))))
    fastest = float(np.max(np.abs(delta) / arm.speed)) * float(np.max(speed))
    pushed = float(np.sqrt(np.max(np.abs(delta) / (_GENTLE_SHARE * arm.acceleration)) * steepest))
    duration = max(MIN_DURATION_S, fastest, pushed)
    time = np.arange(int(np.ceil(duration / STEP_S)) + 2) * STEP_S
    return _sampled_trajectory(start_position + smooth_progress(time / duration)[:, None] * delta)


def slow_line(arm: Arm, start: Pose, goal: Pose, least_s: float) -> Trajectory:
    """Plan a straight line in poses in ``least_s``, or longer if the arm's limits require it."""
    start_pose, delta = np.array(start), np.array(goal) - np.array(start)

    def sampled(duration_s: float) -> np.ndarray:
        time = np.arange(int(np.ceil(duration_s / STEP_S)) + 1) * STEP_S
        return arm.joints(start_pose + smooth_progress(time / duration_s)[:, None] * delta)

    return within_limits(arm, sampled, least_s)


def joined(*motions: Trajectory) -> Trajectory:
    """Join motions one after the other, each from where the one before ends, at rest between them."""
    position, velocity = list(motions[0].position), list(motions[0].velocity)
    for motion in motions[1:]:
        position += motion.position[1:]
        velocity += motion.velocity[1:]
    return Trajectory(position, velocity)


def follow_path(arm: Arm, start: Pose, path: Callable[[float], Pose], end_s: float, blend_s: float) -> Trajectory:
    """Plan a motion along given poses over time; the initial offset of ``start`` from the path fades out within
    ``blend_s``."""
    time = np.arange(int(np.ceil(end_s / STEP_S)) + 1) * STEP_S
    nominal = np.array([path(t) for t in time])
    fade = 1.0 - smooth_progress(time / blend_s)
    return _sampled_trajectory(arm.joints(nominal + fade[:, None] * (np.array(start) - nominal[0])))
