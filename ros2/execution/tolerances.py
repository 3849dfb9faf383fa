"""The tolerances of a goal, by joint; ``control_msgs``: 0 is the server's default, a negative one is none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from autonomy.crane_job.trajectory_tracker import ARRIVAL_TOLERANCE
from machine.joints import JOINTS, Joint
from ros2.execution.goal_refused import GoalRefused
from ros2.interfaces.builtin import NS_PER_S, nanoseconds
from ros2.interfaces.control import ErrorCode, Goal, JointTolerance

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
    """The tolerances of a goal.

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
    """The joint that is farthest beyond its tolerance, if any is."""
    share, worst = max((abs(error) / limit, j) for error, limit, j in zip(errors, tolerance, JOINTS, strict=True))
    return worst if share > 1.0 else None


def _by_joint(given: Sequence[JointTolerance], default: Axes) -> Axes:
    found = list(default)
    for tolerance in given:
        which = next((j for j in JOINTS if j.name.lower() == tolerance.name), None)
        if which is None:
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
            found[which] = tolerance.position if tolerance.position > 0.0 else math.inf
    return tuple(found)
