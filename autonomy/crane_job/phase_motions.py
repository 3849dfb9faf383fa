"""Motions of the phases of a crane job: from the present pose, with the present load, clear of what lies around.

Pure functions of poses, log lists and the machine.  Failure: ``Unreachable`` or ``NoGrasp`` where there is no path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot
from typing import Final

from autonomy.crane_job.grasp_verification import is_part_of_load
from autonomy.grasp.bunk_load import STAKE_CLEARANCE_M, is_over_bunk, point_in_bunk
from autonomy.grasp.grapple_heights import (
    approach_length_m,
    closing_height_curve,
    hover_height_m,
    known_ground_m,
    retreat_height_m,
    travel_height_m,
)
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.motion_planner import MotionPlanner
from autonomy.motion.obstacles import CollisionScene, HeldLog, collision_scene, held_log
from autonomy.motion.trajectory import Trajectory, follow_path, joined, slow_line, straight_line
from autonomy.perception.log_list import LogObservation
from machine.geometry.kinematics import Unreachable
from machine.profile import Bunk

APPROACH_CLEARANCE_M: Final = 0.25
"""Extra clearance on the approach from the log that is to be gripped."""
MACHINE_LEAN_M: Final = 0.15
"""A machine on tyres leans towards the reaching crane: what lies there rises by up to this much relative to it."""
MIN_AIM_CORRECTION_M: Final = 0.02
"""An aiming error below this is left: the jaws tolerate it."""
MAX_AIM_CORRECTION_M: Final = 0.3
"""A log farther from its expected place may be another one."""
BUNDLE_LIFT_S: Final = 10.0
"""Duration of lifting a bundle to the travel height, while its logs settle and askew ones clear the ground."""
EXTRACTION_DISTANCE_M, EXTRACTION_S = 0.35, 2.5
"""Distance and duration of dragging a log out of a row."""
PILE_LIFT_S: Final = 6.0
"""Duration of lifting out of a pile, which is nearer to the travel height."""


def approach_motion(
    arm: Arm, motion_planner: MotionPlanner, start: Pose, grasp: Grasp, logs: Sequence[LogObservation]
) -> Trajectory:
    """Approach with open jaws to where they close, or above it: among other logs, and on tyres, only a last vertical
    descent is safe.
    """
    # The enlarged log makes the open jaws come from above rather than from the side: both log and jaws may be off a
    # little.
    broad = [
        replace(o, diameter_m=o.diameter_m + 2.0 * APPROACH_CLEARANCE_M) if o.id == grasp.log.id else o for o in logs
    ]
    scene, high_m = collision_scene(arm.profile, broad), travel_height_m(arm.profile)
    if motion_planner.direct and not grasp.is_bundle:
        stands = arm.profile.carrier is None
        goal = grasp.pose if stands else grasp.pose.at_height(grasp.pose.z_m + MACHINE_LEAN_M)
        try:
            return motion_planner(arm, start, goal, scene, None, high_m, 0.0)
        except Unreachable:  # a stump or a log beside it: approach from above
            pass
    over = grasp.pose.at_height(hover_height_m(arm.profile, grasp))
    return motion_planner(arm, start, over, scene, None, high_m, 0.0)


def corrected_grasp(arm: Arm, grasp: Grasp, logs: Sequence[LogObservation]) -> Grasp:
    """Move the grasp with its log, which the list now sees elsewhere: the machine leans, and a nearer view is better.

    Unchanged where the shift is less than ``MIN_AIM_CORRECTION_M`` or more than ``MAX_AIM_CORRECTION_M``, or where the
    moved grasp is out of reach.  A log on known ground does not rise: it is only measured higher.
    """
    seen = next((log for log in logs if log.id == grasp.log.id), None)
    if seen is None:
        return grasp
    dx, dy, dz = (b - a for a, b in zip(grasp.log.center_m, seen.center_m, strict=True))
    if not MIN_AIM_CORRECTION_M < hypot(dx, dy, dz) < MAX_AIM_CORRECTION_M:
        return grasp
    ground_m = known_ground_m(arm.profile)
    support = max(grasp.support_z_m + dz, ground_m)
    if grasp.support_z_m <= ground_m + MIN_AIM_CORRECTION_M:
        support = grasp.support_z_m
    (x, y), z = arm.xy(grasp.pose), grasp.pose.z_m + support - grasp.support_z_m
    try:
        pose = arm.pose_above(x + dx, y + dy, z, travel_height_m(arm.profile))._replace(rot_rad=grasp.pose.rot_rad)
    except Unreachable:
        return grasp
    others = tuple(next((log for log in logs if log.id == o.id), o) for o in grasp.others)
    return replace(grasp, log=seen, others=others, pose=pose, support_z_m=support)


def carry_motion(
    arm: Arm,
    motion_planner: MotionPlanner,
    start: Pose,
    place: Pose,
    grasp: Grasp,
    logs: Sequence[LogObservation],
    hangs: bool,
) -> Trajectory:
    """Carry the log to its place; ``hangs``: the log is seen in the grapple, otherwise it lies as it was gripped."""
    scene, held = _scene_of_load(arm, start, grasp, logs, hangs)
    high_m, free_m = travel_height_m(arm.profile), approach_length_m(arm.profile, grasp.log)
    try:
        return motion_planner(arm, start, place, scene, held, high_m, free_m)
    except Unreachable:  # close to the stakes: first above the place, then straight down
        if place.z_m >= high_m:
            raise
        return motion_planner(arm, start, place.at_height(high_m), scene, held, high_m, free_m)


def turn_motion(arm: Arm, start: Pose, place: Pose, bunk: Bunk, load: LogObservation, s_rad: float) -> Trajectory:
    """Turn a thin load at its place by ``s_rad`` seconds per radian, as it spins when turned fast.

    A load whose ends reach among the stakes goes up as it came, turns above them, and comes down again: a stake may be
    inside of its turn.
    """
    least_s = s_rad * abs(place.rot_rad - start.rot_rad)
    if not reaches_stakes(bunk, load):
        return slow_line(arm, start, place, least_s)
    high_m = travel_height_m(arm.profile)
    above, over = start.at_height(max(high_m, start.z_m)), place.at_height(max(high_m, start.z_m))
    turn = slow_line(arm, above, over, least_s)
    return joined(straight_line(arm, start, above), turn, straight_line(arm, over, place))


def reaches_stakes(bunk: Bunk, log: LogObservation) -> bool:
    """Tell whether an end of a log is as far out as the stakes, or a hand's breadth from it."""
    half_m = 0.5 * log.length_m
    ends = [[c + side * half_m * a for c, a in zip(log.center_m, log.axis, strict=True)] for side in (-1, 1)]
    most_m = 0.5 * bunk.width_m - STAKE_CLEARANCE_M
    return any(abs(point_in_bunk(bunk, x, y)[1]) + 0.5 * log.diameter_m > most_m for x, y, _ in ends)


