"""Whose motions the crane makes: ours, clear of everything and straight to the place, or paper B's, as people showed.

An activity asks for a way from rest to rest and says what stands around and what hangs in the grapple; where no way is
clear it is told so.  No clock, no randomness.
"""

from __future__ import annotations

from typing import Final, Protocol

from autonomy.motion.arm import Arm
from autonomy.motion.clearance import MARGIN_M, clearance_reserve
from autonomy.motion.movement_primitives import Primitives, PrimitiveMotions
from autonomy.motion.obstacles import HeldLog, CollisionScene
from autonomy.motion.path_search import PathBlocked, plan_path
from autonomy.motion.pose import Pose
from autonomy.motion.trajectory import Trajectory, travel_over
from machine.geometry.kinematics import Unreachable


class MotionPlanner(Protocol):
    """A way from rest to rest.

    ``direct``: it goes down to a log, and with it up, over and down into the bunk, in one; else an activity asks for
    each of these alone.  ``free_telescope``: it is quickest with the telescope far out at a log (`Arm`).
    """

    @property
    def direct(self) -> bool:
        """Whether a way may begin and end beside a log or between the stakes."""

    @property
    def free_telescope(self) -> bool:
        """Whether the telescope may be anywhere."""

    def __call__(
        self, arm: Arm, start: Pose, goal: Pose, around: CollisionScene, held: HeldLog | None, high_m: float, free_m: float
    ) -> Trajectory:
        """The motion.  ``high_m``: where `travel_over` would pass, ``free_m`` before the goal.

        Raises:
            machine.geometry.kinematics.Unreachable: none that is clear; in one sentence.
        """


class TimeOptimalPlanner:
    """Ours: the fastest clear way; where none is found, always at full height, if that is clear."""

    def __init__(self, direct: bool = True) -> None:
        self.direct: Final = direct
        self.free_telescope: Final = True

    def __call__(
        self, arm: Arm, start: Pose, goal: Pose, around: CollisionScene, held: HeldLog | None, high_m: float, free_m: float
    ) -> Trajectory:
        """The fastest clear way."""
        try:
            return plan_path(arm, start, goal, around, held).motion
        except PathBlocked as error:
            slow = _at_full_height(arm, start, goal, high_m, free_m, error)
            if clearance_reserve(arm, slow, around, held)[0] < 0.0:
                raise
            return slow


class MovementPrimitivePlanner:
    """Paper B's: movement primitives that a person showed.

    They know no obstacles; one that would touch something is not driven, but the way at full height.
    """

    def __init__(self, primitives: Primitives) -> None:
        self.direct: Final = False
        self.free_telescope: Final = False
        """People showed other postures."""
        self._shown = PrimitiveMotions(primitives)

    def __call__(
        self, arm: Arm, start: Pose, goal: Pose, around: CollisionScene, held: HeldLog | None, high_m: float, free_m: float
    ) -> Trajectory:
        """The primitive from here to there."""
        found, trouble = [], Unreachable("")
        # Where the telescope ends decides how well what was shown fits; it may end where it began.
        for ext_m in (goal.ext_m, 0.5 * (start.ext_m + goal.ext_m), start.ext_m):
            try:
                found.append(self._shown(arm, start, goal._replace(ext_m=ext_m)))
            except Unreachable as error:
                trouble = error
        for motion in sorted(found, key=lambda m: m.duration_s)[:1]:
            spare_m, why = clearance_reserve(arm, motion, around, held)
            if spare_m >= -MARGIN_M:
                return motion
            trouble = Unreachable(why)
        return _at_full_height(arm, start, goal, high_m, free_m, trouble)


def _at_full_height(
    arm: Arm, start: Pose, goal: Pose, high_m: float, free_m: float, trouble: Unreachable
) -> Trajectory:
    """The way at full height; raises ``trouble``, what was wrong with the better one, where it is out of reach."""
    try:
        return travel_over(arm, start, goal, max(high_m, start.z_m, goal.z_m), free_m)
    except Unreachable:
        raise trouble from None
