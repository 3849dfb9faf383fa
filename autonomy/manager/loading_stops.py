"""Where the machine stops to load: the place along its path from which the crane reaches the most logs with least work.

A passed log is lost, so the search ends at the last place from which every reachable log can still be reached.  Among
the places before it, the one with the most logs in reach wins, then the one with the shortest crane work.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Final

import numpy as np

from autonomy.grasp.planner import NoGrasp
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.manager.log_map import MappedLog
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.carrier import pivot_height_m, rear_from_base
from machine.profile import Carrier

STEP_M: Final = 0.25
SIDE_CLEARANCE_M: Final = 0.35
"""A log's centre lies at least this far outside the machine's sides, beyond its own half width."""

TELESCOPE_RESERVE_M: Final = 0.15
"""Telescope stroke kept in reserve for position errors."""

BEYOND_ARM_M: Final = 0.5
"""No log is grasped whose centre is farther than this beyond the straight arm: it may be gripped off its centre, and
the column leans.
"""

BaseAt = Callable[[float], Pose]
"""The crane's base in the plane when the machine stands at a distance [m] along its path."""


@dataclass(frozen=True, slots=True)
class LoadingStop:
    """A place along the path [m], the logs to grasp there, best first, and the crane's work for them [s]."""

    along_m: float
    numbers: tuple[int, ...]
    work_s: float


class CraneReach:
    """Which logs the crane can grasp, with the frame at loading height."""

    def __init__(self, arm: Arm, carrier: Carrier) -> None:
        self._arm, self.ground_z_m = arm, arm.profile.workspace.ground_z_m
        self._side_clearance_m = 0.5 * (carrier.track_width_m + carrier.wheel_width_m) + SIDE_CLEARANCE_M
        bunk = arm.profile.bunk
        self._rear_end_m = bunk.center_m[0] + 0.5 * bunk.length_m + SIDE_CLEARANCE_M
        slew = arm.profile.joints["slew"]
        self._slew_rad_s = slew.speed_limit
        self._out_m_s = arm.profile.joints["ext"].speed_limit
        self._longest_m = arm.profile.joints["ext"].upper - TELESCOPE_RESERVE_M
        kin = arm.profile.kinematics
        self.max_distance_m = kin.a1_m + kin.a2_m + math.hypot(kin.a3_m, kin.d4_m + self._longest_m) + BEYOND_ARM_M

    def work_s(self, log: LogObservation, is_clear: bool = False) -> float:
        """Estimate the duration of the crane's motion to a log and back [s]; infinite if it cannot be grasped.
        ``is_clear``: the log is known to lie clear of the machine.
        """
        x, y, _ = log.center_m
        if (
            not is_clear
            and abs(y) < self._side_clearance_m + 0.5 * log.diameter_m
            and x < self._rear_end_m + 0.5 * log.length_m
        ):
            return math.inf  # under the machine, or its bunk
        try:
            pose = plan_single_log_grasp(self._arm, log, 0.0).pose
        except NoGrasp:
            return math.inf
        if pose.ext_m > self._longest_m:
            return math.inf
        home = self._arm.profile.bunk.center_m
        out_m = abs(pose.r_m - math.hypot(*home))
        return 2.0 * max(abs(pose.slew_rad - math.atan2(home[1], home[0])) / self._slew_rad_s, out_m / self._out_m_s)


def best_stop(
    logs: Sequence[MappedLog], reach: CraneReach, base_at: BaseAt, begin_m: float, end_m: float
) -> LoadingStop | None:
    """Find the best stop between two distances along the path [m]; None when no log can be grasped from there."""
    places = np.arange(begin_m, end_m + 1e-9, STEP_M)
    bases = [base_at(along_m) for along_m in places.tolist()]

    @cache
    def work_s(i: int, j: int) -> float:
        log, base = logs[j], bases[i]
        if math.dist(log.center_m[:2], base.position_m[:2]) > reach.max_distance_m:
            return math.inf
        return reach.work_s(_at_ground_height(log.observation(base), reach.ground_z_m))

    # From the far end: beyond the last place only whether the work is finite matters.
    lasts = (
        next((i for i in reversed(range(len(places))) if math.isfinite(work_s(i, j))), None) for j in range(len(logs))
    )
    last = min((i for i in lasts if i is not None), default=None)
    if last is None:
        return None
    work = np.array([[work_s(i, j) for j in range(len(logs))] for i in range(last + 1)])
    graspable = np.isfinite(work)
    counts, sums = graspable.sum(axis=1), np.where(graspable, work, 0.0).sum(axis=1)
    best = min(range(last + 1), key=lambda i: (-counts[i], sums[i], places[i]))
    order = sorted(np.flatnonzero(graspable[best]).tolist(), key=lambda j: work[best, j])
    return LoadingStop(float(places[best]), tuple(logs[j].number for j in order), float(sums[best]))


def _at_ground_height(log: LogObservation, ground_z_m: float) -> LogObservation:
    """Put the log at the ground height of the machine; the real height at the stop is not known yet."""
    x, y, _ = log.center_m
    return replace(log, center_m=(x, y, ground_z_m + 0.5 * log.diameter_m))


def base_on_path(
    carrier: Carrier, front: tuple[float, float, float], rear_m: tuple[float, float], height_m: float
) -> Pose:
    """Compute the crane's base when the centre of the front axle stands at ``front`` (x, y [m], direction [rad]) and
    that of the rear axle at ``rear_m`` (x, y [m]), on level ground z = 0 with the frame at a height [m].
    """
    x, y, yaw = front
    joint = (x - carrier.front_axle_m * math.cos(yaw), y - carrier.front_axle_m * math.sin(yaw))
    rear = math.atan2(joint[1] - rear_m[1], joint[0] - rear_m[0])
    c, s = math.cos(rear), math.sin(rear)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    base_offset, axes = _base_in_rear(carrier)
    origin = np.array([*joint, pivot_height_m(carrier, height_m)])
    return Pose(origin + turn @ base_offset, turn @ axes)


@lru_cache(maxsize=8)
def _base_in_rear(carrier: Carrier) -> tuple[np.ndarray, np.ndarray]:
    """Compute the crane's base in the rear frame: position (3,) and rotation (3, 3)."""
    base_offset, *ends = (
        np.array(rear_from_base(carrier, (float(p[0]), float(p[1]), float(p[2])))) for p in (np.zeros(3), *np.eye(3))
    )
    return base_offset, np.stack([end - base_offset for end in ends], axis=1)
