"""Grasps found by looking at all of them: the virtual world is known, so every candidate is scored in it directly.

Stations along every log, shifted sideways and turned, at every height that a layer of logs may be taken from, are
judged by the rule of ``autonomy.grasp.quality``; the best go through draws of what perception and crane are unsure of.
Among grasps that are equally safe the one with more wood wins, then the one nearer to the wood's middle.  A machine on
wheels knows no height of the ground: there the undersides of the logs that lie on no other tell it.  Where a camera
measured the logs, tongs that come down on a heap are pressed into it, and one always is proposed.  Inputs: log list,
with covariances where perception gives them.  Failure: ``NoGrasp`` with one sentence.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from math import atan2, isfinite, pi
from typing import Final

import numpy as np

from autonomy.grasp.candidates import ALONG_SHARES, CandidateArrays, candidate_grid, finalists, reachable_stations
from autonomy.grasp.cylinders import Cylinders, log_covariance, as_cylinders, sample_cylinders
from autonomy.grasp.grapple_heights import known_ground_m, grasp_pose
from autonomy.grasp.jaws import Jaws, jaws_of
from autonomy.grasp.planner import GraspCandidate, NoGrasp
from autonomy.grasp.quality import (
    MAX_AXIS_OBLIQUITY,
    LAYER_RULE,
    LOWEST_ROW_M,
    STRICT_RULE,
    WIDE_RULE,
    CaptureRule,
    GraspScores,
    BladeSections,
    rests_upon,
    score_grasps,
    blade_sections,
)
from autonomy.grasp.row_extraction import extract_end_log
from autonomy.grasp.settled_poses import settled_poses
from autonomy.motion.arm import Arm
from autonomy.perception.log_list.estimate import RADIUS
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.kinematics import Unreachable

DRAW_COUNT: Final = 32
CRANE_SIGMA_M: Final = (0.02, 0.02, 0.01)
"""Standard deviation of where the crane puts the grapple."""
CRANE_SIGMA_RAD: Final = 0.02
HIDDEN_RADIUS_SIGMA_M: Final = 0.02
"""Standard deviation of the radius of a log under others, at least: a camera sees a part of it."""
PROBABILITY_TOLERANCE: Final = 0.08
"""So much less probable may a grasp be that takes more."""
RELAX_BELOW_PROBABILITY: Final = 0.75
"""When no grasp is more probable than this, those are looked at too that only pinch or squeeze."""
RULES_WITH_TRUST: Final = ((STRICT_RULE, 1.0), (LAYER_RULE, 0.95), (WIDE_RULE, 0.65))
"""First the strict one, with the success of such grasps over what the draws say."""
TRY_ABOVE_PROBABILITY: Final = 0.5
"""Grasps that are more probable than this are tried before a log is drawn out of a row: tongs that stall or miss are
sent anew, 68 of 72 such grasps came up in the plant, and a drawn log comes alone."""
OFF_CENTRE_PENALTY, GOOD_LEVERAGE = 0.3, 0.3
"""So much less probable is a grasp far off the middle; one whose lever is better than this is not."""
PENETRATION_M: Final = 0.15
"""So much lower than planned, but for the ground, open tongs are pressed in among logs that a camera measured: it sees
what lies high up to 0.1 m too high, and tips that are too high close over it; those too low rest on what lies there."""
FREE_PENETRATION_M: Final = 0.05
"""The same where they come down beside all logs: nothing stops them, and what they close round may be too much."""
TIP_HALF_WIDTH_M: Final = 0.08
"""Half the width of a tong's tip, with what its place is unsure by."""
LAST_RESORT_PROBABILITY: Final = 0.3
"""Success of such tongs over the topmost log where no grasp is safe."""
MAX_FLOATING_M, MAX_FLOATING_ON_WHEELS_M = 0.4, 1.5
"""A log whose middle is so high over the ground lies on others; on wheels, over the lowest log, for ground slopes."""
SEED: Final = 1


