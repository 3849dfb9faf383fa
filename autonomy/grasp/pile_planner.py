"""Grasp planner for a pile between stakes: the open jaws penetrate the pile and close on what is between them.

Tips that stay above a pile take one log off it, if any: they pinch what is on top, and what they should sweep along
lies in a hollow.  Drivers lower the open jaws until these have gone in among the logs, or rest on some, and close
there. The planner takes the place and depth with most wood between the jaws, up to what they hold, where the tips
come down beside logs rather than on their middles.  It does not ask whether each log lies well: the rest of the pile
holds it. After a grasp that brought nothing up, its place is not tried again until another succeeds; a place with a
log between the jaws that must stay is never tried.  Where no log lies on another, a second planner decides.  Heights
of the pile come from the log list alone.  Failure: ``NoGrasp``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import atan2, pi
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders, as_cylinders
from autonomy.grasp.grapple_heights import grasp_pose
from autonomy.grasp.planner import GraspCandidate, GraspPlanner, GraspRequest, NoGrasp
from autonomy.grasp.quality import STRICT_RULE, BladeSections, Jaws, blade_sections, jaws_of, rests_upon
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from machine.geometry.kinematics import Unreachable

ACROSS_OFFSETS_M: Final = np.linspace(-0.72, 0.72, 37)
ALONG_OFFSETS_M: Final = np.array([0.0, -0.15, 0.15])
"""Offsets of the candidate places from the middle of the pile."""
YAW_OFFSETS_RAD: Final = np.radians([0.0, -6.0, 6.0])
DEPTHS_M: Final = np.arange(0.15, 0.651, 0.05)
"""Depths of the tips below the highest log between the jaws."""
PUSH_SCALE_M: Final = 0.05
"""A total push of this much on other logs reduces the utility of a place to a third."""
MAX_PUSH_SHARE: Final = 0.85
"""A tip that meets a log nearer to its middle than this share of its radius stands on the log."""
OFF_CENTRE_SCALE_M: Final = 0.5
"""A mean distance of this much from the logs' centres reduces the utility to a third: they would hang askew."""
TIP_ON_LOG_FACTOR: Final = 0.02
"""Factor on the utility of a place where a tip stands on a log; closing jaws slide off, so it is a last resort."""
FULL_SHARE: Final = 0.9
"""Share of the capacity that may be between the jaws: with more, they stand wide open and hold little of it."""
OVERFULL_SCALE: Final = 0.1
"""An excess of this share reduces the utility to a third."""
FAILED_RADIUS_M: Final = 0.2
"""No place within this distance of a failed one is tried."""
SUCCESS_PROBABILITY: Final = 0.8
"""Share of such grasps that lift something: 22 of 28 while two bunks of 24 logs were emptied in the plant."""


@dataclass(frozen=True, slots=True)
class _PileCandidates:
    """Candidates of one shape (c,): place [m], opening axis [rad], height that the tips go down to [m], utility (0:
    useless), and which logs are between the jaws (c, n)."""

    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    level: np.ndarray
    utility: np.ndarray
    between: np.ndarray


