"""Search for the fastest collision-free path from rest to rest: over, around, or with the arm drawn in.

A path is straight, or up, over and down with legs that overlap in time.  Only one leg moves the pin sideways, so its
time law alone decides about the swing, which the vertical motion does not disturb.  The search first finds the height
at which a path with sharp corners is clear, and then tries the overlaps there, fastest first.  Each candidate is
checked with everything that moves against every obstacle (`autonomy.motion.clearance`), with a margin and with the
grapple leaning as this motion makes it swing.  Time laws come from `autonomy.motion.time_optimal`.  No clock, no
randomness.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from autonomy.motion.arm_kinematics import Arm, Pose, with_fastest_extensions
from autonomy.motion.clearance import SAMPLE_COUNT, evaluate_clearance, pin_positions
from autonomy.motion.obstacles import CollisionScene, HeldLog
from autonomy.motion.time_optimal import time_optimal_law
from autonomy.motion.trajectory import Leg, Trajectory, make_leg, superposed
from machine.geometry.kinematics import Unreachable
from machine.joints import Joint

TRIES_PER_HEIGHT: Final = 8
"""Number of overlaps checked at one height, fastest first, before the next shape."""
MAX_TRIES: Final = 64
"""Greatest number of candidates checked in all."""
MAX_RISE_M: Final = 4.0
"""Greatest height above the higher end, ..."""
HEIGHT_MARGINS_M: Final = (0.0, 0.4, 0.9)
"""... and the additions to it where no candidate is clear as it swings."""
_HEIGHT_STEP_M: Final = 0.05
REACH_FACTORS: Final = (None, 0.6, 1.25)
"""Distance from the slew axis half-way, relative to the nearer or the farther end: unchanged, drawn in, stretched
out."""
OVERLAP_SHARES: Final = (1.0, 0.7, 0.45, 0.3, 0.2, 0.08)
"""Share of the rise that may be left when the lateral leg begins, and of that when the descent begins."""
_ASSUMED_LIFT_M_S: Final = 0.7
_ASSUMED_REACH_M_S: Final = 0.9
"""Speeds of the pin by which candidates are compared before their time laws are known, ..."""
_RAMP_SHARE: Final = 0.3
"""... and the share of a leg in which it accelerates and decelerates."""
_POSE_COUNT: Final = 65
_PRUNE_SHARE: Final = 0.7
"""A candidate that is higher by this share of the missing clearance may be clear."""
_HOPELESS_M: Final = 0.2
"""A candidate that lacks more clearance than this, including room for swing, is blocked however it swings."""
_TOLERANCE: Final = 1e-6
_COARSE_COUNT: Final = 25


class PathBlocked(Unreachable):
    """No path is clear; the sentence says what blocks the best one."""


@dataclass(frozen=True, slots=True)
class ClearMotion:
    """A clear motion, its least clearance beyond what is required [m], its shape in words, and how many candidates were
    checked.
    """

    motion: Trajectory
    reserve_m: float
    name: str
    tried: int


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A path: via points, how early the lateral leg and the descent begin, its height, its shape in words."""

    via: tuple[Pose, ...]
    up_left: float
    over_left: float
    height_m: float
    shape: str


@dataclass(frozen=True, slots=True)
class _Failure:
    """A rejected candidate: the missing clearance, the reason, and whether it was on the descent."""

    candidate: _Candidate
    short_m: float
    why: str
    late: bool

    def rules_out(self, other: _Candidate) -> bool:
        """Tell whether another candidate is no farther away where this one was too near."""
        if (
            other.shape != self.candidate.shape
            or other.height_m > self.candidate.height_m + _PRUNE_SHARE * self.short_m
        ):
            return False
        if self.late:
            return other.over_left >= self.candidate.over_left
        return other.up_left >= self.candidate.up_left


