"""Sampling-based grasp planner: scores every candidate in the known scene and estimates its success by Monte Carlo.

Candidates are stations along every log, shifted sideways and turned, at every height above which a layer of logs may
be taken.  The capture rule of ``autonomy.grasp.quality`` scores them; the best are tested in samples of what
perception and crane are uncertain about.  Among equally probable grasps the one with more wood wins, then the one
nearer to the wood's middle.  A machine on wheels does not know the height of the ground: the undersides of logs that
lie on no other give it. Where a camera measured the logs, jaws that come down on a pile penetrate it, and the planner
always proposes a grasp. Inputs: log list, with covariances where perception gives them.  Failure: ``NoGrasp``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from math import atan2, isfinite, pi
from typing import Final

import numpy as np

from autonomy.grasp.candidates import ALONG_SHARES, CandidateArrays, candidate_grid, finalists, reachable_stations
from autonomy.grasp.cylinders import Cylinders, as_cylinders, log_covariance, sample_cylinders
from autonomy.grasp.grapple_heights import grasp_pose, known_ground_m
from autonomy.grasp.hidden_logs import hidden_observations, with_hidden_logs
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from autonomy.grasp.quality import (
    LAYER_RULE,
    LOWEST_ROW_M,
    MAX_AXIS_OBLIQUITY,
    STRICT_RULE,
    TIP_HEIGHT_M,
    WIDE_RULE,
    BladeSections,
    CaptureRule,
    GraspScores,
    Jaws,
    blade_sections,
    jaws_of,
    rests_upon,
    score_grasps,
)
from autonomy.grasp.settled_poses import settled_poses
from autonomy.grasp.weight import HEAP_HEAVIER, HEAVIER, refuse_too_heavy, wood_kg
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import RADIUS, LogObservation
from machine.geometry.kinematics import Unreachable

# -- Extraction grasp: draws a log off the end of a row that is too wide for the grapple.
#
# One open jaw penetrates the valley between the log and its neighbour until its tip is beside them rather than on
# them; the other comes down on free ground beyond.  Closing, they roll the log away from the row until both are
# under it.  Jaws around the whole row would instead stall at its sides, pull, and slip off over it.


SUCCESS_PROBABILITY: Final = 0.9
"""In the plant's rows of three: 14 of 14 at the first try."""
VALLEY_OFFSET_M: Final = 0.02
"""Distance of the tip beyond the log's side: logs that touch part when the tip is pressed between them."""
NEIGHBOUR_OFFSET_M: Final = 0.05
"""A neighbour's centre is at least this far to the side of the log."""
ROW_RADIUS_M: Final = 2.5
"""Logs whose centres are farther apart belong to different rows."""


def extract_end_log(
    arm: Arm,
    jaws: Jaws,
    world: Cylinders,
    upon: np.ndarray,
    logs: Sequence[LogObservation],
    stays: np.ndarray,
    lowest_m: float,
    rot_rad: float,
) -> GraspCandidate | None:
    """Plan the extraction of the thickest log at the end of a row on the ground; None where there is none.

    The log is in reach, has free ground beside it at ``lowest_m``, is not marked in ``stays`` (n,), and neither lies on
    others nor carries any (``upon`` (n, n) of `quality.rests_upon`).  ``rot_rad`` is the present rotator angle.
    """
    barred = stays | upon.any(axis=0) | upon.any(axis=1)
    for i in np.argsort(-world.radius, kind="stable").tolist():
        if barred[i]:
            continue
        yaw = atan2(world.axis[i, 1], world.axis[i, 0]) + pi / 2
        for side in (1.0, -1.0):
            out = side * np.array([np.cos(yaw), np.sin(yaw)])
            away = world.center[:, :2] - world.center[i, :2]
            beyond, near = away @ out, np.hypot(*away.T) < ROW_RADIUS_M
            if np.any(near & (beyond > NEIGHBOUR_OFFSET_M)) or not np.any(near & (beyond < -NEIGHBOUR_OFFSET_M)):
                continue
            x, y = world.center[i, :2] + out * (jaws.half_gap_m - world.radius[i] - VALLEY_OFFSET_M)
            try:
                grasp_pose(arm, float(x), float(y), yaw, lowest_m, logs[i].diameter_m, rot_rad)
            except Unreachable:
                continue
            reason = f"draws log {logs[i].id} out of a row of {len(logs)} logs that is too wide for the grapple"
            return GraspCandidate(
                float(x), float(y), yaw, lowest_m, (i,), SUCCESS_PROBABILITY, reason, penetrates=True, extracts=True
            )
    return None


