"""What a grasp planner proposes: one grasp in the base frame, with what it expects to come up and why.

A planner is a callable ``(arm, logs, slew_rad, rot_rad, stay=()) -> GraspCandidate``; it raises ``NoGrasp``.  ``stay``
are places in the list: those logs are to stay lying, but they are there and in the way.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from autonomy.grasp.grasp import Grasp
from autonomy.missions.crane_job import Mission
from autonomy.motion.arm import Arm
from autonomy.perception.log_list.observation import LogObservation


class NoGrasp(ValueError):
    """No log can be picked or placed; the message says which and why."""


class BunkFull(NoGrasp):
    """A log has no room in the bunk."""


@dataclass(frozen=True, slots=True)
class GraspCandidate:
    """Where the middle between the tips comes to (base frame), how it is turned and what comes up.

    ``yaw_rad`` is the direction of the opening axis; ``support_z_m`` the height that the tips sweep along, just above
    it.  ``logs`` are places in the list that was planned from.
    ``probability`` is that of success as the planner sees it, ``reason`` one sentence.  ``pressed``: the tongs go down
    among logs, and close where they meet too much; ``drawn``: one of them between two that touch, to draw one out.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    support_z_m: float
    logs: tuple[int, ...]
    probability: float
    reason: str
    pressed: bool = False
    drawn: bool = False


class GraspPlanner(Protocol):
    """See the module."""

    def __call__(
        self,
        arm: Arm,
        logs: Sequence[LogObservation],
        slew_rad: float,
        rot_rad: float,
        stay: Collection[int] = (),
    ) -> GraspCandidate: ...


class GraspSelector(Protocol):
    """See the module."""

    def __call__(
        self, arm: Arm, mission: Mission, logs: Sequence[LogObservation], slew_rad: float, rot_rad: float
    ) -> Grasp: ...