class PilePlanner:
    """A ``GraspPlanner`` for a pile; ``single`` plans where logs lie beside each other.

    It remembers its last candidate and the places that failed, so each machine needs its own.
    """

    def __init__(self, single: GraspPlanner) -> None:
        self._single = single
        self._last_proposal: tuple[tuple[float, float], set[int]] | None = None
        self._failed_places: list[tuple[float, float]] = []

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        """Return the best penetration grasp, else the best grasp of ``single``; raise ``NoGrasp`` without one."""
        logs = request.logs
        if not logs:
            raise NoGrasp("grasp.no-log-in-view", "no log is in view")
        if not request.untried:
            self._remember_failure(logs)
        world = as_cylinders(logs)
        if not rests_upon(world).any():
            try:
                return self._remember(self._single(request), logs)
            except NoGrasp:  # a row from stake to stake: the jaws come down on some of it and slide off
                pass
        places = self._candidates(request.arm, world, request.stay)
        for i in np.argsort(-places.utility, kind="stable"):
            if places.utility[i] <= 0.0:
                break
            try:
                self._check_reach(request.arm, places, int(i), world, request.rot_rad)
            except Unreachable:
                continue
            return self._remember(_proposal(places, int(i), logs), logs)
        return self._remember(self._single(request), logs)

    def _remember_failure(self, logs: Sequence[LogObservation]) -> None:
        """Record the place of the last candidate as failed if all its logs are still there."""
        if self._last_proposal is None:
            return
        location_m, proposed_ids = self._last_proposal
        self._last_proposal = None
        if proposed_ids <= {log.id for log in logs}:
            self._failed_places.append(location_m)
        else:
            self._failed_places.clear()

    def _remember(self, found: GraspCandidate, logs: Sequence[LogObservation]) -> GraspCandidate:
        self._last_proposal = (found.x_m, found.y_m), {logs[i].id for i in found.logs}
        return found

    def _candidates(self, arm: Arm, world: Cylinders, stay: Collection[int]) -> _PileCandidates:
        """List all candidates, with their utility."""
        jaws, bunk = jaws_of(arm.profile), arm.profile.bunk
        middle = np.average(world.center[:, :2], axis=0)
        # The common direction of the logs, whichever way each points.
        double = np.mean((world.axis[:, 0] + 1j * world.axis[:, 1]) ** 2)
        lie = atan2(double.imag, double.real) / 2.0
        along, across = np.array([np.cos(lie), np.sin(lie)]), np.array([-np.sin(lie), np.cos(lie)])
        a, b, t, depth = (
            g.ravel() for g in np.meshgrid(ALONG_OFFSETS_M, ACROSS_OFFSETS_M, YAW_OFFSETS_RAD, DEPTHS_M, indexing="ij")
        )
        x, y = (middle[k] + a * along[k] + b * across[k] for k in (0, 1))
        yaw = lie + pi / 2 + t
        at = blade_sections(jaws, world, x, y, yaw)
        close = at.inside & (np.minimum(np.abs(at.low_u), np.abs(at.high_u)) < jaws.half_gap_m)
        top = np.max(np.where(close, at.top, -np.inf), axis=-1)
        level = np.maximum(top - depth, bunk.floor_z_m)
        between, worth = _utility(jaws, world, at, level)
        worth = np.where(between[:, list(stay)].any(axis=-1), 0.0, worth)
        for sx, sy in self._failed_places:
            worth = np.where(np.hypot(x - sx, y - sy) < FAILED_RADIUS_M, 0.0, worth)
        return _PileCandidates(x, y, yaw, level, worth, between)

    def _check_reach(self, arm: Arm, at: _PileCandidates, i: int, world: Cylinders, rot_rad: float) -> None:
        thin = 2.0 * float(np.min(world.radius[at.between[i]]))
        grasp_pose(arm, float(at.x[i]), float(at.y[i]), float(at.yaw[i]), float(at.level[i]), thin, rot_rad)


def _utility(jaws: Jaws, world: Cylinders, at: BladeSections, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find which logs are between the jaws of candidates (c, n), and compute the candidates' utility (c,)."""
    r, middle_u = world.radius, 0.5 * (at.low_u + at.high_u)
    over = at.inside & (at.top > level[:, None])
    between = (
        over & (np.abs(middle_u) < jaws.half_gap_m) & (at.bottom + 2.0 * STRICT_RULE.scoop_share * r > level[:, None])
    )
    push = np.zeros(len(level))
    stands = np.zeros(len(level), bool)
    for side in (-1.0, 1.0):
        tip = side * (jaws.half_gap_m + jaws.plate_m / 2)
        off = np.abs(middle_u - tip)
        # The tips do not meet a log that lies wholly below them; of a half-sunk log they meet the crown.
        height = np.clip(level[:, None] - at.middle, 0.0, r)
        wide = np.sqrt(np.maximum(r**2 - height**2, 0.0))
        push += np.sum(np.where(over, np.maximum(wide + jaws.plate_m / 2 - off, 0.0), 0.0), axis=-1)
        stands |= np.any(over & (at.middle > level[:, None]) & (off < (1.0 - MAX_PUSH_SHARE) * r), axis=-1)
    wood = np.sum(np.where(between, pi * r**2, 0.0), axis=-1)
    share = wood / jaws.capacity_m2
    off_m = np.sum(np.where(between, pi * r**2 * np.abs(at.along), 0.0), axis=-1) / np.maximum(wood, 1e-9)
    worth = share * np.exp(-push / PUSH_SCALE_M - (off_m / OFF_CENTRE_SCALE_M) ** 2)
    worth = (
        worth * np.where(stands, TIP_ON_LOG_FACTOR, 1.0) * np.exp(-np.maximum(share - FULL_SHARE, 0.0) / OVERFULL_SCALE)
    )
    return between, worth


def _proposal(at: _PileCandidates, i: int, logs: Sequence[LogObservation]) -> GraspCandidate:
    taken = tuple(int(k) for k in np.flatnonzero(at.between[i]))
    names = ", ".join(str(logs[k].id) for k in taken)
    reason = f"penetrates the pile, {len(taken)} of {len(logs)} logs ({names}) between the jaws"
    grasp_geometry = float(at.x[i]), float(at.y[i]), float(at.yaw[i]), float(at.level[i])
    return GraspCandidate(*grasp_geometry, taken, SUCCESS_PROBABILITY, reason, penetrates=True)
