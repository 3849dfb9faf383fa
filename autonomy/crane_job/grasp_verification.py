"""What hangs in the grapple, judged by the newest log list: which logs came up, whether the way planned for them
will do.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import dist, hypot
from typing import Final

from autonomy.grasp.bunk_load import is_over_bunk
from autonomy.grasp.grasp import Grasp, hangs_below, restricted_to
from autonomy.grasp.placement import lies_in_bunk, plan_place
from autonomy.grasp.planner import NoGrasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm import Arm
from autonomy.motion.pose import Pose
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m
from machine.profile import Bunk

COLUMN_RADIUS_M: Final = 0.15
"""Farther than this from where it was meant to be, a column or a place is another one."""
MAX_EXTRA_SAG_M: Final = 0.20
"""A log one of whose ends hangs so much lower than reckoned with is not carried on: its way is planned anew."""
MIN_CORRECTION_RAD: Final = 0.03
MAX_CORRECTION_RAD: Final = 0.4
"""The rotator corrects on the way between these how a log is seen to hang; what is more asks for a new way."""


def visible_grasped_logs(grasp: Grasp, logs: Sequence[LogObservation]) -> list[LogObservation]:
    """The logs of the grasp as they are seen now, without those that are hidden: a log that hung in the tongs hangs no
    longer where it is remembered."""
    wanted = [log.id for log in grasp.logs]
    return [log for log in logs if log.seen and log.id in wanted]


def lifted_part(arm: Arm, grasp: Grasp, seen: Sequence[LogObservation], pins: Iterable[Pose]) -> Grasp | None:
    """The grasp with the logs that hang under one of the pins, and those that are hidden; None when none is seen to."""
    poses = list(pins)
    held = [log.id for log in seen if any(hangs_below(arm, log, pin) for pin in poses)]
    if not held:
        return None
    hidden = [log.id for log in grasp.logs if log.id not in [o.id for o in seen]]
    return restricted_to(arm, grasp, held + hidden)


def is_between_jaws(arm: Arm, log: LogObservation, pin: Pose) -> bool:
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


def is_at_target(mission: CraneJob, target: Bunk, log: LogObservation) -> bool:
    """Whether a log that was let go lies where it was to be: in the target, or, where logs only have to get out of
    their source, low beside it, for it may roll.
    """
    if lies_in_bunk(target, log) or mission.source is None:
        return lies_in_bunk(target, log)
    return not is_over_bunk(mission.source, *log.center_m[:2]) and log.center_m[2] < target.floor_z_m + target.stake_height_m


def corrected_place(
    arm: Arm, mission: CraneJob, grasp: Grasp, place: Pose, logs: Sequence[LogObservation], position: Sequence[float]
) -> Pose | None:
    """The place with the rotator turned for the log as it is now seen to hang; None when another way is asked for.

    ``position``: the measured joints, rad (EXT m).
    """
    seen = next((log for log in visible_grasped_logs(grasp, logs) if log.id == grasp.log.id), None)
    if seen is None:
        return place
    if 0.5 * seen.length_m * (abs(seen.axis[2]) - abs(grasp.log.axis[2])) > MAX_EXTRA_SAG_M:
        return None
    try:
        wanted = plan_place(arm, mission, grasp, logs, grapple_yaw(arm.profile, position))
    except NoGrasp:
        return None  # and why, when it is planned anew
    turn = abs(wanted.rot_rad - place.rot_rad)
    if turn > MAX_CORRECTION_RAD or dist(arm.xy(wanted), arm.xy(place)) > COLUMN_RADIUS_M:
        return None
    return place._replace(rot_rad=wanted.rot_rad) if turn > MIN_CORRECTION_RAD else place
