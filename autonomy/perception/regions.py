"""Regions: the foreground parted along the edges between logs, and what is one log's put together again.

An edge is seen from near by, so a small network draws it where it cannot tell how far away the middle of a log is.  The
map of edges is flooded from its valleys; a valley that is deep enough before it meets another is a region.  A log that
another one crosses is several regions: they lie on one line, vote for one centre, and there is no ground between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.perception.network import COS2, EDGE, OFFSET_PX, OFFSET_U, OFFSET_V, SIN2, STRIDE

LEAST_PX: Final = 6  # of a map: what is smaller is no log
SURE_PX: Final = 12.0  # scores of smaller regions are lowered
LEVELS: Final = (*np.arange(0.05, 1.0, 0.05), 1.1)
DEPTH: Final = 0.18  # of a valley that is a region
LEAST_CORE: Final = 3  # pixels of a valley
SIDE, STRAY = 0.6, 0.05
"""How far a region's middle may lie beside another one's axis: share of its half width, and of how far along it is."""
ALIKE: Final = 0.3  # votes of one log differ by less, in its length
TURN_LONG, TURN_SHORT = 0.18, 0.4  # sine of the angle between regions of one log
GAP_PX: Final = 3.0
GROUND_SHARE: Final = 0.3  # of a gap between regions of one log that may be ground


@dataclass(frozen=True, slots=True)
class Region:
    """Pixels (N,) of the maps' foreground that are one log: its axis (2,) and score."""

    own: np.ndarray
    axis: np.ndarray
    score: float


@dataclass(frozen=True, slots=True)
class _Line:
    """A region's middle (2,), axis (2,), half width, range along the axis from the middle [pixels of the maps], and how
    many times longer than wide it is."""

    middle: np.ndarray
    axis: np.ndarray
    half: float
    low: float
    high: float
    slender: float


def parted(maps: np.ndarray, x: np.ndarray, y: np.ndarray, sure: np.ndarray, grain: int = 1) -> list[Region]:
    """The foreground's pixels (x, y) (N,), with their probabilities ``sure`` (N,), as logs, the largest first;
    ``grain`` pixels count as one."""
    foreground = np.zeros(maps.shape[1:], bool)
    foreground[y, x] = True
    labels = flooded(sigmoid(maps[EDGE]), foreground)[y, x]
    place = np.stack([x, y], axis=1).astype(np.float32)
    votes = place + OFFSET_PX / STRIDE * maps[OFFSET_U : OFFSET_V + 1, y, x].T
    double = maps[COS2 : SIN2 + 1, y, x].T
    order = np.argsort(labels, kind="stable")
    cuts = np.searchsorted(labels[order], np.arange(1, labels.max(initial=0) + 2))
    parts = [order[a:b] for a, b in pairwise(cuts) if b - a >= LEAST_PX * grain]
    return _joined([_region(own, double, sure, grain) for own in parts], place, votes, double, sure, foreground, grain)


