"""A grasp as the crane executes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot

from autonomy.motion.arm import Arm
from autonomy.motion.pose import Pose
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m


@dataclass(frozen=True, slots=True)
class Grasp:
    """Where closing begins: the pose of the pin, the height of the support, the point along the axis of ``log``.

    ``others`` come up with it; ``top_z_m`` is the highest point of a log under the way down, or None; ``reason`` is a
    sentence for the operator, ``probability`` that of success where a planner reckons with one; ``pressed``: the tongs
    go down among other logs, as far as these let them; ``drawn``: to draw the log out of a row; ``drags``: pinched by
    its upper half it is dragged out, to be gripped there.
    """

    log: LogObservation
    pose: Pose
    support_z_m: float
    along_m: float
    others: tuple[LogObservation, ...] = ()
    top_z_m: float | None = None
    reason: str = ""
    probability: float | None = None
    pressed: bool = False
    drawn: bool = False
    drags: bool = False

    @property
    def logs(self) -> tuple[LogObservation, ...]:
        """All logs that are to come up."""
        return (self.log, *self.others)

    @property
    def gathered(self) -> bool:
        """Whether it is lifted slowly while the tongs go on closing: what a planner chose may settle in them."""
        return self.top_z_m is not None

    @property
    def thinnest_m(self) -> float:
        """Least diameter of these."""
        return min(log.diameter_m for log in self.logs)


def offset_along(point: tuple[float, float], log: LogObservation) -> float:
    """How far along a log's axis a point is from its centre, m."""
    return (point[0] - log.center_m[0]) * log.axis[0] + (point[1] - log.center_m[1]) * log.axis[1]


def restricted_to(arm: Arm, grasp: Grasp, held: Sequence[int]) -> Grasp:
    """The grasp with those of its logs that truly came up, by their numbers."""
    if all(log.id in held for log in grasp.logs):
        return grasp
    first, *others = (log for log in grasp.logs if log.id in held)
    return replace(grasp, log=first, others=tuple(others), along_m=offset_along(arm.xy(grasp.pose), first))


def hangs_below(arm: Arm, log: LogObservation, pin: Pose) -> bool:
    """Whether the log hangs under a pin: near it sideways, and as high as tongs can hold it."""
    x, y = arm.xy(pin)
    reach = lowest_tip_below_pin_m(arm.profile.grapple.tongs) + 0.3
    near = hypot(log.center_m[0] - x, log.center_m[1] - y) < log.length_m / 2
    return near and log.center_m[2] > pin.z_m - reach