class SamplingPlanner:
    """A planner (``autonomy.grasp.planner``).  Logs without a covariance count as known well.

    ``rules``: how strict a grasp must be, the strictest first, each with its success over what the draws say.
    """

    def __init__(self, rules: Sequence[tuple[CaptureRule, float]] = RULES_WITH_TRUST) -> None:
        self._rules = rules

    def __call__(
        self,
        arm: Arm,
        logs: Sequence[LogObservation],
        slew_rad: float,
        rot_rad: float,
        stay: Collection[int] = (),
    ) -> GraspCandidate:
        """The best grasp that the crane reaches; raises ``NoGrasp``."""
        if not logs:
            raise NoGrasp("no log is in view")
        lying = _supported_logs(arm, logs)
        if not lying:
            raise NoGrasp(f"none of the {_log_count(logs)} in view lies on anything")
        found = self._best(arm, [logs[i] for i in lying], np.isin(lying, list(stay)), rot_rad)
        return replace(found, logs=tuple(lying[i] for i in found.logs))

    def _best(self, arm: Arm, logs: Sequence[LogObservation], stays: np.ndarray, rot_rad: float) -> GraspCandidate:
        """The best grasp of logs that lie on something and none of which floats; ``stays`` (n,) are not to be taken."""
        wanted = _log_count(np.flatnonzero(~stays).tolist())
        ground = known_ground_m(arm.profile)
        jaws, world = jaws_of(arm.profile), as_cylinders(logs)
        sigma = np.stack([log_covariance(log) for log in logs])
        if isfinite(ground):
            world, sigma = settled_poses(world, sigma, ground)
        upon = rests_upon(world)
        top, stations = reachable_stations(arm, logs, stays)
        at = candidate_grid(world, top, stations)
        seen = blade_sections(jaws, world, *at)
        floor = np.full(len(at[0]), ground) if isfinite(ground) else _ground_between_jaws(jaws, seen, upon)
        tops = np.unique(np.round(world.center[:, 2] + world.radius, 3))
        levels = np.concatenate([floor[:, None], np.broadcast_to(tops, (len(floor), len(tops)))], axis=1)
        measured = np.array([log.covariance is not None for log in logs])
        under = upon.any(axis=1) & measured
        sigma[under, RADIUS, RADIUS] = np.maximum(sigma[under, RADIUS, RADIUS], HIDDEN_RADIUS_SIGMA_M**2)
        drawn = sample_cylinders(world, sigma, DRAW_COUNT, SEED)
        plans = []
        for rule, trust in self._rules:
            reached = [float(np.max(plan[2])) for plan in plans]
            if reached and (reached[0] >= RELAX_BELOW_PROBABILITY or max(reached) >= trust):
                break
            found = _without_excluded(score_grasps(jaws, world, upon, _with_height_axis(seen), levels, rule), stays)
            if found.safe.any():
                best, found = finalists(at, levels, seen, found)
                share = self._probability(jaws, drawn, upon, best, found.captured, rule, stays)
                held = 1.0 - OFF_CENTRE_PENALTY * np.maximum(1.0 - found.lever / GOOD_LEVERAGE, 0.0)
                plans.append((best, found, trust * held * share))
        lowest = ground if isfinite(ground) else float(np.min(world.center[:, 2] - world.radius))
        likely = bool(plans) and max(float(np.max(plan[2])) for plan in plans) >= TRY_ABOVE_PROBABILITY
        if measured.any() and not likely:
            drawn = extract_end_log(arm, jaws, world, upon, logs, stays, lowest, rot_rad)
            if drawn is not None:
                return drawn
        if not plans:
            if measured.any():
                return self._over(arm, logs, int(top[0]), stations[0], lowest, rot_rad)
            raise NoGrasp(
                f"no grasp of the {wanted} is safe: every one closes on a log that stays, takes one from "
                "under another or more than the grapple holds"
            )
        best, found, probability = max(plans, key=lambda plan: float(np.max(plan[2])))
        captured, trouble = found.captured, ""
        for i in _rank(probability, found.count):
            try:
                self._reach(arm, best, int(i), logs, captured[i], rot_rad)
            except Unreachable as error:
                trouble = str(error)
                continue
            proposal = self._proposal(best, int(i), captured[i], float(probability[i]), logs)
            deep_m = _penetration_m(jaws, world, proposal) if measured.any() else 0.0
            return _penetrating(proposal, deep_m, lowest)
        raise NoGrasp(f"no grasp of the {wanted} is in reach: {trouble}")

    def _over(
        self, arm: Arm, logs: Sequence[LogObservation], i: int, stations: np.ndarray, lowest_m: float, rot: float
    ) -> GraspCandidate:
        """Tongs pressed in over a log where it is reached."""
        log = logs[i]
        along = log.length_m * float(min(ALONG_SHARES[stations], key=abs))
        x, y, z = (c + along * a for c, a in zip(log.center_m, log.axis, strict=True))
        yaw, captured = atan2(log.axis[1], log.axis[0]) + pi / 2, np.arange(len(logs)) == i
        level = max(z - log.diameter_m / 2, lowest_m)
        at = CandidateArrays(*(np.array([v]) for v in (x, y, yaw, level)))
        try:
            self._reach(arm, at, 0, logs, captured, rot)
        except Unreachable as error:
            raise NoGrasp(
                f"no grasp of the {_log_count(logs)} is safe, and log {log.id} is out of reach: {error}"
            ) from None
        reason = f"no grasp of the {_log_count(logs)} is sure to be safe: over log {log.id}, the topmost"
        return _penetrating(GraspCandidate(x, y, yaw, level, (i,), LAST_RESORT_PROBABILITY, reason), PENETRATION_M, lowest_m)

    def _probability(
        self,
        jaws: Jaws,
        drawn: Cylinders,
        upon: np.ndarray,
        best: CandidateArrays,
        captured: np.ndarray,
        rule: CaptureRule,
        stays: np.ndarray,
    ) -> np.ndarray:
        """Share of the draws in which the rule holds and one of the wanted logs comes up."""
        rng = np.random.default_rng(SEED + 1)
        error = rng.standard_normal((DRAW_COUNT, 4)) * (*CRANE_SIGMA_M, CRANE_SIGMA_RAD)
        world = Cylinders(drawn.center[:, None], drawn.axis[:, None], drawn.length[:, None], drawn.radius[:, None])
        moved = [c[None, :] + error[:, k, None] for k, c in enumerate((best.x, best.y, best.level, best.yaw))]
        at = blade_sections(jaws, world, moved[0], moved[1], moved[3])
        found = _without_excluded(score_grasps(jaws, world, upon, at, moved[2], rule), stays)
        return np.mean(found.safe & np.any(found.captured & captured, axis=-1), axis=0)

    def _reach(
        self, arm: Arm, best: CandidateArrays, i: int, logs: Sequence[LogObservation], captured: np.ndarray, rot: float
    ) -> None:
        thinnest = min(log.diameter_m for log, c in zip(logs, captured, strict=True) if c)
        x, y, yaw, level = (float(v[i]) for v in (best.x, best.y, best.yaw, best.level))
        grasp_pose(arm, x, y, yaw, level, thinnest, rot)

    def _proposal(
        self, best: CandidateArrays, i: int, captured: np.ndarray, probability: float, logs: Sequence[LogObservation]
    ) -> GraspCandidate:
        taken = tuple(int(k) for k in np.flatnonzero(captured))
        names = ", ".join(str(logs[k].id) for k in taken)
        left = len(logs) - len(taken)
        reason = (
            f"{_log_count(taken)} ({names}) of {len(logs)} at once, "
            f"{100 * probability:.0f} % of {DRAW_COUNT} draws hold it"
            + (f"; {left} left lying" if left else "")
            + ("; nothing better is there" if probability < RELAX_BELOW_PROBABILITY else "")
        )
        return GraspCandidate(
            float(best.x[i]), float(best.y[i]), float(best.yaw[i]), float(best.level[i]), taken, probability, reason
        )


