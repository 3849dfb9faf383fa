"""Pieces of the foreground as lines in the picture and in depth, and what two of them have to do with each other.

A log that another one crosses is several pieces: they lie on one line, in the picture and in depth, vote for one
middle, and what lies between them lies before them.  All numbers are free of scale: a judge learns from them.
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
NEARER: Final = 1.03  # inverse depth of what hides a log, over the log's own
GAP_PX: Final = 3.0
GAP_LOOKS: Final = 12
BESIDE, LEAN = 3.0, 0.1  # pieces further beside a line than so many half widths, and share of how far along, are apart
LEAST_SEEN: Final = 0.6  # of a gap, that parts
LEAST_END: Final = 0.5
LEAST_TALL: Final = 2.0  # spread along over spread across, of a piece whose shape says where it points
RELATIONS: Final = (
    "touch", "wall", "touching", "turn", "turn_told", "beside", "beside_back", "votes_along", "votes_across", "gap",
    "gap_ground", "depth_apart", "depth_known", "width_ratio", "size", "slender_big", "slender_small", "gap_widths",
    "beside_lean",
)  # fmt: skip
"""What ``relation`` tells of two pieces, in this order."""
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
    half = float(np.percentile(np.abs(across - np.median(across)), 90)) + 0.5
    slender = math.sqrt(max(float(spread[1]), 0.0) / (max(float(spread[0]), 0.0) + 0.1))
    line, rough = _line(along, scene.inverse[scene.y[own], scene.x[own]])
    vote = np.median(scene.votes[own], axis=0)
    return Piece(own, middle, axis, told, half, float(along.min()), float(along.max()), slender, vote, line, rough)


def _line(along: np.ndarray, inverse: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Inverse depth over the axis, which is straight for a straight log, and its median error."""
    known = np.isfinite(inverse)
    if np.count_nonzero(known) < LEAST_KNOWN:
        return None, 0.0
    t, s = along[known], inverse[known]
    middle = float(np.median(s))
    if np.ptp(t) < LEAST_SLOPE_PX:
        return (middle, 0.0), float(np.median(np.abs(s - middle))) / middle
    slope, at = np.polyfit(t, s, 1)
    error = np.abs(s - at - slope * t)
    good = error <= 2.0 * np.median(error)
    if np.ptp(t[good]) > 0.5 * np.ptp(t):
        slope, at = np.polyfit(t[good], s[good], 1)
    return (float(at), float(slope)), float(np.median(error)) / middle


def relation(scene: Scene, big: Piece, small: Piece, touch_px: float, between: float) -> np.ndarray:
    """RELATIONS (19,) of two pieces that share a border of ``touch_px`` pixels of the maps, where the wall has the mean
    ``between``."""
    axis, away = big.axis, small.middle - big.middle
    along, beside = float(away @ axis), abs(_cross(axis, away))
    near, far = along + small.low, along + small.high
    span = max(big.high, far) - min(big.low, near)
    apart = small.vote - big.vote
    start, end = _between(big, small, along)
    gap = max(0.0, end - start)
    thin = max(small.half, 1.0)
    return np.array([
        min(touch_px / (2.0 * min(small.half, big.half)), 3.0),
        between,
        float(touch_px > 0.0),
        abs(_cross(small.axis, axis)) * min(small.slender, 4.0) / 4.0,
        abs(_cross(small.told, big.told)),
        min(beside / big.half, 4.0),
        min(abs(_cross(small.axis, away)) / thin, 6.0),
        min(abs(float(apart @ axis)) / span, 1.5),
        min(abs(_cross(axis, apart)) / (big.half + small.half), 3.0),
        min(gap / span, 1.0),
        _ground(scene, big, start, end) if gap > GAP_PX else 0.0,
        min(10.0 * _depth_apart(big, small, along), 5.0),
        float(big.line is not None and small.line is not None),
        abs(math.log(small.half / big.half)),
        0.3 * math.log(len(small.own) / scene.grain),
        0.2 * min(big.slender, 20.0),
        0.2 * min(small.slender, 20.0),
        0.2 * min(gap / (2.0 * max(big.half, 1.0)), 10.0),
        min(beside / (big.half + 0.05 * abs(along)), 5.0),
    ], np.float32)  # fmt: skip


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _depth_apart(big: Piece, small: Piece, along: float) -> float:
    """By which share of its inverse depth one piece misses the other one's line, where that is straight enough."""
    if big.line is None or small.line is None:
        return 0.0
    miss = abs(big.line[0] + big.line[1] * along - small.line[0]) / max(small.line[0], 1e-3)
    if small.slender > 3.0:
        turned = 1.0 if float(big.axis @ small.axis) > 0.0 else -1.0
        back = small.line[0] - turned * small.line[1] * along
        miss = min(miss, abs(back - big.line[0]) / max(big.line[0], 1e-3))
    return miss