# -- Sampling-based grasp planner


DRAW_COUNT: Final = 32
CRANE_SIGMA_M: Final = (0.02, 0.02, 0.01)
"""Standard deviation of the grapple's position."""
CRANE_SIGMA_RAD: Final = 0.02
HIDDEN_RADIUS_SIGMA_M: Final = 0.02
"""Least standard deviation of the radius of a log under others: a camera sees only a part of it."""
PROBABILITY_TOLERANCE: Final = 0.08
"""Grasps within this probability of the best compete by the number of logs."""
RELAX_BELOW_PROBABILITY: Final = 0.75
"""Where no grasp is more probable than this, laxer rules that pinch or squeeze are tried, too."""
RULES_WITH_TRUST: Final = ((STRICT_RULE, 1.0), (LAYER_RULE, 0.95), (WIDE_RULE, 0.65))
"""The strictest rule first, each with its success relative to what the samples predict."""
TRY_ABOVE_PROBABILITY: Final = 0.5
"""A grasp more probable than this is tried before a log is extracted from a row: jaws that stall or miss try again, 68
of 72 such grasps came up in the plant, and an extracted log comes alone."""
OFF_CENTRE_PENALTY, GOOD_LEVERAGE = 0.3, 0.3
"""Reduction of the probability of a grasp far off the logs' middle, and the balance from which there is none."""
PENETRATION_M: Final = 0.15
"""How much lower than planned, down to the ground, the open jaws go among logs that a camera measured: it sees high
logs up to 0.1 m too high, and tips that are too high close above them; tips that are too low come to rest on what
lies there."""
MOST_UNDER_M: Final = 0.06
"""The jaws do not go lower than this under the lowest log that they take: deeper down they clasp the logs below it.
Of 22 grasps from heaps up to 0.06 m under it 20 came up at the first closing, of 16 lower ones 6."""
FREE_PENETRATION_M: Final = 0.05
"""The same where the tips come down beside all logs: nothing stops them, and they may close around too much."""
TIP_HALF_WIDTH_M: Final = 0.08
"""Half the width of a jaw's tip, plus its position uncertainty."""
PASSED_SHARE: Final = 0.4
"""Tips that penetrate pass over the logs of the lowest row this share of their radius above their axis: lower ones
clasp them.  Over higher ones, whose heights a camera measures less well, they pass as `LAYER_RULE` says."""
LAST_RESORT_PROBABILITY: Final = 0.3
"""Success of penetrating over the topmost log where no grasp is safe."""
MAX_FLOATING_M, MAX_FLOATING_ON_WHEELS_M = 0.4, 1.5
"""A log whose middle is higher above the ground than this lies on others; on wheels, above the lowest log."""
SEED: Final = 1