def _penetration_m(jaws: Jaws, world: Cylinders, p: GraspCandidate) -> float:
    """How much lower than planned the tongs may be pressed in: not at all where a log between them lies across those
    that are taken, which they would take, too; little where nothing stops them."""
    at = blade_sections(jaws, world, *(np.array(v) for v in (p.x_m, p.y_m, p.yaw_rad)))
    between = at.inside & (at.low_u < jaws.half_gap_m) & (at.high_u > -jaws.half_gap_m)
    between[list(p.logs)] = False
    if np.any(between & (at.askew > MAX_AXIS_OBLIQUITY**2)):
        return 0.0
    beneath = [
        np.any(at.inside & (at.low_u < tip + TIP_HALF_WIDTH_M) & (at.high_u > tip - TIP_HALF_WIDTH_M))
        for tip in (-jaws.half_gap_m, jaws.half_gap_m)
    ]
    return PENETRATION_M if any(beneath) else FREE_PENETRATION_M


def _penetrating(p: GraspCandidate, deep_m: float, lowest_m: float) -> GraspCandidate:
    """Pressed in where its tongs come down over what others lie on, and as planned on the ground."""
    if deep_m == 0.0 or p.support_z_m < lowest_m + LOWEST_ROW_M:
        return p
    return replace(p, support_z_m=max(p.support_z_m - deep_m, lowest_m), pressed=True)


