"""What the crane drives in each phase of an activity: from where it stands, with what it holds, past what lies around.

Pure functions of poses, log lists and the machine; ``Unreachable`` or ``NoGrasp`` where there is no way, with one
sentence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot
from typing import Final

from autonomy.crane_job.grasp_verification import is_between_tongs
from autonomy.grasp.direct import (
    Grasp,
    approach_length,
    closing_height,
    hover_height,
    known_ground_m,
    retreat_height,
    travel_height,
)
from autonomy.grasp.heap import is_over
from autonomy.motion.arm import Arm, Pose
from autonomy.motion.obstacles import held_log, surroundings
from autonomy.motion.planners import Motions
from autonomy.motion.trajectory import Trajectory, follow, slowly, straight
from autonomy.perception.logs import LogObservation
from machine.kinematics import Unreachable

BROAD_M: Final = 0.25
"""So much more than others the log that is to be gripped is kept clear of on the way to it."""
LEAN_M: Final = 0.15
"""A machine on tyres leans towards the crane that reaches out: what lies there rises by up to so much against it."""
NEAR_M: Final = 0.02
"""What lies so near to where it was aimed at is left so: the tongs forgive it."""
ASTRAY_M: Final = 0.3
"""What lies farther off may be another log."""
GATHER_S: Final = 10.0
"""Time in which what may settle is lifted to the travel height: also logs that hang askew are clear of the ground."""
DRAG_M, DRAG_S = 0.35, 2.5
"""How far and in what time a log is dragged out of a row."""
OUT_S: Final = 4.0
"""The same out of a heap, which is nearer to that height."""


def above(arm: Arm, motions: Motions, start: Pose, grasp: Grasp, logs: Sequence[LogObservation]) -> Trajectory:
    """With open tongs to where they close, or above it: among other logs, and on tyres, only the last, straight way
    down is safe.
    """
    # Open tongs come from above rather than from aside, for the log may lie a little elsewhere, and so may they.
    broad = [replace(o, diameter_m=o.diameter_m + 2.0 * BROAD_M) if o.id == grasp.log.id else o for o in logs]
    around, high_m = surroundings(arm.profile, broad), travel_height(arm.profile)
    if motions.direct and not grasp.gathered:
        stands = arm.profile.carrier is None
        goal = grasp.pose if stands else grasp.pose.at_height(grasp.pose.z_m + LEAN_M)
        try:
            return motions(arm, start, goal, around, None, high_m, 0.0)
        except Unreachable:  # a stump or a log beside it: from above, then
            pass
    over = grasp.pose.at_height(hover_height(arm.profile, grasp))
    return motions(arm, start, over, around, None, high_m, 0.0)


def aimed(arm: Arm, grasp: Grasp, logs: Sequence[LogObservation]) -> Grasp:
    """The grasp of a log that is now known to lie a little elsewhere, for the machine leans, and nearer is better seen.
    Unchanged where that is less than ``NEAR_M`` or more than ``ASTRAY_M``, or out of reach.
    """
    seen = next((log for log in logs if log.id == grasp.log.id), None)
    if seen is None:
        return grasp
    dx, dy, dz = (b - a for a, b in zip(grasp.log.center_m, seen.center_m, strict=True))
    if not NEAR_M < hypot(dx, dy, dz) < ASTRAY_M:
        return grasp
    support = max(grasp.support_z_m + dz, known_ground_m(arm.profile))
    (x, y), z = arm.xy(grasp.pose), grasp.pose.z_m + support - grasp.support_z_m
    try:
        pose = arm.over(x + dx, y + dy, z, travel_height(arm.profile))._replace(rot_rad=grasp.pose.rot_rad)
    except Unreachable:
        return grasp
    others = tuple(next((log for log in logs if log.id == o.id), o) for o in grasp.others)
    return replace(grasp, log=seen, others=others, pose=pose, support_z_m=support)


def carrying(
    arm: Arm,
    motions: Motions,
    start: Pose,
    place: Pose,
    grasp: Grasp,
    logs: Sequence[LogObservation],
    hangs: bool,
) -> Trajectory:
    """With the log to its place; ``hangs``: it is seen in the grapple, else it lies as it was gripped."""
    taken = {log.id for log in grasp.logs} | {log.id for log in logs if is_between_tongs(arm, log, start)}
    around = surroundings(arm.profile, logs, without=taken)
    seen = next((log for log in logs if log.id == grasp.log.id), None) if hangs else None
    held = held_log(arm, grasp.pose, grasp.log) if seen is None else held_log(arm, start, seen)
    held = replace(held, diameter_m=hypot(*(log.diameter_m for log in grasp.logs)))  # a bundle is as thick as all
    high_m, free_m = travel_height(arm.profile), approach_length(arm.profile, grasp.log)
    try:
        return motions(arm, start, place, around, held, high_m, free_m)
    except Unreachable:  # close to the stakes: over it first, and from there straight down
        if place.z_m >= high_m:
            raise
        return motions(arm, start, place.at_height(high_m), around, held, high_m, free_m)


def closing(arm: Arm, start: Pose, grasp: Grasp, begin_s: float) -> Trajectory:
    """The pin follows the sweep of tongs that have been closing for ``begin_s``."""
    height = closing_height(arm.profile, grasp.support_z_m, grasp.thinnest_m)

    def path(time_s: float) -> Pose:
        return grasp.pose.at_height(height(begin_s + time_s))

    return follow(arm, start, path, arm.profile.grapple.close_time_s, 1.0)


def dragging(arm: Arm, start: Pose, grasp: Grasp) -> Trajectory:
    """The log that the tongs pinch out of its row, along the ground; no motion where that is out of reach."""
    (x, y), log = arm.xy(start), grasp.log
    way = x - log.center_m[0], y - log.center_m[1]
    along = way[0] * log.axis[0] + way[1] * log.axis[1]
    out = way[0] - along * log.axis[0], way[1] - along * log.axis[1]
    far = DRAG_M / max(hypot(*out), 1e-3)
    try:
        aside = arm.over(x + far * out[0], y + far * out[1], start.z_m, travel_height(arm.profile))
    except Unreachable:
        return straight(arm, start, start)
    turned = start.rot_rad - (aside.slew_rad - start.slew_rad)
    return slowly(arm, start, aside._replace(rot_rad=turned), DRAG_S)


def gathering(arm: Arm, start: Pose, grasp: Grasp) -> Trajectory:
    """A bundle up, slowly: its logs settle, and the tongs follow them under it."""
    column = start if grasp.drags else grasp.pose
    goal = column.at_height(travel_height(arm.profile))
    return slowly(arm, start, goal, OUT_S if grasp.pressed and not grasp.drags else GATHER_S)


def stowing(arm: Arm, motions: Motions, start: Pose, logs: Sequence[LogObservation]) -> Trajectory:
    """Over the bunk, high enough for what hangs open to be clear of the stakes; no motion where it is there."""
    bunk, high_m = arm.profile.bunk, retreat_height(arm.profile)
    if is_over(bunk, *arm.xy(start)):
        return straight(arm, start, start.at_height(max(start.z_m, high_m)))
    over = arm.over(*bunk.center_m, high_m, high_m)._replace(rot_rad=start.rot_rad)
    return motions(arm, start, over, surroundings(arm.profile, logs), None, travel_height(arm.profile), 0.0)