def plan_path(
    arm: Arm,
    start: Pose,
    goal: Pose,
    scene: CollisionScene,
    held: HeldLog | None = None,
    least_height_m: float = -np.inf,
) -> ClearMotion:
    """Plan the fastest clear motion from rest at ``start`` to rest at ``goal``.

    ``held`` is the log in the grapple; an empty grapple is open.  The path reaches at least ``least_height_m``.

    Raises:
        PathBlocked: no path is clear.
        machine.geometry.kinematics.Unreachable: an end is out of reach.
    """
    arm.joints(np.array([start, goal]))
    planner = _PathSearch(arm, start, goal, scene, held)
    top = max(start.z_m, goal.z_m)
    line = _Candidate((start, goal), 1.0, 1.0, top, "straight")
    if least_height_m <= top and planner.may_be_clear(line) and (clear_motion := planner.clear_motion(line)):
        return clear_motion
    for reach in REACH_FACTORS:
        height = planner.least_height(max(top, least_height_m), top + MAX_RISE_M, reach)
        if height is None:
            continue
        for height_margin_m in HEIGHT_MARGINS_M:
            if planner.tried >= MAX_TRIES:
                break
            if clear_motion := planner.best(height + height_margin_m, reach):
                return clear_motion
    best = max(planner.failures, key=lambda f: -f.short_m, default=None)
    reason = best.why if best else "every path leaves the crane's reach"
    ends = f"from ({_coordinates(arm, start)}) to ({_coordinates(arm, goal)}) m"
    raise PathBlocked(f"no path is clear {ends}: {reason}", "motion.path-blocked")


def _coordinates(arm: Arm, pose: Pose) -> str:
    x, y = arm.xy(pose)
    return f"{x:.2f}, {y:.2f}, {pose.z_m:.2f}"


