"""Pieces of the foreground as lines in the picture and in depth, and what tells how good a log one of them is.

All numbers are free of scale: a judge learns from them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.flood import sigmoid, wall
from autonomy.perception.network import COS2, ENDS, OFFSET_PX, OFFSET_U, OFFSET_V, SIN2, STRIDE

LEAST_KNOWN: Final = 8  # pixels with depth that give a line
LEAST_SLOPE_PX: Final = 6.0  # of a map: shorter pieces have one depth
LEAST_TALL: Final = 2.0  # spread along over spread across, of a piece whose shape says where it points
LOOKS: Final = (
    "sure", "size", "half", "slender", "filled", "one_way", "votes_along", "votes_across", "wall_inside",
    "wall_around", "touched", "likeness", "depth_known", "depth_rough",
)  # fmt: skip
"""What ``look`` tells of one piece, in this order."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A picture's foreground: maps (8, h, w), pixels (x, y) (N,) with their probabilities ``sure`` (N,), places and
    votes (N, 2), arrows of the double angle (N, 2), the wall (h, w), the ends' chance (h, w), the foreground (h, w),
    inverse depth (h, w) [1/m], NaN unknown; ``grain`` pixels count as one."""

    x: np.ndarray
    y: np.ndarray
    sure: np.ndarray
    place: np.ndarray
    votes: np.ndarray
    double: np.ndarray
    wall: np.ndarray
    ends: np.ndarray
    foreground: np.ndarray
    inverse: np.ndarray
    grain: int


@dataclass(frozen=True, slots=True)
class Piece:
    """Pixels (n,) of a scene: middle (2,), axis (2,) by its shape where it is long enough, else as its pixels tell
    (``told``), half width, range along the axis from the middle, median vote (2,); ``line`` inverse depth at the middle
    and for each pixel along [1/m], None unknown; ``rough`` its median error over it."""

    own: np.ndarray
    middle: np.ndarray
    axis: np.ndarray
    told: np.ndarray
    half: float
    low: float
    high: float
    slender: float
    vote: np.ndarray
    line: tuple[float, float] | None
    rough: float


def scene(maps: np.ndarray, sure: np.ndarray, foreground: np.ndarray, inverse: np.ndarray | None, grain: int) -> Scene:
    """Of maps (8, h, w) whose mask's probabilities are ``sure`` (h, w)."""
    y, x = np.nonzero(foreground)
    place = np.stack([x, y], axis=1).astype(np.float32)
    votes = place + OFFSET_PX / STRIDE * maps[OFFSET_U : OFFSET_V + 1, y, x].T
    double = maps[COS2 : SIN2 + 1, y, x].T
    depth = np.full(foreground.shape, np.nan, np.float32) if inverse is None else inverse
    return Scene(x, y, sure[y, x], place, votes, double, wall(maps), sigmoid(maps[ENDS]), foreground, depth, grain)


def piece(scene: Scene, own: np.ndarray) -> Piece:
    """Of a scene's pixels ``own`` (n,)."""
    place = scene.place[own]
    middle = place.mean(axis=0)
    away = place - middle
    c, s = (scene.double[own] * scene.sure[own, None]).sum(axis=0)
    angle = 0.5 * math.atan2(float(s), float(c))
    told = np.array([math.cos(angle), math.sin(angle)])
    spread, ways = np.linalg.eigh(away.T @ away / len(own))
    axis = ways[:, 1].astype(float) if spread[1] > LEAST_TALL**2 * spread[0] else told
    along, across = away @ axis, away[:, 1] * axis[0] - away[:, 0] * axis[1]
    half = _quantile(np.abs(across - _median(across)), 0.9) + 0.5
    slender = math.sqrt(max(float(spread[1]), 0.0) / (max(float(spread[0]), 0.0) + 0.1))
    line, rough = _line(along, scene.inverse[scene.y[own], scene.x[own]])
    vote = np.array([_median(v) for v in scene.votes[own].T])
    return Piece(own, middle, axis, told, half, float(along.min()), float(along.max()), slender, vote, line, rough)


def _line(along: np.ndarray, inverse: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Inverse depth over the axis, which is straight for a straight log, and its median error."""
    known = np.isfinite(inverse)
    if np.count_nonzero(known) < LEAST_KNOWN:
        return None, 0.0
    t, s = along[known], inverse[known]
    middle = _median(s)
    if np.ptp(t) < LEAST_SLOPE_PX:
        return (middle, 0.0), _median(np.abs(s - middle)) / middle
    slope, at = _straight(t, s)
    error = np.abs(s - at - slope * t)
    usual = _median(error)
    good = error <= 2.0 * usual
    if np.ptp(t[good]) > 0.5 * np.ptp(t):
        slope, at = _straight(t[good], s[good])
    return (at, slope), usual / middle


def _median(values: np.ndarray) -> float:
    """Of values (n,), as numpy's, which takes ten times as long for the few pixels of a piece."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    pair = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return 0.5 * (float(pair[0]) + float(pair[1]))


def _quantile(values: np.ndarray, share: float) -> float:
    """Of values (n,), between neighbours as numpy's percentile."""
    at = share * (len(values) - 1)
    low = int(at)
    parted = np.partition(values, (low, min(low + 1, len(values) - 1)))
    below, above = float(parted[low]), float(parted[min(low + 1, len(values) - 1)])
    return below + (at - low) * (above - below)


def _straight(t: np.ndarray, s: np.ndarray) -> tuple[float, float]:
    """Slope and value at 0 of the straight line through s (n,) over t (n,), by least squares."""
    t0, s0 = float(t.mean()), float(s.mean())
    away = t - t0
    slope = float(away @ (s - s0)) / float(away @ away)
    return slope, s0 - slope * t0


def look(scene: Scene, one: Piece, touch_px: float, around: float, likeness: float) -> np.ndarray:
    """LOOKS (14,) of a piece that shares a border of ``touch_px`` pixels with others, where the wall has the mean
    ``around``; ``likeness`` is the greatest chance that it and another one are one log."""
    own = one.own
    length, root = one.high - one.low + 1.0, math.sqrt(scene.grain)
    stray = scene.votes[own] - one.vote
    strays = (
        _median(np.abs(stray @ one.axis)),
        _median(np.abs(stray[:, 1] * one.axis[0] - stray[:, 0] * one.axis[1])),
    )
    arrows = scene.double[own]
    told = float(np.hypot(*arrows.sum(axis=0)) / (np.hypot(*arrows.T).sum() + 1e-6))
    return np.array([
        float(scene.sure[own].mean()),
        0.3 * math.log(len(own) / scene.grain),
        0.3 * math.log(one.half / root),
        0.2 * min(one.slender, 20.0),
        min(len(own) / (2.0 * one.half * length), 2.0),
        told,
        min(4.0 * strays[0] / length, 3.0),
        min(strays[1] / one.half, 3.0),
        float(scene.wall[scene.y[own], scene.x[own]].mean()),
        around,
        min(touch_px / (2.0 * (length + 2.0 * one.half)), 1.0),
        likeness,
        float(one.line is not None),
        min(20.0 * one.rough, 3.0),
    ], np.float32)  # fmt: skip