def _scene_of_load(
    arm: Arm, start: Pose, grasp: Grasp, logs: Sequence[LogObservation], hangs: bool
) -> tuple[CollisionScene, HeldLog]:
    """Return what the load may hit, and the load."""
    taken = {log.id for log in grasp.logs}
    taken |= {log.id for log in logs if is_part_of_load(arm, grasp.log, log, start)}
    scene = collision_scene(arm.profile, logs, without=taken)
    seen = next((log for log in logs if log.id == grasp.log.id), None) if hangs else None
    held = held_log(arm, grasp.pose, grasp.log) if seen is None else held_log(arm, start, seen)
    return scene, replace(held, diameter_m=hypot(*(log.diameter_m for log in grasp.logs)))  # a bundle: one thick log


def closing_motion(arm: Arm, start: Pose, grasp: Grasp, begin_s: float) -> Trajectory:
    """Let the pin follow the sweep of jaws that have been closing for ``begin_s``."""
    height = closing_height_curve(arm.profile, grasp.support_z_m, grasp.thinnest_m)

    def path(time_s: float) -> Pose:
        return grasp.pose.at_height(height(begin_s + time_s))

    return follow_path(arm, start, path, arm.profile.grapple.close_time_s, 1.0)


def extraction_motion(arm: Arm, start: Pose, grasp: Grasp) -> Trajectory:
    """Drag the pinched log out of its row along the ground; no motion where that is out of reach."""
    (x, y), log = arm.xy(start), grasp.log
    offset = x - log.center_m[0], y - log.center_m[1]
    along = offset[0] * log.axis[0] + offset[1] * log.axis[1]
    out = offset[0] - along * log.axis[0], offset[1] - along * log.axis[1]
    far = EXTRACTION_DISTANCE_M / max(hypot(*out), 1e-3)
    try:
        aside = arm.pose_above(x + far * out[0], y + far * out[1], start.z_m, travel_height_m(arm.profile))
    except Unreachable:
        return straight_line(arm, start, start)
    turned = start.rot_rad - (aside.slew_rad - start.slew_rad)
    return slow_line(arm, start, aside._replace(rot_rad=turned), EXTRACTION_S)


def bundle_lift_motion(arm: Arm, start: Pose, grasp: Grasp) -> Trajectory:
    """Lift a bundle slowly: its logs settle, and the jaws follow under them."""
    column = start if grasp.dragging else grasp.pose
    goal = column.at_height(travel_height_m(arm.profile))
    return slow_line(arm, start, goal, PILE_LIFT_S if grasp.penetrates and not grasp.dragging else BUNDLE_LIFT_S)


def stow_motion(arm: Arm, motion_planner: MotionPlanner, start: Pose, logs: Sequence[LogObservation]) -> Trajectory:
    """Stow over the bunk, high enough for the open grapple to clear the stakes; no lateral motion where it is there."""
    bunk, high_m = arm.profile.bunk, retreat_height_m(arm.profile)
    if is_over_bunk(bunk, *arm.xy(start)):
        return straight_line(arm, start, start.at_height(max(start.z_m, high_m)))
    over = arm.pose_above(*bunk.center_m, high_m, high_m)._replace(rot_rad=start.rot_rad)
    return motion_planner(arm, start, over, collision_scene(arm.profile, logs), None, travel_height_m(arm.profile), 0.0)