def _supported_logs(arm: Arm, logs: Sequence[LogObservation]) -> list[int]:
    """Which logs lie on something: one that floats in the air is a mistake of who saw it, or hangs in a grapple."""
    world, ground = as_cylinders(logs), known_ground_m(arm.profile)
    bottom = world.center[:, 2] - world.radius
    above = bottom - (ground if isfinite(ground) else bottom.min())
    aloft = (above > (MAX_FLOATING_M if isfinite(ground) else MAX_FLOATING_ON_WHEELS_M)) & ~rests_upon(world).any(axis=0)
    return np.flatnonzero(~aloft).tolist()


def _without_excluded(found: GraspScores, stays: np.ndarray) -> GraspScores:
    """No grasp that takes one of the logs that are to stay (n,) is safe."""
    if not stays.any():
        return found
    return replace(found, safe=found.safe & ~np.any(found.captured & stays, axis=-1))


def _log_count(logs: Sequence[object]) -> str:
    return f"{len(logs)} log{'s' if len(logs) > 1 else ''}"


def _ground_between_jaws(jaws: Jaws, seen: BladeSections, upon: np.ndarray) -> np.ndarray:
    """Height (c,) of the ground between the tongs of every candidate, by the logs that lie on it; -inf without any."""
    between = seen.inside & (np.minimum(np.abs(seen.low_u), np.abs(seen.high_u)) < jaws.half_gap_m)
    return np.asarray(np.max(np.where(between & ~upon.any(axis=0), seen.bottom, -np.inf), axis=-1))


def _with_height_axis(at: BladeSections) -> BladeSections:
    """The sections of candidates (c, n) with an axis for the heights, (c, 1, n)."""
    return BladeSections(*(getattr(at, f.name)[:, None, :] for f in fields(BladeSections)))


def _rank(probability: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Best first: as probable as the best but ``PROBABILITY_TOLERANCE``, then more logs, then the order they come in."""
    safe = probability >= np.max(probability) - PROBABILITY_TOLERANCE
    return np.lexsort((-np.where(safe, count, 0), -np.where(safe, 1.0, probability)))
