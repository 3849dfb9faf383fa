"""Motion planners behind one protocol: time-optimal clear paths, or paper B's movement primitives.

An activity requests a motion from rest to rest past the obstacles of a scene, with a load in the grapple.  Failure:
``Unreachable`` where no motion is clear.  No clock, no randomness.
"""

from __future__ import annotations

from typing import Final, Protocol

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.clearance import MARGIN_M, clearance_reserve
from autonomy.motion.movement_primitives import PrimitiveMotions, Primitives
from autonomy.motion.obstacles import CollisionScene, HeldLog
from autonomy.motion.path_search import PathBlocked, plan_path
from autonomy.motion.trajectory import Trajectory, travel_over
from machine.geometry.kinematics import Unreachable


class MotionPlanner(Protocol):
    """Plans a motion from rest to rest.

    ``direct``: one motion leads down to a log, or with it up, over and down into the bunk; otherwise an activity
    requests each of these alone.  ``free_telescope``: the planner is fastest with the telescope far out at a log
    (`Arm`).  ``turns_rotator``: whether the planner of the crane job may turn the grapple.  ``knows_load``: whether a
    full bunk ends the loading.
    """

    @property
    def turns_rotator(self) -> bool:
        """Whether the rotator is turned for a log and for its place; otherwise it stays as it is."""

    @property
    def knows_load(self) -> bool:
        """Whether the height of the load is estimated; otherwise logs are laid on it until none is left."""

    @property
    def direct(self) -> bool:
        """Whether a motion may begin and end beside a log or between the stakes."""

    @property
    def free_telescope(self) -> bool:
        """Whether the extension at a log is free."""

    def __call__(
        self,
        arm: Arm,
        start: Pose,
        goal: Pose,
        scene: CollisionScene,
        held: HeldLog | None,
        high_m: float,
        free_m: float,
    ) -> Trajectory:
        """Plan the motion.

        ``high_m`` is the height at which `travel_over` would pass, reached ``free_m`` before the goal.

        Raises:
            machine.geometry.kinematics.Unreachable: no motion is clear.
        """


class TimeOptimalPlanner:
    """The fastest clear motion; where none is found, the one at full height if that is clear."""

    def __init__(self, direct: bool = True) -> None:
        self.direct: Final = direct
        self.free_telescope: Final = True
        self.turns_rotator: Final = True
        self.knows_load: Final = True

    def __call__(
        self,
        arm: Arm,
        start: Pose,
        goal: Pose,
        scene: CollisionScene,
        held: HeldLog | None,
        high_m: float,
        free_m: float,
    ) -> Trajectory:
        """Plan the fastest clear motion."""
        try:
            return plan_path(arm, start, goal, scene, held).motion
        except PathBlocked as error:
            slow = _at_full_height(arm, start, goal, high_m, free_m, error)
            if clearance_reserve(arm, slow, scene, held)[0] < 0.0:
                raise
            return slow


class MovementPrimitivePlanner:
    """Paper B's movement primitives, learned from demonstrations.

    Primitives know no obstacles; where one would touch something, the motion at full height replaces it.
    """

    def __init__(self, primitives: Primitives) -> None:
        self.direct: Final = False
        self.free_telescope: Final = False
        """The demonstrations have other postures."""
        self.turns_rotator: Final = False
        """Paper B neither measures nor controls it (3.1): logs lie at an angle to the path, as its grapple hangs."""
        self.knows_load: Final = False
        """Paper B has no method to estimate when the bunk is full (3.1)."""
        self._shown = PrimitiveMotions(primitives)

    def __call__(
        self,
        arm: Arm,
        start: Pose,
        goal: Pose,
        scene: CollisionScene,
        held: HeldLog | None,
        high_m: float,
        free_m: float,
    ) -> Trajectory:
        """Plan the primitive from start to goal."""
        motions, trouble = [], Unreachable("", "motion.primitive-blocked")
        # The final extension decides how well the demonstrations fit; it may also stay as it is.
        for ext_m in (goal.ext_m, 0.5 * (start.ext_m + goal.ext_m), start.ext_m):
            try:
                motions.append(self._shown(arm, start, goal._replace(ext_m=ext_m)))
            except Unreachable as error:
                trouble = error
        for motion in sorted(motions, key=lambda m: m.duration_s)[:1]:
            spare_m, why = clearance_reserve(arm, motion, scene, held)
            if spare_m >= -MARGIN_M:
                return motion
            trouble = Unreachable(why, "motion.primitive-blocked")
        return _at_full_height(arm, start, goal, high_m, free_m, trouble)


def _at_full_height(
    arm: Arm, start: Pose, goal: Pose, high_m: float, free_m: float, trouble: Unreachable
) -> Trajectory:
    """Plan the motion at full height; raise ``trouble``, the failure of the better one, where it is out of reach."""
    try:
        return travel_over(arm, start, goal, max(high_m, start.z_m, goal.z_m), free_m)
    except Unreachable:
        raise trouble from None
