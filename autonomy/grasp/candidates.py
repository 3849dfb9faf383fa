"""Grasp candidates: stations along the topmost logs in reach, shifted sideways and turned, and the best of them.

`candidate_grid` lists all of them; `finalists` keeps the best safe ones of every set of captured logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import pi
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import MIN_RADIUS_M, Cylinders
from autonomy.grasp.grapple_heights import closing_height_curve, tip_clearance_m, travel_height_m
from autonomy.grasp.planner import NoGrasp
from autonomy.grasp.quality import BladeSections, GraspScores
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from machine.geometry.kinematics import Unreachable

ALONG_SHARES: Final = np.linspace(-0.21, 0.21, 7)
"""Stations along a log, as shares of its length from the middle; operators do not grip nearer to the ends."""
SIDEWAYS_OFFSETS_M: Final = np.linspace(-0.48, 0.48, 9)
YAW_OFFSETS_RAD: Final = np.radians([-14.0, -7.0, 0.0, 7.0, 14.0])
ANCHOR_LOG_COUNT: Final = 8
"""Number of logs, the topmost in reach, that have candidates."""
CENTRING_SCALE_M: Final = 0.15
"""This distance off the middle of the jaws reduces the score of a grasp to a third."""
SQUARENESS_SCALE: Final = 0.04
"""Mean squared sine of the logs' obliquity that reduces the score to a third: 11 deg."""
FINALIST_COUNT: Final = 40
SEED: Final = 1


@dataclass(frozen=True, slots=True)
class CandidateArrays:
    """Arrays of one length: place [m], opening axis [rad], height above which logs are taken [m]."""

    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    level: np.ndarray


def reachable_stations(arm: Arm, logs: Sequence[LogObservation], stays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the topmost reachable logs (k,), by index, and which of the stations ``ALONG_SHARES`` are in reach (k, s).

    ``stays`` (n,) marks logs that must not be gripped.

    Raises:
        NoGrasp: no log is in reach.
    """
    high = travel_height_m(arm.profile)
    over_support = closing_height_curve(arm.profile, 0.0, 2.0 * MIN_RADIUS_M)(0.0) - tip_clearance_m(2.0 * MIN_RADIUS_M)
    top, reached, trouble = list[int](), list[list[bool]](), ""

    def served(log: LogObservation, along: float) -> bool:
        nonlocal trouble
        x, y, z = (c + along * log.length_m * a for c, a in zip(log.center_m, log.axis, strict=True))
        try:
            arm.pose_above(x, y, z - log.diameter_m / 2 + tip_clearance_m(log.diameter_m) + over_support, high)
        except Unreachable as error:
            trouble = trouble or f"log {log.id}: {error}"
            return False
        return True

    for i in sorted(np.flatnonzero(~stays).tolist(), key=lambda i: -logs[i].center_m[2]):
        whole = all(served(logs[i], along) for along in (0.0, ALONG_SHARES[0], ALONG_SHARES[-1]))
        stations = [whole or served(logs[i], along) for along in ALONG_SHARES]
        if any(stations):
            top.append(i)
            reached.append(stations)
        if len(top) == ANCHOR_LOG_COUNT:
            break
    if not top:
        raise NoGrasp("grasp.no-log-in-reach", f"no log is in reach; {trouble or 'all logs in view must stay'}")
    return np.array(top), np.array(reached)


def candidate_grid(world: Cylinders, top: np.ndarray, reached: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List all candidates about the logs ``top`` (k,) at the stations ``reached`` (k, s): x, y [m] and opening axis
    [rad]."""
    center, axis, length = world.center[top], world.axis[top], world.length[top]
    flat = np.arctan2(axis[:, 1], axis[:, 0])[:, None, None, None]
    along = ALONG_SHARES[:, None, None] * length[:, None, None, None]
    side, turned = SIDEWAYS_OFFSETS_M[:, None], YAW_OFFSETS_RAD
    cx, cy, ax, ay = (v[:, k, None, None, None] for v in (center, axis) for k in (0, 1))
    x = cx + along * ax - side * np.sin(flat)
    y = cy + along * ay + side * np.cos(flat)
    keep = np.broadcast_to(reached[:, :, None, None], np.broadcast_shapes(x.shape, turned.shape))
    return tuple(a[keep] for a in np.broadcast_arrays(x, y, flat + turned + pi / 2))


def finalists(
    at: tuple[np.ndarray, np.ndarray, np.ndarray], levels: np.ndarray, seen: BladeSections, found: GraspScores
) -> tuple[CandidateArrays, GraspScores]:
    """Select the best candidates of every set of logs that can be captured, best first, with their scores."""
    where = np.nonzero(found.safe)
    safe = GraspScores(*(getattr(found, f.name)[where] for f in fields(GraspScores)))
    near = BladeSections(*(getattr(seen, f.name)[where[0]] for f in fields(BladeSections)))
    order = _diverse_best(safe.balance * (1.0 + 0.3 * safe.count) * centring(near, safe.captured), safe.captured)
    x, y, yaw = (c[where[0]][order] for c in at)
    chosen = GraspScores(*(getattr(safe, f.name)[order] for f in fields(GraspScores)))
    return CandidateArrays(x, y, yaw, levels[where][order]), chosen


def centring(at: BladeSections, captured: np.ndarray) -> np.ndarray:
    """Compute how well centred between the jaws and how square to them the captured logs are, 0 to 1."""
    low = np.min(np.where(captured, at.low_u, np.inf), axis=-1)
    high = np.max(np.where(captured, at.high_u, -np.inf), axis=-1)
    askew = np.sum(np.where(captured, at.obliquity_sq, 0.0), axis=-1) / np.sum(captured, axis=-1)
    score: np.ndarray = np.exp(-(((low + high) / 2 / CENTRING_SCALE_M) ** 2) - askew / SQUARENESS_SCALE)
    return score


def _diverse_best(rough: np.ndarray, captured: np.ndarray) -> np.ndarray:
    """Select the best candidates of every set of captured logs, by index, so that no set crowds the others out."""
    code = captured @ np.random.default_rng(SEED).random(captured.shape[1])
    order = np.argsort(-rough, kind="stable")
    sets, first_index = np.unique(code[order], return_index=True)
    each = max(2, FINALIST_COUNT // len(sets))
    keep = [order[code[order] == s][:each] for s in sets[np.argsort(first_index)][: FINALIST_COUNT // 2]]
    chosen: np.ndarray = np.concatenate(keep)
    return chosen[np.argsort(-rough[chosen], kind="stable")]
