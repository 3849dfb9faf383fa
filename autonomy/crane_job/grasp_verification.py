"""What hangs in the grapple, judged by the newest log list: which logs came up, whether the way planned for them
will do.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import dist, hypot
from typing import Final

from autonomy.grasp.direct import Grasp, is_held, lies_in, only, plan_place
from autonomy.grasp.heap import is_over
from autonomy.grasp.proposal import NoGrasp
from autonomy.missions.crane_job import Mission
from autonomy.motion.arm import Arm, Pose
from autonomy.perception.logs import LogObservation
from machine.grapple import grapple_yaw, lowest_tip_below_pin_m
from machine.profile import Bunk

ASIDE_M: Final = 0.15
"""Farther than this from where it was meant to be, a column or a place is another one."""
TILTED_M: Final = 0.20
"""A log one of whose ends hangs so much lower than reckoned with is not carried on: its way is planned anew."""
TURN_RAD: Final = 0.03
MOST_TURN_RAD: Final = 0.4
"""The rotator corrects on the way between these how a log is seen to hang; what is more asks for a new way."""


def picked(grasp: Grasp, logs: Sequence[LogObservation]) -> list[LogObservation]:
    """The logs of the grasp as they are seen now, without those that are hidden: a log that hung in the tongs hangs no
    longer where it is remembered."""
    wanted = [log.id for log in grasp.logs]
    return [log for log in logs if log.seen and log.id in wanted]


def came_up(arm: Arm, grasp: Grasp, seen: Sequence[LogObservation], pins: Iterable[Pose]) -> Grasp | None:
    """The grasp with the logs that hang under one of the pins, and those that are hidden; None when none is seen to."""
    poses = list(pins)
    held = [log.id for log in seen if any(is_held(arm, log, pin) for pin in poses)]
    if not held:
        return None
    hidden = [log.id for log in grasp.logs if log.id not in [o.id for o in seen]]
    return only(arm, grasp, held + hidden)


def is_between_tongs(arm: Arm, log: LogObservation, pin: Pose) -> bool:
    """Whether a log lies on the middle line of closed tongs under a pin: none can but what they hold.  A list may have
    that twice, when it was measured amiss while it moved and begun as another log.
    """
    (x, y), c, a = arm.xy(pin), log.center_m, log.axis
    level2 = a[0] ** 2 + a[1] ** 2
    along_m = ((x - c[0]) * a[0] + (y - c[1]) * a[1]) / level2 if level2 > 0.0 else 0.0
    along_m = min(max(along_m, -0.5 * log.length_m), 0.5 * log.length_m)
    below_m = pin.z_m - c[2] - along_m * a[2]
    aside_m = hypot(c[0] + along_m * a[0] - x, c[1] + along_m * a[1] - y)
    return aside_m < 0.5 * log.diameter_m and 0.0 < below_m < lowest_tip_below_pin_m(arm.profile.grapple.tongs)


def laid(mission: Mission, target: Bunk, log: LogObservation) -> bool:
    """Whether a log that was let go lies where it was to be: in the target, or, where logs only have to get out of
    their source, low beside it, for it may roll.
    """
    if lies_in(target, log) or mission.source is None:
        return lies_in(target, log)
    return not is_over(mission.source, *log.center_m[:2]) and log.center_m[2] < target.floor_z_m + target.stake_height_m


def place_as_seen(
    arm: Arm, mission: Mission, grasp: Grasp, place: Pose, logs: Sequence[LogObservation], position: Sequence[float]
) -> Pose | None:
    """The place with the rotator turned for the log as it is now seen to hang; None when another way is asked for.

    ``position``: the measured joints, rad (EXT m).
    """
    seen = next((log for log in picked(grasp, logs) if log.id == grasp.log.id), None)
    if seen is None:
        return place
    if 0.5 * seen.length_m * (abs(seen.axis[2]) - abs(grasp.log.axis[2])) > TILTED_M:
        return None
    try:
        wanted = plan_place(arm, mission, grasp, logs, grapple_yaw(arm.profile, position))
    except NoGrasp:
        return None  # and why, when it is planned anew
    turn = abs(wanted.rot_rad - place.rot_rad)
    if turn > MOST_TURN_RAD or dist(arm.xy(wanted), arm.xy(place)) > ASIDE_M:
        return None
    return place._replace(rot_rad=wanted.rot_rad) if turn > TURN_RAD else place