class SamplingPlanner:
    """A ``GraspPlanner``.  Logs without a covariance count as well known.

    ``rules``: the capture rules, the strictest first, each with its success relative to what the samples predict.
    """

    def __init__(self, rules: Sequence[tuple[CaptureRule, float]] = RULES_WITH_TRUST) -> None:
        self._rules = rules

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        """Return the best grasp in reach; raise ``NoGrasp`` without one."""
        arm, logs = request.arm, request.logs
        if not logs:
            raise NoGrasp("grasp.no-log-in-view", "no log is in view")
        lying = _supported_logs(arm, logs)
        if not lying:
            raise NoGrasp("grasp.no-supported-log", f"none of the {_log_count(logs)} in view lies on anything")
        candidate = self._best(arm, [logs[i] for i in lying], np.isin(lying, list(request.stay)), request.rot_rad)
        return replace(candidate, logs=tuple(lying[i] for i in candidate.logs))

    def _best(self, arm: Arm, logs: Sequence[LogObservation], stays: np.ndarray, rot_rad: float) -> GraspCandidate:
        """Find the best grasp of logs that lie on something; those in ``stays`` (n,) must not be taken.

        What must lie under logs that a camera measured takes part, but a grasp of it alone is none.
        """
        log_count_text = _log_count(np.flatnonzero(~stays).tolist())
        ground = known_ground_m(arm.profile)
        jaws, world = jaws_of(arm.profile), as_cylinders(logs)
        sigma = np.stack([log_covariance(log) for log in logs])
        visible_count, is_measured = len(logs), any(log.covariance is not None for log in logs)
        if isfinite(ground):
            measured_world = world
            world, sigma = settled_poses(world, sigma, ground)
            if is_measured:
                world, sigma = with_hidden_logs(measured_world, world, sigma, ground)
                logs = [*logs, *hidden_observations(world, visible_count)]
        hidden = np.arange(world.count) >= visible_count
        stays = np.append(stays, np.zeros(world.count - visible_count, bool))
        upon = rests_upon(world)
        top, stations = reachable_stations(arm, logs, stays | hidden)
        at = candidate_grid(world, top, stations)
        sections = blade_sections(jaws, world, *at)
        floor = np.full(len(at[0]), ground) if isfinite(ground) else _ground_between_jaws(jaws, sections, upon)
        tops = np.unique(np.round(world.center[:, 2] + world.radius, 3))
        levels = np.concatenate([floor[:, None], np.broadcast_to(tops, (len(floor), len(tops)))], axis=1)
        measured = np.array([log.covariance is not None for log in logs])
        under = upon.any(axis=1) & measured
        sigma[under, RADIUS, RADIUS] = np.maximum(sigma[under, RADIUS, RADIUS], HIDDEN_RADIUS_SIGMA_M**2)
        samples = sample_cylinders(world, sigma, DRAW_COUNT, SEED)
        plans: list[tuple[CandidateArrays, GraspScores, np.ndarray]] = []
        for rule, trust in self._rules:
            best_probabilities = [float(np.max(plan[2])) for plan in plans]
            if best_probabilities and (
                best_probabilities[0] >= RELAX_BELOW_PROBABILITY or max(best_probabilities) >= trust
            ):
                break
            scores = _without_excluded(
                score_grasps(jaws, world, upon, _with_height_axis(sections), levels, rule), stays
            )
            scores = replace(scores, safe=scores.safe & np.any(scores.captured & ~hidden, axis=-1))
            if scores.safe.any():
                best, scores = finalists(at, levels, sections, scores)
                share = self._probability(jaws, samples, upon, best, scores.captured, rule, stays)
                balance_factor = 1.0 - OFF_CENTRE_PENALTY * np.maximum(1.0 - scores.balance / GOOD_LEVERAGE, 0.0)
                plans.append((best, scores, trust * balance_factor * share))
        lowest = ground if isfinite(ground) else float(np.min(world.center[:, 2] - world.radius))
        likely, topmost = max((float(np.max(plan[2])) for plan in plans), default=0.0), int(top[0])
        if is_measured and likely < TRY_ABOVE_PROBABILITY:
            extraction = extract_end_log(arm, jaws, world, upon, logs, stays | hidden, lowest, rot_rad)
            if extraction is not None:
                return extraction
        if not plans:
            if is_measured:
                return self._topmost(arm, jaws, logs, world, topmost, stations[0], lowest, rot_rad)
            raise NoGrasp(
                "grasp.none-safe",
                f"no grasp of the {log_count_text} is safe: every one closes on a log that stays, takes one from under "
                "another or takes more than the grapple holds",
            )
        trouble: list[Unreachable | NoGrasp] = []
        for best, scores, probability in sorted(plans, key=lambda plan: -float(np.max(plan[2]))):
            captured = scores.captured
            for i in _rank(probability, scores.count):
                try:
                    self._check(arm, best, int(i), logs, captured[i], rot_rad)
                except (Unreachable, NoGrasp) as error:
                    trouble.append(error)
                    continue
                proposal = self._proposal(best, int(i), captured[i], float(probability[i]), logs)
                deep_m = _penetration_m(jaws, world, proposal) if is_measured else 0.0
                visible = tuple(k for k in proposal.logs if not hidden[k])
                return replace(_penetrating(proposal, deep_m, lowest), logs=visible)
        heavy = next((error for error in trouble if isinstance(error, NoGrasp)), None)
        if heavy is None:
            raise NoGrasp("grasp.none-in-reach", f"no grasp of the {log_count_text} is in reach: {trouble[-1]}")
        if not is_measured:
            raise heavy
        return self._topmost(arm, jaws, logs, world, topmost, stations[0], lowest, rot_rad)

    def _topmost(
        self,
        arm: Arm,
        jaws: Jaws,
        logs: Sequence[LogObservation],
        world: Cylinders,
        i: int,
        stations: np.ndarray,
        lowest_m: float,
        rot: float,
    ) -> GraspCandidate:
        """Plan a penetrating grasp of log ``i`` alone, the topmost, at the reachable station nearest to its middle."""
        log = logs[i]
        along = log.length_m * float(min(ALONG_SHARES[stations], key=abs))
        x, y, _ = (c + along * a for c, a in zip(log.center_m, log.axis, strict=True))
        yaw, captured = atan2(log.axis[1], log.axis[0]) + pi / 2, np.arange(len(logs)) == i
        level = max(
            _least_level_m(jaws, world, blade_sections(jaws, world, *map(np.array, (x, y, yaw))), [i]), lowest_m
        )
        at = CandidateArrays(*(np.array([v]) for v in (x, y, yaw, level)))
        try:
            self._check(arm, at, 0, logs, captured, rot)
        except Unreachable as error:
            raise NoGrasp(
                "grasp.last-resort-out-of-reach",
                f"no grasp of the {_log_count(logs)} is safe, and log {log.id} is out of reach: {error}",
            ) from None
        reason = f"no grasp of the {_log_count(logs)} is surely safe: penetrates over log {log.id}, the topmost"
        penetrates = level > lowest_m + LOWEST_ROW_M
        return GraspCandidate(x, y, yaw, level, (i,), LAST_RESORT_PROBABILITY, reason, penetrates=penetrates)

    def _probability(
        self,
        jaws: Jaws,
        samples: Cylinders,
        upon: np.ndarray,
        best: CandidateArrays,
        captured: np.ndarray,
        rule: CaptureRule,
        stays: np.ndarray,
    ) -> np.ndarray:
        """Compute the share of the samples in which the rule holds and one of the captured logs comes up."""
        rng = np.random.default_rng(SEED + 1)
        error = rng.standard_normal((DRAW_COUNT, 4)) * (*CRANE_SIGMA_M, CRANE_SIGMA_RAD)
        world = Cylinders(
            samples.center[:, None], samples.axis[:, None], samples.length[:, None], samples.radius[:, None]
        )
        moved = [c[None, :] + error[:, k, None] for k, c in enumerate((best.x, best.y, best.level, best.yaw))]
        at = blade_sections(jaws, world, moved[0], moved[1], moved[3])
        scores = _without_excluded(score_grasps(jaws, world, upon, at, moved[2], rule), stays)
        share: np.ndarray = np.mean(scores.safe & np.any(scores.captured & captured, axis=-1), axis=0)
        return share

    def _check(
        self, arm: Arm, best: CandidateArrays, i: int, logs: Sequence[LogObservation], captured: np.ndarray, rot: float
    ) -> None:
        """Raise ``Unreachable`` where a candidate is out of reach, ``NoGrasp`` where its logs are too heavy there."""
        taken = [log for log, c in zip(logs, captured, strict=True) if c]
        x, y, yaw, level = (float(v[i]) for v in (best.x, best.y, best.yaw, best.level))
        pose = grasp_pose(arm, x, y, yaw, level, min(log.diameter_m for log in taken), rot)
        heavier = HEAVIER if len(taken) == 1 else HEAP_HEAVIER
        refuse_too_heavy(arm, pose, heavier * wood_kg(taken), "log " + " with ".join(_visible_numbers(taken)))

    def _proposal(
        self, best: CandidateArrays, i: int, captured: np.ndarray, probability: float, logs: Sequence[LogObservation]
    ) -> GraspCandidate:
        taken = tuple(int(k) for k in np.flatnonzero(captured))
        names, in_view = _visible_numbers(logs[k] for k in taken), _visible_numbers(logs)
        remaining_count, hidden_count = len(in_view) - len(names), len(taken) - len(names)
        reason = (
            f"{_log_count(names)} ({', '.join(names)}) of {len(in_view)} at once"
            + (f" with {hidden_count} that must lie under them" if hidden_count else "")
            + f", {100 * probability:.0f} % of {DRAW_COUNT} draws hold it"
            + (f"; {remaining_count} left lying" if remaining_count else "")
            + ("; nothing better is there" if probability < RELAX_BELOW_PROBABILITY else "")
        )
        return GraspCandidate(
            float(best.x[i]), float(best.y[i]), float(best.yaw[i]), float(best.level[i]), taken, probability, reason
        )


