"""The motion that a goal asks for: cubics from where the crane is through the goal's points, at rest at both ends.

With velocities the cubics have them at the points.  Without, the velocities are those of a monotone interpolation
(Fritsch and Carlson 1980), so no joint goes beyond its points; the crane stands still at the end.  Joints that the goal
does not name keep their place.  Accelerations in the goal are not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from autonomy.crane_job.trajectory_tracker import ARRIVAL_TOLERANCE
from autonomy.motion.trajectory import STEP_S, Trajectory
from machine.joints import JOINTS, N_JOINTS, Joint
from ros2.interfaces.builtin import NS_PER_S, nanoseconds
from ros2.interfaces.control import ErrorCode, Goal, JointTolerance
from runtime.errors import TimberhandError

MAX_POINTS: Final = 10_000
MAX_DURATION_S: Final = 600.0
_ROUNDING: Final = 1e-6


@dataclass(frozen=True, slots=True)
class GoalMotion:
    """A goal's motion: the joints that it names, in its order, the times of its points [s], and the trajectory
    of all joints.
    """

    joints: tuple[Joint, ...]
    times_s: tuple[float, ...]
    trajectory: Trajectory
    accelerations: Axes
    """The greatest of each joint, rad/s^2 (EXT m/s^2)."""


def goal_motion(goal: Goal, start: Axes) -> GoalMotion:
    """Compute the motion of a goal from ``start`` (`Joint` order, rad, EXT m), where the crane is at rest.

    Raises:
        GoalRefused: the goal is incomplete or contradictory, or does not begin at ``start``.
    """
    joints = _joints(goal)
    points = goal.trajectory.points
    if not 0 < len(points) <= MAX_POINTS:
        raise _invalid("ros2.goal-points", f"the goal has {len(points)} points; send 1 to {MAX_POINTS}")
    given = np.array([_numbers(p.positions, len(joints), "positions", i) for i, p in enumerate(points)])
    times = [nanoseconds(p.time_from_start) / NS_PER_S for p in points]
    if times[0] < 0.0 or any(a >= b for a, b in pairwise(times)):
        raise _invalid("ros2.goal-times", "the times of the goal's points do not grow; send them in order, from 0 on")
    if times[-1] > MAX_DURATION_S:
        raise _invalid("ros2.goal-times", f"the goal takes {times[-1]:.0f} s; at most {MAX_DURATION_S:.0f} s")
    speeds = _speeds(goal, len(joints))
    columns = list(joints)
    if times[0] == 0.0:
        _check_start(given[0], joints, start)
        if len(times) == 1:
            raise _invalid("ros2.goal-times", "the goal's only point has the time 0; say when the crane shall be there")
        times, given = times[1:], given[1:]
        speeds = None if speeds is None else speeds[1:]
    position = np.tile(np.array(start), (len(times) + 1, 1))
    position[1:, columns] = given
    velocity = np.zeros_like(position)
    knots = np.array([0.0, *times])
    if speeds is not None:
        velocity[1:, columns] = speeds
    elif len(times) > 1:
        velocity[1:-1] = PchipInterpolator(knots, position).derivative()(knots[1:-1])
    curve = CubicHermiteSpline(knots, position, velocity)
    return GoalMotion(joints, tuple(times), _sampled(curve, knots[-1]), _accelerations(curve))


def _joints(goal: Goal) -> tuple[Joint, ...]:
    multi = goal.multi_dof_trajectory
    if multi.joint_names or multi.points or goal.component_path_tolerance or goal.component_goal_tolerance:
        raise _invalid(
            "ros2.goal-multi-dof", "the goal is for joints with several degrees of freedom; a crane has none"
        )
    names = list(goal.trajectory.joint_names)
    known = {j.name.lower(): j for j in JOINTS}
    wrong = sorted({name for name in names if name not in known or names.count(name) > 1})
    if wrong or not names:
        fault = f"the goal names {', '.join(map(repr, wrong))}" if wrong else "the goal names no joint"
        raise GoalRefused(
            "ros2.goal-joints",
            f"{fault}; name each of these at most once: {', '.join(known)}",
            ErrorCode.INVALID_JOINTS,
        )
    return tuple(known[name] for name in names)


def _numbers(values: Sequence[float], count: int, what: str, point: int) -> list[float]:
    if len(values) != count or not all(map(math.isfinite, values)):
        raise _invalid("ros2.goal-values", f"point {point} of the goal needs {count} {what}, each a finite number")
    return list(values)


def _speeds(goal: Goal, count: int) -> np.ndarray | None:
    """Return the velocities of all points (n, joints); None when the goal has none."""
    points = goal.trajectory.points
    if not any(len(p.velocities) for p in points):
        return None
    speeds = np.array(
        [_numbers(p.velocities, count, "velocities, as other points have", i) for i, p in enumerate(points)]
    )
    if np.any(np.abs(speeds[-1]) > _ROUNDING):
        raise _invalid("ros2.goal-moving", "the goal ends in motion; give its last point velocities of 0")
    speeds[-1] = 0.0
    if nanoseconds(points[0].time_from_start) == 0 and np.any(np.abs(speeds[0]) > _ROUNDING):
        raise _invalid("ros2.goal-moving", "the goal begins in motion; give its point at time 0 velocities of 0")
    return speeds


def _check_start(first: np.ndarray, joints: tuple[Joint, ...], start: Axes) -> None:
    for j, value in zip(joints, first.tolist(), strict=True):
        if abs(value - start[j]) > ARRIVAL_TOLERANCE[j]:
            raise _invalid(
                "ros2.goal-start",
                f"the goal begins with {j.name.lower()} at {value:.3f} {unit_of(j)} and the crane is at {start[j]:.3f} "
                f"{unit_of(j)}; begin where it is, or leave the point at time 0 out",
            )


def _accelerations(curve: CubicHermiteSpline) -> Axes:
    """Find the greatest accelerations: each is linear along a cubic, so its ends have the greatest."""
    cubic, square = curve.c[0], curve.c[1]
    ends = np.stack([2.0 * square, 6.0 * cubic * np.diff(curve.x)[:, None] + 2.0 * square])
    return tuple(np.max(np.abs(ends), axis=(0, 1)).tolist())


def _sampled(curve: CubicHermiteSpline, end_s: float) -> Trajectory:
    """Sample the curve every `STEP_S`; the last sample is at rest at the end."""
    time = np.minimum(np.arange(math.ceil(end_s / STEP_S - _ROUNDING) + 1) * STEP_S, end_s)
    position, velocity = curve(time), curve(time, 1)
    velocity[0] = velocity[-1] = np.zeros(N_JOINTS)
    return Trajectory([tuple(q) for q in position.tolist()], [tuple(v) for v in velocity.tolist()])


def unit_of(j: Joint) -> str:
    """Return the unit of a joint's position."""
    return "m" if j is Joint.EXT else "rad"


