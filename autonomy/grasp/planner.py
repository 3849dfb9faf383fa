"""The two contracts of grasp planning, and what passes between them.

A grasp planner looks at a log list and proposes one grasp candidate in the base frame.  A grasp selector turns a crane
job into the grasp that the crane executes; `autonomy.grasp.selection.PlannerSelection` wraps a planner as a selector.
Failure of both: ``NoGrasp``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from autonomy.grasp.grasp import Grasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm import Arm
from autonomy.perception.log_list.observation import LogObservation
from runtime.errors import TimberhandError


class NoGrasp(TimberhandError, ValueError):
    """No log can be picked or placed; the sentence says which and why."""


class BunkFull(NoGrasp):
    """A log has no room in the bunk."""


@dataclass(frozen=True, slots=True)
class GraspRequest:
    """What a grasp planner plans from: machine and load, the log list, and the present rotator angle [rad].

    ``stay`` holds indices into ``logs``: these logs must not be gripped, but they are obstacles.
    """

    arm: Arm
    logs: Sequence[LogObservation]
    rot_rad: float
    stay: Collection[int] = ()


@dataclass(frozen=True, slots=True)
class GraspCandidate:
    """One proposed grasp: the point midway between the tips (base frame), the opening axis, and the logs it lifts.

    ``yaw_rad`` is the direction of the opening axis.  The tips sweep just above ``support_z_m``.  ``logs`` holds
    indices into the request's log list.  ``probability`` is the planner's estimate of success, ``reason`` one
    sentence for the operator.  ``penetrates``: the open jaws go down among logs and close where these stop them.
    ``extracts``: one jaw goes down between two logs that touch, to draw one of them out of a row.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    support_z_m: float
    logs: tuple[int, ...]
    probability: float
    reason: str
    penetrates: bool = False
    extracts: bool = False


class GraspPlanner(Protocol):
    """Proposes the best grasp of a log list."""

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        """The best candidate.

        Raises:
            NoGrasp: there is none.
        """


class GraspSelector(Protocol):
    """Chooses the grasp of a crane job."""

    def __call__(
        self, arm: Arm, job: CraneJob, logs: Sequence[LogObservation], slew_rad: float, rot_rad: float
    ) -> Grasp:
        """The grasp of the job from the present slew and rotator angles [rad].

        Raises:
            NoGrasp: there is none.
        """