def _penetration_m(jaws: Jaws, world: Cylinders, p: GraspCandidate) -> float:
    """Compute how much lower than planned the jaws may penetrate.

    Not at all where a log between them lies across the captured ones and would come along; little where nothing stops
    them; and never so far that they would clasp the logs that they have to pass over.
    """
    at = blade_sections(jaws, world, *(np.array(v) for v in (p.x_m, p.y_m, p.yaw_rad)))
    between = at.inside & (at.low_u < jaws.half_gap_m) & (at.high_u > -jaws.half_gap_m)
    between[list(p.logs)] = False
    if np.any(between & (at.obliquity_sq > MAX_AXIS_OBLIQUITY**2)):
        return 0.0
    beneath = [
        np.any(at.inside & (at.low_u < tip + TIP_HALF_WIDTH_M) & (at.high_u > tip - TIP_HALF_WIDTH_M))
        for tip in (-jaws.half_gap_m, jaws.half_gap_m)
    ]
    deepest_m = max(p.support_z_m - _least_level_m(jaws, world, at, list(p.logs)), 0.0)
    return min(PENETRATION_M if any(beneath) else FREE_PENETRATION_M, deepest_m)


def _least_level_m(jaws: Jaws, world: Cylinders, at: BladeSections, taken: list[int]) -> float:
    """Compute the height down to which jaws may penetrate that take some logs and pass over the others between them."""
    passed = at.inside & (np.maximum(at.low_u, -at.high_u) < jaws.half_gap_m)
    passed[taken] = False
    bottom = world.center[:, 2] - world.radius
    share = np.where(bottom < np.min(bottom) + LOWEST_ROW_M, PASSED_SHARE, LAYER_RULE.pass_over_share)
    over = at.middle + share * (at.top - at.middle) + jaws.plate_m / 2 - TIP_HEIGHT_M
    return max(float(np.min(bottom[taken])) - MOST_UNDER_M, float(np.max(over[passed], initial=-np.inf)))