def _invalid(code: str, sentence: str) -> GoalRefused:
    return GoalRefused(code, sentence, ErrorCode.INVALID_GOAL)


# -- Why a goal is not executed.


class GoalRefused(TimberhandError, ValueError):
    """A goal that is not executed; ``error_code`` is that of its result (`ros2.interfaces.control.ErrorCode`)."""

    def __init__(self, code: str, sentence: str, error_code: int) -> None:
        super().__init__(code, sentence)
        self.error_code = error_code


# -- The tolerances of a goal, by joint; ``control_msgs``: 0 is the server's default, a negative one is none.

GOAL_TIME_S: Final = 20.0
"""Default time after the planned end in which the crane must arrive: end positioning inches with pauses."""
_NONE: Final = (math.inf,) * len(JOINTS)

Axes = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Greatest distance of each joint from the motion, and from its goal at the end [rad, EXT m], and the time [s] that
    the arrival may take longer.
    """

    path: Axes
    goal: Axes
    time_s: float


def tolerances_of(goal: Goal) -> Tolerances:
    """Return the tolerances of a goal.

    Raises:
        GoalRefused: one is for an unknown joint, or for a velocity or an acceleration.
    """
    time_s = nanoseconds(goal.goal_time_tolerance) / NS_PER_S
    return Tolerances(
        _by_joint(goal.path_tolerance, _NONE),
        _by_joint(goal.goal_tolerance, ARRIVAL_TOLERANCE),
        GOAL_TIME_S if time_s == 0.0 else math.inf if time_s < 0.0 else time_s,
    )


def beyond(errors: Sequence[float], tolerance: Axes) -> Joint | None:
    """Find the joint that is farthest beyond its tolerance, if any is."""
    share, worst = max((abs(error) / limit, j) for error, limit, j in zip(errors, tolerance, JOINTS, strict=True))
    return worst if share > 1.0 else None


def _by_joint(given: Sequence[JointTolerance], default: Axes) -> Axes:
    joint_tolerances = list(default)
    for tolerance in given:
        joint = next((j for j in JOINTS if j.name.lower() == tolerance.name), None)
        if joint is None:
            raise GoalRefused(
                "ros2.goal-tolerance",
                f"a tolerance is for joint {tolerance.name!r}, which this crane does not have",
                ErrorCode.INVALID_JOINTS,
            )
        if tolerance.velocity > 0.0 or tolerance.acceleration > 0.0 or math.isnan(tolerance.position):
            raise GoalRefused(
                "ros2.goal-tolerance",
                f"the tolerance of {tolerance.name} is not one of position; give no other",
                ErrorCode.INVALID_GOAL,
            )
        if tolerance.position != 0.0:
            joint_tolerances[joint] = tolerance.position if tolerance.position > 0.0 else math.inf
    return tuple(joint_tolerances)
