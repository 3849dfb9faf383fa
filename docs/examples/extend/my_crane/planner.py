"""A foreign grasp planner: antipodal grasps across the principal axis of the wood (principal component analysis).

The classical geometric method for a two-finger gripper on a known or segmented object (for example Suzuki and Oka,
"Grasping of unknown objects on a planar surface using a single depth image", AIM 2016): the fingers close across the
first principal axis, at the centroid.  Here the object is the log in the middle of the wood, with every log beside it
whose axis is nearly the same and that fits between the open jaws.
"""

from __future__ import annotations

import math

import numpy as np

from autonomy.grasp.grapple_heights import grasp_pose
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from machine.geometry.kinematics import Unreachable

OPENING_M = 1.1
"""Width between the open jaws that the method uses."""
PARALLEL_RAD = math.radians(20.0)
SAMPLES = np.linspace(-0.5, 0.5, 9)
"""Places along a log at which points represent it."""


class PcaPlanner:
    """Proposes one grasp (the contract of `autonomy.grasp.planner.GraspPlanner`)."""

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        """Choose the grasp at the centroid of a group of logs, across their principal axis.

        Raises:
            NoGrasp: there is no log, or none that the crane can reach.
        """
        free = [i for i in range(len(request.logs)) if i not in request.stay and self._reachable(request, i)]
        if not free:
            raise NoGrasp("pca.nothing", "no log can be reached")
        middles = np.array([request.logs[i].center_m for i in free])
        first = free[int(np.argmin(np.linalg.norm(middles - middles.mean(axis=0), axis=1)))]
        group = self._beside(request, first, free)
        points = np.concatenate([self._points(request, i) for i in group])
        centre = points.mean(axis=0)
        _, _, axes = np.linalg.svd(points[:, :2] - centre[:2], full_matrices=False)
        along = math.atan2(axes[0, 1], axes[0, 0])
        support = min(request.logs[i].center_m[2] - 0.5 * request.logs[i].diameter_m for i in group)
        return GraspCandidate(
            float(centre[0]),
            float(centre[1]),
            along + 0.5 * math.pi,
            float(support),
            tuple(group),
            0.5,
            f"across the principal axis of {len(group)} logs",
        )

    @staticmethod
    def _reachable(request: GraspRequest, index: int) -> bool:
        log = request.logs[index]
        x, y, z = log.center_m
        try:
            grasp_pose(request.arm, x, y, 0.0, z - 0.5 * log.diameter_m, log.diameter_m, request.rot_rad)
        except Unreachable:
            return False
        return True

    @staticmethod
    def _points(request: GraspRequest, index: int) -> np.ndarray:
        log = request.logs[index]
        return np.asarray(log.center_m) + np.outer(SAMPLES * log.length_m, log.axis)

    @staticmethod
    def _beside(request: GraspRequest, first: int, free: list[int]) -> list[int]:
        """List the first log and those that lie along it, while all of them fit between the jaws."""
        log = request.logs[first]
        across = np.array([-log.axis[1], log.axis[0]])
        across /= np.linalg.norm(across)

        def edges(i: int) -> tuple[float, float]:
            candidate = request.logs[i]
            offset_m = float((np.asarray(candidate.center_m[:2]) - log.center_m[:2]) @ across)
            return offset_m - 0.5 * candidate.diameter_m, offset_m + 0.5 * candidate.diameter_m

        group, (low, high) = [first], edges(first)
        for i in sorted(free, key=lambda i: abs(sum(edges(i)))):
            turned = math.acos(min(1.0, abs(float(np.dot(request.logs[i].axis, log.axis)))))
            wide = max(high, edges(i)[1]) - min(low, edges(i)[0])
            if i != first and turned < PARALLEL_RAD and wide < OPENING_M:
                low, high = min(low, edges(i)[0]), max(high, edges(i)[1])
                group.append(i)
        return group