def _penetrating(p: GraspCandidate, deep_m: float, lowest_m: float) -> GraspCandidate:
    """Return the candidate, penetrating where its jaws come down on a pile and unchanged on the ground."""
    if deep_m == 0.0 or p.support_z_m < lowest_m + LOWEST_ROW_M:
        return p
    return replace(p, support_z_m=max(p.support_z_m - deep_m, lowest_m), penetrates=True)


def _supported_logs(arm: Arm, logs: Sequence[LogObservation]) -> list[int]:
    """Find the logs that lie on something, by index: one that floats is a false detection, or hangs in a grapple."""
    world, ground = as_cylinders(logs), known_ground_m(arm.profile)
    bottom = world.center[:, 2] - world.radius
    above = bottom - (ground if isfinite(ground) else bottom.min())
    aloft = (above > (MAX_FLOATING_M if isfinite(ground) else MAX_FLOATING_ON_WHEELS_M)) & ~rests_upon(world).any(
        axis=0
    )
    return np.flatnonzero(~aloft).tolist()


def _without_excluded(found: GraspScores, stays: np.ndarray) -> GraspScores:
    """Return the scores, where grasps that take a log of ``stays`` (n,) are not safe."""
    if not stays.any():
        return found
    return replace(found, safe=found.safe & ~np.any(found.captured & stays, axis=-1))


def _visible_numbers(logs: Iterable[LogObservation]) -> list[str]:
    return [str(log.id) for log in logs if log.id >= 0]


def _log_count(logs: Sequence[object]) -> str:
    return f"{len(logs)} log{'s' if len(logs) > 1 else ''}"


def _ground_between_jaws(jaws: Jaws, seen: BladeSections, upon: np.ndarray) -> np.ndarray:
    """Find the ground's height (c,) between the jaws of every candidate by the logs on it; -inf without any."""
    between = seen.inside & (np.minimum(np.abs(seen.low_u), np.abs(seen.high_u)) < jaws.half_gap_m)
    return np.asarray(np.max(np.where(between & ~upon.any(axis=0), seen.bottom, -np.inf), axis=-1))


def _with_height_axis(at: BladeSections) -> BladeSections:
    """Return the sections of candidates (c, n) with an axis for the heights, (c, 1, n)."""
    return BladeSections(*(getattr(at, f.name)[:, None, :] for f in fields(BladeSections)))


def _rank(probability: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Sort best first: within ``PROBABILITY_TOLERANCE`` of the best, then more logs, then in the given order."""
    safe = probability >= np.max(probability) - PROBABILITY_TOLERANCE
    return np.lexsort((-np.where(safe, count, 0), -np.where(safe, 1.0, probability)))
