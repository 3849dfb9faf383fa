"""Pieces of the foreground as lines in the picture and in depth, and what tells how good a log one of them is.

All numbers are free of scale: a judge learns from them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.segmentation.network import COS2, ENDS, OFFSET_PX, OFFSET_U, OFFSET_V, SIN2, STRIDE
from autonomy.perception.segmentation.watershed import sigmoid, wall

LEAST_KNOWN: Final = 8  # pixels with depth that give a line
LEAST_SLOPE_PX: Final = 6.0  # of a map: shorter pieces have one depth
LEAST_TALL: Final = 2.0  # spread along over spread across, of a piece whose shape says where it points
SEGMENT_FEATURES: Final = (
    "sure", "size", "half", "slender", "filled", "one_way", "votes_along", "votes_across", "wall_inside",
    "wall_around", "touched", "likeness", "depth_known", "depth_rough",
)  # fmt: skip
"""What ``look`` tells of one piece, in this order."""


@dataclass(frozen=True, slots=True)
class Foreground:
    """A picture's foreground: its pixels (x, y) (N,) and what is told of them, ``pixels`` (7, N): x, y, probability,
    arrow of the double angle (2), vote (2); the wall (h, w), the ends' chance (h, w), the foreground (h, w), inverse
    depth (h, w) [1/m], NaN unknown; ``grain`` pixels count as one."""

    x: np.ndarray
    y: np.ndarray
    pixels: np.ndarray
    wall: np.ndarray
    ends: np.ndarray
    foreground: np.ndarray
    inverse: np.ndarray
    grain: int


@dataclass(frozen=True, slots=True)
class Segment:
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


def scene(maps: np.ndarray, sure: np.ndarray, foreground: np.ndarray, inverse: np.ndarray | None, grain: int) -> Foreground:
    """Of maps (8, h, w) whose mask's probabilities are ``sure`` (h, w)."""
    y, x = np.nonzero(foreground)
    votes = OFFSET_PX / STRIDE * maps[OFFSET_U : OFFSET_V + 1, y, x]
    pixels = np.stack([x, y, sure[y, x], *maps[COS2 : SIN2 + 1, y, x], x + votes[0], y + votes[1]]).astype(np.float32)
    depth = np.full(foreground.shape, np.nan, np.float32) if inverse is None else inverse
    return Foreground(x, y, pixels, wall(maps), sigmoid(maps[ENDS]), foreground, depth, grain)


def piece(scene: Foreground, own: np.ndarray) -> Segment:
    """Of a scene's pixels ``own`` (n,)."""
    x, y, sure, c, s, *votes = scene.pixels.take(own, axis=1)
    n = len(own)
    angle = 0.5 * math.atan2(float(s @ sure), float(c @ sure))
    axis = told = np.array([math.cos(angle), math.sin(angle)])
    middle = np.array([float(x.sum()) / n, float(y.sum()) / n])
    x, y = x - np.float32(middle[0]), y - np.float32(middle[1])
    xx, xy, yy = float(x @ x) / n, float(x @ y) / n, float(y @ y) / n
    mean, differ = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    thin, tall = max(mean - differ, 0.0), mean + differ
    if tall > LEAST_TALL**2 * thin:
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        axis = np.array([math.cos(angle), math.sin(angle)])
    to_east, to_south = np.float32(axis)
    along, across = to_east * x + to_south * y, to_east * y - to_south * x
    half = _quantile(np.abs(across - np.float32(_median(across))), 0.9) + 0.5
    line, rough = _line(along, scene.inverse[scene.y[own], scene.x[own]])
    low, high = float(along.min()), float(along.max())
    vote = np.array([_median(v) for v in votes])
    return Segment(own, middle, axis, told, half, low, high, math.sqrt(tall / (thin + 0.1)), vote, line, rough)


def _line(along: np.ndarray, inverse: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Inverse depth over the axis, which is straight for a straight log, and its median error."""
    known = np.isfinite(inverse)
    if np.count_nonzero(known) < LEAST_KNOWN:
        return None, 0.0
    t, s = along[known], inverse[known]
    middle = _median(s)
    reach = _reach(t)
    if reach < LEAST_SLOPE_PX:
        return (middle, 0.0), _median(np.abs(s - np.float32(middle))) / middle
    slope, at = _straight(t, s)
    error = np.abs(s - np.float32(at) - np.float32(slope) * t)
    usual = _median(error)
    good = error <= 2.0 * usual
    if _reach(t[good]) > 0.5 * reach:
        slope, at = _straight(t[good], s[good])
    return (at, slope), usual / middle


def _reach(values: np.ndarray) -> float:
    return float(values.max()) - float(values.min())


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
    t0, s0 = float(t.sum()) / len(t), float(s.sum()) / len(s)
    away = t - np.float32(t0)
    slope = float(away @ (s - np.float32(s0))) / float(away @ away)
    return slope, s0 - slope * t0


def look(scene: Foreground, one: Segment, touch_px: float, around: float, likeness: float) -> np.ndarray:
    """LOOKS (14,) of a piece that shares a border of ``touch_px`` pixels with others, where the wall has the mean
    ``around``; ``likeness`` is the greatest chance that it and another one are one log."""
    own = one.own
    length, root = one.high - one.low + 1.0, math.sqrt(scene.grain)
    _, _, sure, c, s, *votes = scene.pixels.take(own, axis=1)
    east, south = votes[0] - np.float32(one.vote[0]), votes[1] - np.float32(one.vote[1])
    to_east, to_south = np.float32(one.axis)
    strays = _median(np.abs(to_east * east + to_south * south)), _median(np.abs(to_east * south - to_south * east))
    told = math.hypot(float(c.sum()), float(s.sum())) / (float(np.hypot(c, s).sum()) + 1e-6)
    return np.array([
        float(sure.sum()) / len(own),
        0.3 * math.log(len(own) / scene.grain),
        0.3 * math.log(one.half / root),
        0.2 * min(one.slender, 20.0),
        min(len(own) / (2.0 * one.half * length), 2.0),
        told,
        min(4.0 * strays[0] / length, 3.0),
        min(strays[1] / one.half, 3.0),
        float(scene.wall[scene.y[own], scene.x[own]].sum()) / len(own),
        around,
        min(touch_px / (2.0 * (length + 2.0 * one.half)), 1.0),
        likeness,
        float(one.line is not None),
        min(20.0 * one.rough, 3.0),
    ], np.float32)  # fmt: skip
