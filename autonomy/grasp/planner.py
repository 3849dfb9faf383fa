"""The two contracts of grasp planning, and what passes between them.

A grasp planner looks at a log list and proposes one grasp candidate in the base frame.  A grasp selector turns a crane
job into the grasp that the crane executes; `autonomy.grasp.selection.PlannerSelection` wraps a planner as a selector.
Failure of both: ``NoGrasp``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import hypot
from typing import Protocol

from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m
from runtime.errors import TimberhandError


class NoGrasp(TimberhandError, ValueError):
    """No log can be picked or placed; the sentence says which and why."""


class BunkFull(NoGrasp):
    """A log has no room in the bunk."""


@dataclass(frozen=True, slots=True)
class GraspRequest:
    """What a grasp planner plans from: machine and load, the log list, and the present rotator angle [rad].

    ``stay`` holds indices into ``logs``: these logs must not be gripped, but they are obstacles.  ``untried``: the
    candidate that was proposed last was not tried.
    """

    arm: Arm
    logs: Sequence[LogObservation]
    rot_rad: float
    stay: Collection[int] = ()
    untried: bool = False


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
        """Propose the best candidate.

        Raises:
            NoGrasp: there is none.
        """


class GraspSelector(Protocol):
    """Chooses the grasp of a crane job."""

    def __call__(
        self, arm: Arm, job: CraneJob, logs: Sequence[LogObservation], slew_rad: float, rot_rad: float
    ) -> Grasp:
        """Choose the grasp of the job from the present slew and rotator angles [rad].

        Raises:
            NoGrasp: there is none.
        """


# -- A grasp as the crane executes it, and which of its logs came up.


@dataclass(frozen=True, slots=True)
class Grasp:
    """The pose of the pin where the jaws begin to close, the height of the support, and the logs.

    The grapple grips ``log`` at ``along_m`` from its centre along its axis; ``others`` come up with it.  ``top_z_m`` is
    the highest point of the logs under the descent, or None where the log lies alone.  ``reason`` is a sentence for the
    operator, ``probability`` the planner's estimate of success.  ``penetrates``: the open jaws go down among other logs
    until these stop them.  ``extracts``: the grasp draws the log out of a row.  ``dragging``: the jaws pinch the log by
    its upper half and drag it out; they close on it again there.
    """

    log: LogObservation
    pose: Pose
    support_z_m: float
    along_m: float
    others: tuple[LogObservation, ...] = ()
    top_z_m: float | None = None
    reason: str = ""
    probability: float | None = None
    penetrates: bool = False
    extracts: bool = False
    dragging: bool = False

    @property
    def logs(self) -> tuple[LogObservation, ...]:
        """All logs of the grasp."""
        return (self.log, *self.others)

    @property
    def is_bundle(self) -> bool:
        """Whether the crane lifts slowly while the jaws keep closing: the logs of a bundle settle in them."""
        return self.top_z_m is not None

    @property
    def thinnest_m(self) -> float:
        """The least diameter of its logs."""
        return min(log.diameter_m for log in self.logs)


def offset_along(point: tuple[float, float], log: LogObservation) -> float:
    """Compute the distance of a point from a log's centre along the log's axis, m."""
    return (point[0] - log.center_m[0]) * log.axis[0] + (point[1] - log.center_m[1]) * log.axis[1]


def restricted_to(arm: Arm, grasp: Grasp, held: Sequence[int]) -> Grasp:
    """Return the grasp with only those of its logs whose numbers are in ``held``."""
    if all(log.id in held for log in grasp.logs):
        return grasp
    gripped_log, *others = (log for log in grasp.logs if log.id in held)
    return replace(grasp, log=gripped_log, others=tuple(others), along_m=offset_along(arm.xy(grasp.pose), gripped_log))


def hangs_below(arm: Arm, log: LogObservation, pin: Pose) -> bool:
    """Tell whether the log hangs below a pin: horizontally near it, and as high as the jaws can hold it."""
    x, y = arm.xy(pin)
    reach = lowest_tip_below_pin_m(arm.profile.grapple.jaws) + 0.3
    near = hypot(log.center_m[0] - x, log.center_m[1] - y) < log.length_m / 2
    return near and log.center_m[2] > pin.z_m - reach
