"""A goal's motion before it begins: the checks that the controller's gate makes of its setpoints, over all of it.

The gate remains the judge: it checks every setpoint again when it comes.  Here a goal that it would refuse half way is
refused before the crane moves.  Accelerations the gate does not check; here they must be within the profile's.
"""

from __future__ import annotations

from math import nan
from typing import Final

from autonomy.motion.setpoint_stream import HORIZON_KNOT_COUNT, PERIOD_NS, Motion
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot
from controller.crane.trajectory import Trajectory
from controller.crane.trajectory_check import TrajectoryCheck
from controller.crane.workspace_check import MAX_KNOTS_CHECKED, WorkspaceCheck
from controller.requests.setpoint_gate import RequestRefused
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint
from machine.status.explanation import sentence_of
from ros2.execution.goal_motion import GoalMotion, unit_of
from ros2.execution.goal_refused import GoalRefused
from ros2.interfaces.control import ErrorCode

ROUNDING_SHARE: Final = 1.0 + 1e-6
_UNKNOWN: Final = (nan,) * N_JOINTS
_KNOTS: Final = min(HORIZON_KNOT_COUNT, MAX_KNOTS_CHECKED)
"""Knots of a window: few enough that the check of the workspace looks at each."""


class MotionCheck:
    """Checks motions against one profile."""

    def __init__(self, profile: Profile) -> None:
        self._trajectory, self._workspace = TrajectoryCheck(profile), WorkspaceCheck(profile)
        self._candidate = Trajectory()
        self._acceleration = [joint(profile, j).acceleration_limit for j in JOINTS]

    def check(self, asked: GoalMotion) -> None:
        """Check a motion from its start to its end.

        Raises:
            GoalRefused: the gate would refuse a setpoint of it, or it accelerates more than a joint can.
        """
        self._check_setpoints(asked.trajectory)
        for j, limit in zip(JOINTS, self._acceleration, strict=True):
            if asked.accelerations[j] > limit * ROUNDING_SHARE:
                raise GoalRefused(
                    "ros2.goal-acceleration",
                    f"the goal accelerates {j.name.lower()} by {asked.accelerations[j]:.2f} {unit_of(j)}/s^2 and "
                    f"{limit:.2f} are allowed; give it more time",
                    ErrorCode.INVALID_GOAL,
                )

    def _check_setpoints(self, motion: Motion) -> None:
        """Raises GoalRefused."""
        window_s = _KNOTS * PERIOD_NS * 1e-9
        for window in range(int(motion.duration_s / window_s) + 1):
            begin_s = window * window_s
            try:
                self._check_window(motion, begin_s)
            except RequestRefused as refused:
                raise GoalRefused(
                    "ros2.goal-limits",
                    f"{sentence_of(refused.reason, refused.detail)}, {begin_s:.1f} to {begin_s + window_s:.1f} s after "
                    "the start; change the goal",
                    ErrorCode.INVALID_GOAL,
                ) from None

    def _check_window(self, motion: Motion, begin_s: float) -> None:
        """Raises RequestRefused."""
        knots = tuple(Knot(i * PERIOD_NS, *motion.at(begin_s + i * PERIOD_NS * 1e-9)) for i in range(_KNOTS + 1))
        final = begin_s + _KNOTS * PERIOD_NS * 1e-9 >= motion.duration_s
        setpoint = CraneSetpoint(0, 0, 0, 0, GrappleCommand.NEUTRAL, final, knots)
        self._trajectory.load_and_check(setpoint, self._candidate, _UNKNOWN, _UNKNOWN, 0)
        self._workspace.check(knots)