@dataclass(slots=True)
class _PathSearch:
    """The search for one path, with what was tried."""

    arm: Arm
    start: Pose
    goal: Pose
    scene: CollisionScene
    held: HeldLog | None
    tried: int = 0
    reserve_m: float = 0.0
    failures: list[_Failure] = field(default_factory=list)
    leg_cache: dict[tuple[float, str], tuple[list[Leg], list[dict[float, float]]]] = field(default_factory=dict)
    extension_cache: dict[tuple[Pose, ...], tuple[Pose, ...]] = field(default_factory=dict)

    def least_height(self, low_m: float, high_m: float, reach: float | None) -> float | None:
        """Find the least height, within a few cm, at which the path with sharp corners is clear; None where none is."""
        height = low_m
        while height <= high_m and self.tried < MAX_TRIES:
            sharp = self._candidate(height, reach, OVERLAP_SHARES[-1], OVERLAP_SHARES[-1])
            poses = self._poses(sharp)
            try:
                spare_m = self._evaluate(sharp, poses, self.arm.approximate_joints(poses), None)
            except Unreachable:
                return None
            if spare_m >= 0.0:
                return height
            height += _HEIGHT_STEP_M - spare_m
        return None

    def may_be_clear(self, candidate: _Candidate) -> bool:
        """Tell whether some time law may make the candidate clear."""
        poses = self._poses(candidate)
        try:
            q = self.arm.approximate_joints(poses)
        except Unreachable:
            return False
        spare_m, why, _ = evaluate_clearance(self.arm, q, pin_positions(self.arm, poses), self.scene, self.held, None)
        if spare_m > -_HOPELESS_M:
            return True
        self.tried += 1
        self.failures.append(_Failure(candidate, -spare_m, why, False))
        return False

    def clear_motion(self, candidate: _Candidate) -> ClearMotion | None:
        """Return the motion of a candidate if it is clear as it swings."""
        if any(failure.rules_out(candidate) for failure in self.failures):
            return None
        try:
            legs = self._legs(candidate)
            time_s, poses, q = self._sampled(legs)
            # Slowed down as a whole, the motion swings less than assumed here.
            spare_m = self._evaluate(candidate, poses, q, float(time_s[1]))
            return (
                ClearMotion(superposed(self.arm, legs), spare_m, candidate.shape, self.tried)
                if spare_m >= 0.0
                else None
            )
        except Unreachable:
            return None

    def best(self, height_m: float, reach: float | None) -> ClearMotion | None:
        """Find the fastest clear motion of a shape at this height."""
        candidates = [self._candidate(height_m, reach, u, o) for u in OVERLAP_SHARES for o in OVERLAP_SHARES]
        seconds = self._estimated_durations(candidates)
        tries = self.tried + TRIES_PER_HEIGHT
        for i in np.argsort(seconds, kind="stable"):
            if not np.isfinite(seconds[i]) or self.tried >= tries:
                break
            if clear_motion := self.clear_motion(candidates[i]):
                return clear_motion
        return self.clear_motion(candidates[-1])

    def _candidate(self, height: float, reach: float | None, up_left: float, over_left: float) -> _Candidate:
        start, goal = self.start, self.goal
        up, down = start.at_height(height), goal.at_height(height)
        if reach is None:
            return _Candidate(self._with_extensions((start, up, down, goal)), up_left, over_left, height, "over")
        r = reach * (min(start.r_m, goal.r_m) if reach < 1.0 else max(start.r_m, goal.r_m))
        via = self._with_extensions((start, up, up._replace(r_m=r), down._replace(r_m=r), down, goal))
        return _Candidate(via, up_left, over_left, height, "drawn in" if reach < 1.0 else "stretched out")

    def _with_extensions(self, via: tuple[Pose, ...]) -> tuple[Pose, ...]:
        if via not in self.extension_cache:
            self.extension_cache[via] = with_fastest_extensions(self.arm, via)
        return self.extension_cache[via]

    def _speeds(self) -> np.ndarray:
        slew, ext, rot = self.arm.speed[[Joint.SLEW, Joint.EXT, Joint.ROT]]
        return np.array([slew, _ASSUMED_REACH_M_S, _ASSUMED_LIFT_M_S, ext, rot])

    def _spans(self, candidate: _Candidate) -> tuple[np.ndarray, list[tuple[float, float]]]:
        """Compute the legs (k, 5), and the approximate begin and end of each, s."""
        via = np.array(candidate.via)
        legs = np.diff(via, axis=0)
        long = np.max(np.abs(legs) / self._speeds(), axis=1)
        spans, at = [], 0.0
        for i, seconds in enumerate(long):
            spans.append((at, at + seconds))
            remaining_share = (
                candidate.up_left if i == 0 else candidate.over_left if i == len(long) - 2 else OVERLAP_SHARES[-1]
            )
            at += seconds * (1.0 - remaining_share)
        if len(spans) > 2:
            # The descent begins only when the rise is done.
            begin = max(spans[-1][0], spans[0][1] if long[-1] > _TOLERANCE else 0.0)
            spans[-1] = begin, begin + float(long[-1])
        return legs, spans

    def _legs(self, candidate: _Candidate) -> list[tuple[float, Leg]]:
        """Return the legs of a candidate and when they begin; raise ``Unreachable`` for a leg out of reach."""
        key = candidate.height_m, candidate.shape
        if key not in self.leg_cache:
            legs = [
                make_leg(self.arm, a, b, lambda line: time_optimal_law(self.arm, line))
                for a, b in pairwise(candidate.via)
            ]
            early = [dict(zip(OVERLAP_SHARES, part.times_left(*OVERLAP_SHARES), strict=True)) for part in legs]
            self.leg_cache[key] = legs, early
        legs, early = self.leg_cache[key]
        if len(legs) == 1:
            return [(0.0, legs[0])]
        up, *middle, down = legs
        at = early[0][candidate.up_left]
        timed = [(0.0, up)]
        for part in middle:
            timed.append((at, part))
            at += part.duration_s
        after = timed[-1][0] + early[-2][candidate.over_left]
        timed.append((max(after, up.duration_s) if down.law else after, down))
        return timed

    def _sampled(self, legs: list[tuple[float, Leg]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sample times (n,), poses (n, 5) and joints (n, 5) of legs; raise ``Unreachable`` for a pose out of reach."""
        time_s = np.linspace(0.0, max(max(at + part.duration_s for at, part in legs), _TOLERANCE), SAMPLE_COUNT)
        poses = np.array(self.start) + sum(part.progress_at(time_s - at)[:, None] * part.delta for at, part in legs)
        return time_s, poses, self.arm.approximate_joints(poses)

    def _estimated_durations(self, candidates: list[_Candidate]) -> np.ndarray:
        """Estimate durations (n,) of candidates of the same legs, longer where the legs together exceed the limits;
        infinite where they are out of reach.
        """
        try:
            timed = [self._legs(candidate) for candidate in candidates]
            end_s = np.array([max(max(at + part.duration_s for at, part in legs), _TOLERANCE) for legs in timed])
            time_s = np.linspace(0.0, end_s, _COARSE_COUNT, axis=1)
            poses = np.array(self.start) + sum(
                part.progress_at(time_s - np.array([[legs[k][0]] for legs in timed]))[..., None] * part.delta
                for k, (_, part) in enumerate(timed[0])
            )
            q, outside = self.arm.straight_column_joints(poses.reshape(-1, 5))
        except Unreachable:
            return np.full(len(candidates), np.inf)
        q = q.reshape(len(candidates), _COARSE_COUNT, 5)
        speed = np.diff(q, axis=1) / time_s[:, 1, None, None]
        middle = 0.5 * (q[:, 1:] + q[:, :-1])
        flow = self.arm.pump_load(middle.reshape(-1, 5), speed.reshape(-1, 5)).reshape(len(candidates), -1)
        load = np.maximum(np.max(flow, axis=1), np.max(np.abs(speed) / self.arm.speed, axis=(1, 2)))
        reached = ~np.any(outside.reshape(len(candidates), -1), axis=1)
        return np.where(reached, end_s * np.maximum(load, 1.0), np.inf)

    def _poses(self, candidate: _Candidate) -> np.ndarray:
        """Sample poses (n, 5) evenly along a candidate."""
        legs, spans = self._spans(candidate)
        time_s = np.linspace(0.0, max(max(end for _, end in spans), _TOLERANCE), 2 * _POSE_COUNT)
        line = np.array(self.start) + np.zeros((len(time_s), 1))
        for step, (begin, end) in zip(legs, spans, strict=True):
            if end - begin > _TOLERANCE:
                line = line + _ramp((time_s - begin) / (end - begin))[:, None] * step
        along = np.cumsum(
            np.append(0.0, np.linalg.norm(np.diff(line, axis=0) / self._speeds(), axis=1) + _TOLERANCE**2)
        )
        even = np.linspace(0.0, along[-1], _POSE_COUNT)
        return np.column_stack([np.interp(even, along, column) for column in line.T])

    def _evaluate(self, candidate: _Candidate, poses: np.ndarray, q: np.ndarray, step_s: float | None) -> float:
        self.tried += 1
        spare_m, why, at = evaluate_clearance(
            self.arm, q, pin_positions(self.arm, poses), self.scene, self.held, step_s
        )
        if spare_m < 0.0:
            self.failures.append(_Failure(candidate, -spare_m, why, _is_on_descent(poses, at)))
        return spare_m


def _is_on_descent(poses: np.ndarray, at: int) -> bool:
    """Tell whether the descent decides about the clearance at a sample: it has begun, or its end is nearer."""
    top = int(np.argmax(poses[:, 2]))
    if poses[at, 2] < poses[top, 2] - _HEIGHT_STEP_M:
        return at > top
    from_start, to_end = (np.hypot(*(poses[at, :2] - poses[i, :2])) for i in (0, -1))
    return bool(from_start > to_end)


def _ramp(tau: np.ndarray) -> np.ndarray:
    """Rise from 0 to 1 with a constant slope in the middle and smooth ends."""
    t = np.clip(tau, 0.0, 1.0)
    full = 1.0 / (1.0 - _RAMP_SHARE)
    soft = 0.5 * full / _RAMP_SHARE
    middle = full * (t - 0.5 * _RAMP_SHARE)
    result: np.ndarray = np.where(
        t < _RAMP_SHARE, soft * t**2, np.where(t > 1.0 - _RAMP_SHARE, 1.0 - soft * (1.0 - t) ** 2, middle)
    )
    return result