def _ground(scene: Scene, big: Piece, start: float, end: float) -> float:
    """Share of the gap between two pieces, on the big one's axis, where one sees past them: no log, nothing nearer."""
    hidden, inverse, line = _gap(scene, big, start, end)
    return 1.0 - float((hidden | (inverse > NEARER * line)).mean())


def may_be_one(scene: Scene, big: Piece, small: Piece, touch_px: float) -> bool:
    """Whether a judge need be asked: two pieces touch or lie near one line, and nothing parts them there: one neither
    looks past them at what is clearly farther nor sees an end."""
    away = small.middle - big.middle
    along, beside = float(away @ big.axis), abs(_cross(big.axis, away))
    if touch_px == 0.0 and beside > BESIDE * big.half + LEAN * abs(along):
        return False
    start, end = _between(big, small, along)
    if abs(along) <= 0.5 * (big.high - big.low) or beside > big.half:
        return True
    column, row = np.rint(big.middle + 0.5 * (start + end) * big.axis).astype(int)
    reach = max(1, round(0.5 * small.half))
    here = scene.ends[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
    if here.size and float(here.max()) > LEAST_END and end - start < small.half:
        return False
    if end - start <= GAP_PX:
        return True
    hidden, inverse, line = _gap(scene, big, start, end)
    return float((~hidden & (inverse < line / NEARER)).mean()) <= LEAST_SEEN


def _between(big: Piece, small: Piece, along: float) -> tuple[float, float]:
    """Where the gap between two pieces begins and ends on the big one's axis; they overlap where it ends first."""
    return (big.high, along + small.low) if along > 0.0 else (along + small.high, big.low)


def _gap(scene: Scene, big: Piece, start: float, end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Along a gap (GAP_LOOKS,): foreground, inverse depth, and that of the big piece's line, NaN unknown."""
    at = np.linspace(start, end, GAP_LOOKS + 2)[1:-1]
    column, row = np.rint(big.middle + at[:, None] * big.axis).astype(int).T
    row = np.clip(row, 0, scene.foreground.shape[0] - 1)
    column = np.clip(column, 0, scene.foreground.shape[1] - 1)
    line = np.full(GAP_LOOKS, np.nan) if big.line is None else big.line[0] + big.line[1] * at
    return scene.foreground[row, column], scene.inverse[row, column], line


def look(scene: Scene, one: Piece, touch_px: float, around: float, likeness: float) -> np.ndarray:
    """LOOKS (14,) of a piece that shares a border of ``touch_px`` pixels with others, where the wall has the mean
    ``around``; ``likeness`` is the greatest chance that it and another one are one log."""
    own = one.own
    length, root = one.high - one.low + 1.0, math.sqrt(scene.grain)
    stray = scene.votes[own] - one.vote
    strays = (
        float(np.median(np.abs(stray @ one.axis))),
        float(np.median(np.abs(stray[:, 1] * one.axis[0] - stray[:, 0] * one.axis[1]))),
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
