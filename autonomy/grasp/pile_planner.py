"""How a heap between stakes is emptied: open tongs are pressed into it, and close on whatever is between them.

Tips that stay over a heap take one log off it, if any: they pinch what is on top, and what they are to sweep along lies
in a hollow.  Drivers lower the open tongs until these have gone in among the logs, or rest on some, and close there.
Of places and depths the one is taken that has most wood between the tongs, not more than they hold, and where the tips
come down beside logs rather than on their middles.  It is not asked whether each log lies well: the rest of the heap
holds it.  A place where nothing came up is not tried again until something did, nor one with a log between the tongs
that is to stay.  Logs that lie on no others are left to another planner.  Heights of the heap come from the log list
alone.  Failure: ``NoGrasp`` with one sentence.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import atan2, pi
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders, as_cylinders
from autonomy.grasp.grapple_heights import grasp_pose
from autonomy.grasp.jaws import Jaws, jaws_of
from autonomy.grasp.planner import GraspCandidate, NoGrasp, GraspPlanner
from autonomy.grasp.quality import STRICT_RULE, BladeSections, rests_upon, blade_sections
from autonomy.motion.arm import Arm
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.kinematics import Unreachable

ACROSS_OFFSETS_M: Final = np.linspace(-0.72, 0.72, 37)
ALONG_OFFSETS_M: Final = np.array([0.0, -0.15, 0.15])
"""Places looked at, from the middle of the heap."""
YAW_OFFSETS_RAD: Final = np.radians([0.0, -6.0, 6.0])
DEPTHS_M: Final = np.arange(0.15, 0.651, 0.05)
"""Under the highest log between the tongs."""
PUSH_SCALE_M: Final = 0.05
"""Logs that must be pushed aside by this much in all make a place worth a third."""
MAX_PUSH_SHARE: Final = 0.85
"""A tip that meets a log nearer to its middle than this share of its radius stands on it."""
OFF_CENTRE_SCALE_M: Final = 0.5
"""Logs whose middles are this far from the tongs make a place worth a third: they would hang askew."""
TIP_ON_LOG_FACTOR: Final = 0.02
"""What such a place is worth beside others; it is a last resort, for closing tongs slide off."""
FULL_SHARE: Final = 0.9
"""So much of what closed tongs hold may be between them: with more they stand wide open, and hold little of it."""
OVERFULL_SCALE: Final = 0.1
"""So much more of it makes a place worth a third."""
FAILED_RADIUS_M: Final = 0.2
"""So near to a place where nothing came up none is tried."""
SUCCESS_PROBABILITY: Final = 0.8
"""Share of such grasps that bring something up: 22 of 28 while two bunks of 24 logs were emptied in the plant."""


@dataclass(frozen=True, slots=True)
class _PileCandidates:
    """Candidates of one shape (c,): place [m], opening axis [rad], height that the tips go down to [m], what they are
    worth (0: nothing), and (c, n) what is between the tongs."""

    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    level: np.ndarray
    worth: np.ndarray
    between: np.ndarray


class PilePlanner:
    """A planner (``autonomy.grasp.planner``) for a heap; ``single`` is for logs that lie beside each other.

    It remembers its last proposal, and where proposals failed: one of it belongs to one machine.
    """

    def __init__(self, single: GraspPlanner) -> None:
        self._single = single
        self._last: tuple[tuple[float, float], set[int]] | None = None
        self._shunned: list[tuple[float, float]] = []

    def __call__(
        self,
        arm: Arm,
        logs: Sequence[LogObservation],
        slew_rad: float,
        rot_rad: float,
        stay: Collection[int] = (),
    ) -> GraspCandidate:
        """The best place to press down, else the best grasp of ``single``; raises ``NoGrasp``."""
        if not logs:
            raise NoGrasp("no log is in view")
        self._learn(logs)
        world = as_cylinders(logs)
        if not rests_upon(world).any():
            try:
                return self._noted(self._single(arm, logs, slew_rad, rot_rad, stay), logs)
            except NoGrasp:  # a row from stake to stake: the tongs come down on some of it, and slide off
                pass
        places = self._places(arm, world, stay)
        for i in np.argsort(-places.worth, kind="stable"):
            if places.worth[i] <= 0.0:
                break
            try:
                self._reach(arm, places, int(i), world, rot_rad)
            except Unreachable:
                continue
            return self._noted(_proposal(places, int(i), logs), logs)
        return self._noted(self._single(arm, logs, slew_rad, rot_rad, stay), logs)

    def _learn(self, logs: Sequence[LogObservation]) -> None:
        """Whether the last proposal brought something up: if not, its place is shunned."""
        if self._last is None:
            return
        at, wanted = self._last
        self._last = None
        if wanted <= {log.id for log in logs}:
            self._shunned.append(at)
        else:
            self._shunned.clear()

    def _noted(self, found: GraspCandidate, logs: Sequence[LogObservation]) -> GraspCandidate:
        self._last = (found.x_m, found.y_m), {logs[i].id for i in found.logs}
        return found

    def _places(self, arm: Arm, world: Cylinders, stay: Collection[int]) -> _PileCandidates:
        """All that are looked at."""
        jaws, bunk = jaws_of(arm.profile), arm.profile.bunk
        middle = np.average(world.center[:, :2], axis=0)
        # The direction in which the logs lie, whichever way each points.
        double = np.mean((world.axis[:, 0] + 1j * world.axis[:, 1]) ** 2)
        lie = atan2(double.imag, double.real) / 2.0
        along, across = np.array([np.cos(lie), np.sin(lie)]), np.array([-np.sin(lie), np.cos(lie)])
        a, b, t, depth = (g.ravel() for g in np.meshgrid(ALONG_OFFSETS_M, ACROSS_OFFSETS_M, YAW_OFFSETS_RAD, DEPTHS_M, indexing="ij"))
        x, y = (middle[k] + a * along[k] + b * across[k] for k in (0, 1))
        yaw = lie + pi / 2 + t
        at = blade_sections(jaws, world, x, y, yaw)
        close = at.inside & (np.minimum(np.abs(at.low_u), np.abs(at.high_u)) < jaws.half_gap_m)
        top = np.max(np.where(close, at.top, -np.inf), axis=-1)
        level = np.maximum(top - depth, bunk.floor_z_m)
        between, worth = _utility(jaws, world, at, level)
        worth = np.where(between[:, list(stay)].any(axis=-1), 0.0, worth)
        for sx, sy in self._shunned:
            worth = np.where(np.hypot(x - sx, y - sy) < FAILED_RADIUS_M, 0.0, worth)
        return _PileCandidates(x, y, yaw, level, worth, between)

    def _reach(self, arm: Arm, at: _PileCandidates, i: int, world: Cylinders, rot_rad: float) -> None:
        thin = 2.0 * float(np.min(world.radius[at.between[i]]))
        grasp_pose(arm, float(at.x[i]), float(at.y[i]), float(at.yaw[i]), float(at.level[i]), thin, rot_rad)


def _utility(jaws: Jaws, world: Cylinders, at: BladeSections, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is between the tongs of candidates (c, n) and what they are worth (c,)."""
    r, middle_u = world.radius, 0.5 * (at.low_u + at.high_u)
    over = at.inside & (at.top > level[:, None])
    between = over & (np.abs(middle_u) < jaws.half_gap_m) & (at.bottom + 2.0 * STRICT_RULE.scoop * r > level[:, None])
    push = np.zeros(len(level))
    stands = np.zeros(len(level), bool)
    for side in (-1.0, 1.0):
        tip = side * (jaws.half_gap_m + jaws.plate_m / 2)
        off = np.abs(middle_u - tip)
        # A log that is wholly under the tips' height is not met; of a half sunk one only the crown is.
        height = np.clip(level[:, None] - at.middle, 0.0, r)
        wide = np.sqrt(np.maximum(r**2 - height**2, 0.0))
        push += np.sum(np.where(over, np.maximum(wide + jaws.plate_m / 2 - off, 0.0), 0.0), axis=-1)
        stands |= np.any(over & (at.middle > level[:, None]) & (off < (1.0 - MAX_PUSH_SHARE) * r), axis=-1)
    wood = np.sum(np.where(between, pi * r**2, 0.0), axis=-1)
    share = wood / jaws.holds_m2
    off_m = np.sum(np.where(between, pi * r**2 * np.abs(at.along), 0.0), axis=-1) / np.maximum(wood, 1e-9)
    worth = share * np.exp(-push / PUSH_SCALE_M - (off_m / OFF_CENTRE_SCALE_M) ** 2)
    worth = worth * np.where(stands, TIP_ON_LOG_FACTOR, 1.0) * np.exp(-np.maximum(share - FULL_SHARE, 0.0) / OVERFULL_SCALE)
    return between, worth


def _proposal(at: _PileCandidates, i: int, logs: Sequence[LogObservation]) -> GraspCandidate:
    taken = tuple(int(k) for k in np.flatnonzero(at.between[i]))
    names = ", ".join(str(logs[k].id) for k in taken)
    reason = f"pressed into the heap, {len(taken)} of {len(logs)} logs ({names}) between the tongs"
    place = float(at.x[i]), float(at.y[i]), float(at.yaw[i]), float(at.level[i])
    return GraspCandidate(*place, taken, SUCCESS_PROBABILITY, reason, pressed=True)
