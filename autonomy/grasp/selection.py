"""Grasp and place of one log from its pose alone, as for a detector that makes no mistakes; and how any grasp is done.

The tongs open across the log's axis at its centre, or at the nearest point along it that the crane reaches;
they go down in the open position and the pin follows their sweep while they close, so that the tips stay just
above what the log lies on.  The place is the bunk, the log along its axis.  A planner (``autonomy.grasp.planner``)
may choose instead, also several logs at once; ``PlannerSelection`` makes its proposal a grasp of the same kind.  Inputs: the
machine, the mission, the log list.  Failure: ``NoGrasp`` with one sentence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import atan2, degrees, hypot, pi
from typing import Final

import numpy as np

from autonomy.grasp.grapple_heights import known_ground_m, grasp_pose
from autonomy.grasp.grasp import Grasp, offset_along
from autonomy.grasp.placement import lies_in_bunk
from autonomy.grasp.planner import NoGrasp, GraspPlanner
from autonomy.missions.crane_job import Mission
from autonomy.motion.arm import Arm
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.kinematics import Unreachable
from machine.profile import Profile

ISOLATION_DISTANCE_M: Final = 0.9
"""A grasp with no other log so near to it cannot scoop one up: the tongs' half opening, and some."""
ALONG_OFFSETS_M: Final = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3)
MAX_AXIS_SLOPE: Final = 0.5


def select_direct(arm: Arm, mission: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
    """The grasp of the mission's log, or of the topmost log outside the bunk and of these the nearest by
    slewing.

    ``slew`` and ``rot`` are the present angles, rad.  Raises ``NoGrasp``.
    """
    if mission.log_id is not None:
        candidates = [log for log in logs if log.id == mission.log_id]
        missing, why = f"log {mission.log_id} is not in view", "the one that the mission names"
    else:
        candidates, missing = pending_logs(arm.profile, mission, logs)
        why = "the topmost that is in reach, of these the nearest by slewing"
    grasps, trouble = [], [missing]
    for log in candidates:
        try:
            grasps.append(plan_single_log_grasp(arm, log, rot))
        except NoGrasp as error:
            trouble.append(str(error))
    if not grasps:
        raise NoGrasp(trouble[-1])
    best = min(grasps, key=lambda g: (-round(g.log.center_m[2], 1), abs(g.pose.slew_rad - slew)))
    return replace(best, reason=f"log {best.log.id}, {why}")


def pending_logs(profile: Profile, mission: Mission, logs: Sequence[LogObservation]) -> tuple[list[LogObservation], str]:
    """The logs that are still to be picked, and the sentence for when there is none."""
    there, missing = _logs_at_source(profile, mission, logs)
    found = [log for log in there if log.id not in mission.leave]
    return found, "every log that lies there is to stay" if there else missing


def _logs_at_source(profile: Profile, mission: Mission, logs: Sequence[LogObservation]) -> tuple[list[LogObservation], str]:
    """The logs that lie where logs come from, also those that are to stay; and the sentence for when none does."""
    if mission.source is not None:
        return [log for log in logs if lies_in_bunk(mission.source, log)], "no log is left where logs come from"
    target = mission.to(profile.bunk)
    return [log for log in logs if not lies_in_bunk(target, log)], "no log lies outside the bunk"


def plan_single_log_grasp(arm: Arm, log: LogObservation, rot: float) -> Grasp:
    """The grasp of one log; raises ``NoGrasp``."""
    profile = arm.profile
    if abs(log.axis[2]) > MAX_AXIS_SLOPE:
        raise NoGrasp(f"log {log.id} stands at {degrees(abs(np.arcsin(log.axis[2]))):.0f} deg, too steep to grip")
    yaw = atan2(log.axis[1], log.axis[0])
    trouble = ""
    for along in ALONG_OFFSETS_M:
        x, y, z = (c + along * a for c, a in zip(log.center_m, log.axis, strict=True))
        support = max(known_ground_m(profile), z - log.diameter_m / 2)
        try:
            pose = grasp_pose(arm, x, y, yaw + pi / 2, support, log.diameter_m, rot)
        except Unreachable as error:
            trouble = trouble or f"log {log.id} cannot be picked: {error}"
            continue
        return Grasp(log, pose, support, along)
    raise NoGrasp(trouble)


class PlannerSelection:
    """A ``GraspSelector`` that lets a planner choose among the logs outside the bunk."""

    def __init__(self, planner: GraspPlanner) -> None:
        self._planner = planner

    def __call__(self, arm: Arm, mission: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
        """The proposal as a grasp; a mission that names its log is served by ``select_direct``."""
        if mission.log_id is not None:
            return select_direct(arm, mission, logs, slew, rot)
        wanted, missing = pending_logs(arm.profile, mission, logs)
        if not wanted:
            raise NoGrasp(missing)
        there, _ = _logs_at_source(arm.profile, mission, logs)
        stay = {i for i, log in enumerate(there) if log.id in mission.leave}
        p = self._planner(arm, there, slew, rot, stay)
        first, *others = sorted((there[i] for i in p.logs), key=lambda log: -log.length_m)
        thinnest = min(log.diameter_m for log in (first, *others))
        try:
            pose = grasp_pose(arm, p.x_m, p.y_m, p.yaw_rad, p.support_z_m, thinnest, rot)
        except Unreachable as error:
            raise NoGrasp(f"the planner's grasp is out of reach: {error}") from None
        along = offset_along((p.x_m, p.y_m), first)
        near = [log for log in there if log is not first and _horizontal_gap_m((p.x_m, p.y_m), log) < ISOLATION_DISTANCE_M]
        # What lies alone cannot settle, and comes up as `select_direct` would lift it.
        top = _highest_point_m(there) if near or others else None
        return Grasp(first, pose, p.support_z_m, along, tuple(others), top, p.reason, p.probability, p.pressed, p.drawn)


def _highest_point_m(logs: Sequence[LogObservation]) -> float:
    """The highest point of logs, m."""
    return max(log.center_m[2] + abs(log.axis[2]) * log.length_m / 2 + log.diameter_m / 2 for log in logs)


def _horizontal_gap_m(point: tuple[float, float], log: LogObservation) -> float:
    """How far a point is from a log, seen from above, m; 0 over it."""
    along = min(max(offset_along(point, log), -log.length_m / 2), log.length_m / 2)
    x, y = (c + along * a for c, a in zip(log.center_m[:2], log.axis[:2], strict=True))
    return max(hypot(point[0] - x, point[1] - y) - log.diameter_m / 2, 0.0)


