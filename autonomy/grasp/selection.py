"""Grasp selection: the grasp of a crane job, of one log by its pose alone or by a grasp planner.

``select_direct`` trusts the log list: the grapple opens across the log's axis at its centre, or at the nearest point
along it that the crane reaches.  ``PlannerSelection`` lets a grasp planner choose among the logs at the source and
makes its candidate a grasp of the same kind.  Inputs: the machine, the crane job, the log list.  Failure:
``NoGrasp``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import atan2, degrees, hypot, pi
from typing import Final

import numpy as np

from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.grapple_heights import grasp_pose, known_ground_m
from autonomy.grasp.planner import Grasp, GraspPlanner, GraspRequest, NoGrasp, offset_along
from autonomy.grasp.weight import HEAVIER, refuse_too_heavy, wood_kg
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from machine.geometry.kinematics import Unreachable
from machine.profile import Profile

ISOLATION_DISTANCE_M: Final = 0.9
"""A grasp with no other log this near cannot scoop one up: half the opening of the jaws, and a margin."""
ALONG_OFFSETS_M: Final = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3)
MAX_AXIS_SLOPE: Final = 0.5


def select_direct(arm: Arm, job: CraneJob, logs: Sequence[LogObservation], slew_rad: float, rot_rad: float) -> Grasp:
    """Plan the grasp of the job's log; without one, of the topmost outside the bunk, of these the nearest by slewing.

    Raises:
        NoGrasp: no such log is in view, or none is in reach.
    """
    if job.log_id is not None:
        candidates = [log for log in logs if log.id == job.log_id]
        missing = NoGrasp("grasp.job-log-not-in-view", f"log {job.log_id} is not in view")
        why = "the one that the job names"
    else:
        candidates, missing = pending_logs(arm.profile, job, logs)
        why = "the topmost that is in reach, of these the nearest by slewing"
    grasps, trouble = [], [missing]
    for log in candidates:
        try:
            grasps.append(plan_single_log_grasp(arm, log, rot_rad))
        except NoGrasp as error:
            trouble.append(error)
    if not grasps:
        raise trouble[-1]
    best = min(grasps, key=lambda g: (-round(g.log.center_m[2], 1), abs(g.pose.slew_rad - slew_rad)))
    return replace(best, reason=f"log {best.log.id}, {why}")


def pending_logs(
    profile: Profile, job: CraneJob, logs: Sequence[LogObservation]
) -> tuple[list[LogObservation], NoGrasp]:
    """Return the logs that the job may still pick, and the error to raise when there is none."""
    present, missing = _logs_at_source(profile, job, logs)
    available_logs = [log for log in present if log.id not in job.leave]
    if present:
        missing = NoGrasp("grasp.all-logs-stay", "the job leaves every log that lies there")
    return available_logs, missing


def _logs_at_source(
    profile: Profile, job: CraneJob, logs: Sequence[LogObservation]
) -> tuple[list[LogObservation], NoGrasp]:
    """Return the logs that lie at the job's source, including those that stay, and the error for when there is none."""
    if job.source is not None:
        missing = NoGrasp("grasp.source-empty", "no log is left at the source")
        return [log for log in logs if lies_in_bunk(job.source, log)], missing
    target = job.to(profile.bunk)
    missing = NoGrasp("grasp.no-log-outside-bunk", "no log lies outside the bunk")
    return [log for log in logs if not lies_in_bunk(target, log)], missing


def plan_single_log_grasp(arm: Arm, log: LogObservation, rot_rad: float) -> Grasp:
    """Plan the grasp of one log.

    Raises:
        NoGrasp: the log stands too steep, is out of reach, or is too heavy where it lies.
    """
    profile = arm.profile
    if abs(log.axis[2]) > MAX_AXIS_SLOPE:
        slope_deg = degrees(abs(np.arcsin(log.axis[2])))
        raise NoGrasp("grasp.log-too-steep", f"log {log.id} stands at {slope_deg:.0f} deg, too steep to grip")
    yaw = atan2(log.axis[1], log.axis[0])
    trouble: Unreachable | None = None
    for along in ALONG_OFFSETS_M:
        x, y, z = (c + along * a for c, a in zip(log.center_m, log.axis, strict=True))
        support = max(known_ground_m(profile), z - log.diameter_m / 2)
        try:
            pose = grasp_pose(arm, x, y, yaw + pi / 2, support, log.diameter_m, rot_rad)
            refuse_too_heavy(arm, pose, HEAVIER * wood_kg([log]), f"log {log.id}")
        except Unreachable as error:
            trouble = trouble or error
            continue
        return Grasp(log, pose, support, along)
    raise NoGrasp("grasp.log-out-of-reach", f"log {log.id} cannot be picked: {trouble}")


class PlannerSelection:
    """A ``GraspSelector`` that lets a planner choose among the logs at the source."""

    def __init__(self, planner: GraspPlanner) -> None:
        self._planner = planner

    def __call__(
        self, arm: Arm, job: CraneJob, logs: Sequence[LogObservation], slew_rad: float, rot_rad: float
    ) -> Grasp:
        """Return the planner's candidate as a grasp; ``select_direct`` serves a job that names its log."""
        if job.log_id is not None:
            return select_direct(arm, job, logs, slew_rad, rot_rad)
        available_logs, missing = pending_logs(arm.profile, job, logs)
        if not available_logs:
            raise missing
        present, _ = _logs_at_source(arm.profile, job, logs)
        stay = {i for i, log in enumerate(present) if log.id in job.leave}
        candidate = self._planner(GraspRequest(arm, present, rot_rad, stay, job.untried))
        gripped_log, *others = sorted((present[i] for i in candidate.logs), key=lambda log: -log.length_m)
        thinnest = min(log.diameter_m for log in (gripped_log, *others))
        try:
            pose = grasp_pose(
                arm, candidate.x_m, candidate.y_m, candidate.yaw_rad, candidate.support_z_m, thinnest, rot_rad
            )
        except Unreachable as error:
            raise NoGrasp("grasp.candidate-out-of-reach", f"the planner's grasp is out of reach: {error}") from None
        point = candidate.x_m, candidate.y_m
        neighbours = [
            log for log in present if log is not gripped_log and _horizontal_gap_m(point, log) < ISOLATION_DISTANCE_M
        ]
        # A log that lies alone cannot settle: the crane lifts it as it lifts one of `select_direct`.
        top = _highest_point_m(present) if neighbours or others else None
        return Grasp(
            gripped_log,
            pose,
            candidate.support_z_m,
            offset_along(point, gripped_log),
            tuple(others),
            top,
            candidate.reason,
            candidate.probability,
            candidate.penetrates,
            candidate.extracts,
        )


def _highest_point_m(logs: Sequence[LogObservation]) -> float:
    """Compute the highest point of logs, m."""
    return max(log.center_m[2] + abs(log.axis[2]) * log.length_m / 2 + log.diameter_m / 2 for log in logs)


def _horizontal_gap_m(point: tuple[float, float], log: LogObservation) -> float:
    """Compute the horizontal distance of a point from a log's surface, m; 0 over the log."""
    along = min(max(offset_along(point, log), -log.length_m / 2), log.length_m / 2)
    x, y = (c + along * a for c, a in zip(log.center_m[:2], log.axis[:2], strict=True))
    return max(hypot(point[0] - x, point[1] - y) - log.diameter_m / 2, 0.0)
