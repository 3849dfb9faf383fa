"""Where a gripped log is laid down: the lowest resting place in the bunk, the log along the bunk's axis."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, hypot, pi, remainder, sin
from typing import Final

from autonomy.grasp.bunk_load import BunkLoad, is_over_bunk, point_in_bunk
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.grasp import Grasp
from autonomy.grasp.planner import BunkFull, NoGrasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm import Arm
from autonomy.motion.pose import Pose
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m, rotator_for_yaw
from machine.geometry.kinematics import Unreachable
from machine.profile import Bunk

BELOW_STAKE_TOP_M: Final = 0.05
"""The middle of a log must come to rest at least this far below the top of the stakes."""
RELEASE_CLEARANCE_M: Final = 0.07
STAKE_CLEARANCE_M: Final = 0.15
"""Between a log that is laid down and the stakes: covers sway and the tracking error."""
GRAPPLE_STAKE_CLEARANCE_M: Final = 0.40
"""Between the middle of the closed grapple and the stakes: its half width, and the path's margin."""

_END_ERROR_M, _SKEW_ERROR_RAD = 0.05, 0.15
"""A log in the bunk may be measured so far beside its place and its direction."""


def plan_place(
    arm: Arm,
    job: CraneJob,
    grasp: Grasp,
    logs: Sequence[LogObservation],
    held_yaw_rad: float | None = None,
    stands_rad: float | None = None,
) -> Pose:
    """The pose of the pin in which the grapple may open over the bunk.

    ``held_yaw_rad`` is the grapple's yaw while the log was seen to hang in it.  A thin log may lie askew in closed
    jaws: the rotator turns so that the log, not the grapple, lies along the bunk.  Of the turns that differ by half a
    turn it makes the one that ends nearest to ``stands_rad``, its angle by then; None: that of the grasp.

    Raises:
        BunkFull: the log would lie above the stakes.
        NoGrasp: the place is out of reach.
    """
    profile, bunk = arm.profile, job.to(arm.profile.bunk)
    top, thickest = bunk.floor_z_m + bunk.stake_height_m, max(log.diameter_m for log in grasp.logs)
    taken = {log.id for log in grasp.logs}
    load = BunkLoad(bunk, [o for o in logs if o.id not in taken], thickest, grasp.log.length_m, arm.slope)
    rest = load.lowest_place(bunk.width_m / 2 - max(thickest / 2 + STAKE_CLEARANCE_M, GRAPPLE_STAKE_CLEARANCE_M))
    c, s = cos(bunk.yaw_rad), sin(bunk.yaw_rad)
    center_x, center_y = bunk.center_m[0] - rest.across_m * s, bunk.center_m[1] + rest.across_m * c
    if job.place_m is not None:
        center_x, center_y = job.place_m
        rest = load.place_at(point_in_bunk(bunk, *job.place_m)[1])
    if rest.rest_z_m > top - BELOW_STAKE_TOP_M:
        raise BunkFull(
            "grasp.bunk-full", f"the bunk is full: log {grasp.log.id} would lie above the stakes; empty the bunk"
        )
    low = rest.support_z_m + RELEASE_CLEARANCE_M + lowest_tip_below_pin_m(profile.grapple.jaws)
    # The jaws open at the place itself, which is free of stakes; a log gripped off its centre shifts them only as far
    # as it would stick out of the bunk.
    out_m = max(0.0, abs(grasp.along_m) + grasp.log.length_m / 2 - bunk.length_m / 2)
    shift_m = out_m if grasp.along_m > 0.0 else -out_m
    log_yaw = atan2(grasp.log.axis[1], grasp.log.axis[0]) - grasp.pose.slew_rad - grasp.pose.rot_rad
    x, y = center_x, center_y
    seen = next((o for o in logs if o.id == grasp.log.id), None)
    skew, near = 0.0, grasp.pose.rot_rad if stands_rad is None else stands_rad
    if seen is not None and held_yaw_rad is not None:
        skew = remainder(atan2(seen.axis[1], seen.axis[0]) - (held_yaw_rad - pi / 2), pi)
        log_yaw += skew
    try:
        for _ in range(2):  # the log's direction depends on the place
            pose = arm.pose_above(x, y, low, travel_height_m(profile))
            rot = rotator_for_yaw(profile, pose.slew_rad, bunk.yaw_rad + pi / 2 - skew, near)
            laid = log_yaw + pose.slew_rad + rot
            x, y = center_x + shift_m * cos(laid), center_y + shift_m * sin(laid)
    except Unreachable as error:
        raise NoGrasp("grasp.place-out-of-reach", f"log {grasp.log.id} cannot be laid down: {error}") from None
    return pose._replace(rot_rad=rot)


def lies_in_bunk(bunk: Bunk, log: LogObservation) -> bool:
    """Whether the log's centre is between the stakes."""
    return is_over_bunk(bunk, *log.center_m[:2]) and log.center_m[2] < bunk.floor_z_m + bunk.stake_height_m


def lies_across_stakes(bunk: Bunk, log: LogObservation) -> bool:
    """Whether a log lies askew, with an end beyond the stakes by more than it may be measured wrongly."""
    across, skew = point_in_bunk(bunk, *log.center_m[:2])[1], atan2(log.axis[1], log.axis[0]) - bunk.yaw_rad
    aside_m = 0.5 * log.length_m * abs(sin(skew)) * hypot(*log.axis[:2])
    return abs(remainder(skew, pi)) > _SKEW_ERROR_RAD and abs(across) + aside_m > bunk.width_m / 2 + _END_ERROR_M