def flooded(wall: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    """Labels (h, w) int32, 0 outside ``foreground``, of the valleys of ``wall`` (h, w), 0..1.

    The water rises in LEVELS.  A pool without a label is a new valley; where pools with labels meet, those less than
    DEPTH deep are forgotten, and from there on nothing is labelled.  What is left goes to the nearest label that is in
    its patch of foreground.
    """
    labels = np.zeros(wall.shape, np.int32)
    birth = [0.0]
    for level in LEVELS:
        pools, count = ndimage.label(foreground & (wall < level))
        taken = labels > 0
        pairs = np.unique(pools[taken].astype(np.int64) * len(birth) + labels[taken])
        pool, label = pairs // len(birth), pairs % len(birth)
        many, size = (np.bincount(of, minlength=count + 1) for of in (pool, pools.ravel()))
        into = np.zeros(count + 1, np.int32)  # what a pool's pixels are labelled
        new = 1 + np.flatnonzero((many[1:] == 0) & (size[1:] >= LEAST_CORE))
        into[new] = len(birth) + np.arange(len(new))
        alone = many[pool] == 1
        into[pool[alone]] = label[alone]
        shallow: list[int] = []
        for meeting in np.flatnonzero(many > 1):
            here = sorted(label[pool == meeting].tolist(), key=lambda i: birth[i])
            low = [i for i in here[1:] if level - birth[i] < DEPTH]
            shallow += low
            if len(low) == len(here) - 1:
                into[meeting] = here[0]
        labels[np.isin(labels, shallow)] = 0
        birth += [float(level)] * len(new)
        fill = (labels == 0) & (pools > 0)
        labels[fill] = into[pools[fill]]
    if labels.any():
        nearest = tuple(ndimage.distance_transform_edt(labels == 0, return_distances=False, return_indices=True))
        patch, _ = ndimage.label(foreground, np.ones((3, 3)))
        rest = foreground & (labels == 0) & (patch[nearest] == patch)  # what is far from any valley is no log's
        labels[rest] = labels[nearest][rest]
    return labels


def _region(own: np.ndarray, double: np.ndarray, sure: np.ndarray, grain: int) -> Region:
    c, s = (double[own] * sure[own, None]).sum(axis=0)
    angle = 0.5 * math.atan2(float(s), float(c))
    size = 1.0 - math.exp(-len(own) / (SURE_PX * grain))
    return Region(own, np.array([math.cos(angle), math.sin(angle)], np.float32), float(sure[own].mean()) * size)


def _joined(
    regions: list[Region],
    place: np.ndarray,
    votes: np.ndarray,
    double: np.ndarray,
    sure: np.ndarray,
    foreground: np.ndarray,
    grain: int,
) -> list[Region]:
    """Regions of one log made one, until no two are."""
    while True:
        kept: list[Region] = []
        lines: list[_Line] = []
        for region in sorted(regions, key=lambda r: -len(r.own)):
            line = _line(region, place)
            for i, other in enumerate(kept):
                apart = np.median(votes[region.own], axis=0) - np.median(votes[other.own], axis=0)
                if _one_log(line, lines[i], apart, foreground):
                    kept[i] = _region(np.concatenate([other.own, region.own]), double, sure, grain)
                    lines[i] = _line(kept[i], place)
                    break
            else:
                kept.append(region)
                lines.append(line)
        if len(kept) == len(regions):
            return kept
        regions = kept


def _line(region: Region, place: np.ndarray) -> _Line:
    """By the spread of the pixels where they are long enough for it, else by their angles."""
    own = place[region.own]
    middle = own.mean(axis=0)
    away = own - middle
    spread, ways = np.linalg.eigh(away.T @ away / len(own))
    axis = ways[:, 1] if spread[1] > 4.0 * spread[0] else region.axis
    along, across = away @ axis, away[:, 1] * axis[0] - away[:, 0] * axis[1]
    half = float(np.percentile(np.abs(across - np.median(across)), 90)) + 0.5
    slender = math.sqrt(max(float(spread[1]), 0.0) / (max(float(spread[0]), 0.0) + 0.1))
    return _Line(middle, axis, half, float(along.min()), float(along.max()), slender)


def _one_log(small: _Line, big: _Line, apart: np.ndarray, foreground: np.ndarray) -> bool:
    """Whether two regions, whose votes differ by ``apart`` (2,), lie on one line, vote alike, and touch or have
    something before the ground between them."""
    axis, away = big.axis, small.middle - big.middle
    along, across = float(away @ axis), abs(float(away[1] * axis[0] - away[0] * axis[1]))
    if across > SIDE * big.half + STRAY * abs(along) or small.half > 1.5 * big.half + 1.0:
        return False
    turn = abs(float(small.axis[0] * axis[1] - small.axis[1] * axis[0]))
    if turn > (TURN_LONG if small.slender > 3.0 else TURN_SHORT):
        return False
    near, far = along + small.low, along + small.high
    if abs(float(apart @ axis)) > ALIKE * (max(big.high, far) - min(big.low, near)) + 1.0:
        return False
    start, end = (big.high, near) if along > 0.0 else (far, big.low)
    if end - start < GAP_PX:
        return True
    column, row = np.rint(big.middle + np.linspace(start, end, 12)[1:-1, None] * axis).astype(int).T
    row, column = np.clip(row, 0, foreground.shape[0] - 1), np.clip(column, 0, foreground.shape[1] - 1)
    return float(foreground[row, column].mean()) > 1.0 - GROUND_SHARE


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x))."""
    return 1.0 / (1.0 + np.exp(-x))
