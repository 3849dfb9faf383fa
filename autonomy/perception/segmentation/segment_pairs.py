"""What pieces of the foreground have to do with each other, for many pairs at once.

A log that another one crosses is several pieces: they lie on one line, in the picture and in depth, vote for one
middle, and what lies between them lies before them.  All numbers are free of scale: a judge learns from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.segmentation.segments import Foreground, Segment

NEARER: Final = 1.03  # inverse depth of what hides a log, over the log's own
GAP_PX: Final = 3.0
GAP_LOOKS: Final = 12
LOOK_AT: Final = np.arange(1, GAP_LOOKS + 1) / (GAP_LOOKS + 1.0)  # shares of a gap
BESIDE, LEAN = 3.0, 0.1  # pieces further beside a line than so many half widths, and share of how far along, are apart
UNKNOWN: Final = (np.nan, np.nan)
LEAST_SEEN: Final = 0.6  # of a gap, that parts
LEAST_END: Final = 0.5
SLENDER: Final = 3.0  # a piece so many times longer than wide says itself how its depth goes on
PAIR_FEATURES: Final = (
    "touch", "wall", "touching", "turn", "turn_told", "beside", "beside_back", "votes_along", "votes_across", "gap",
    "gap_ground", "depth_apart", "depth_known", "width_ratio", "size", "slender_big", "slender_small", "gap_widths",
    "beside_lean",
)  # fmt: skip
"""What ``relations`` tells of two pieces, in this order."""


def _columns(first: int, last: int | None = None) -> property:
    return property(lambda row: row.numbers[:, first] if last is None else row.numbers[:, first:last])


@dataclass(frozen=True, slots=True)
class SegmentTable:
    """Pieces as ``numbers`` (n, 15), one array because many at a time are taken from it; the columns as the fields of
    ``Segment``, ``count`` of pixels, and the line of inverse depth as its value at the middle and its slope, NaN unknown.
    """

    numbers: np.ndarray

    count = _columns(0)
    middle = _columns(1, 3)
    axis = _columns(3, 5)
    told = _columns(5, 7)
    half = _columns(7)
    low = _columns(8)
    high = _columns(9)
    slender = _columns(10)
    vote = _columns(11, 13)
    line_at = _columns(13)
    line_slope = _columns(14)

    @classmethod
    def of(cls, pieces: Sequence[Segment]) -> SegmentTable:
        """Of a list."""
        rows = [
            (len(p.own), *p.middle, *p.axis, *p.told, p.half, p.low, p.high, p.slender, *p.vote, *(p.line or UNKNOWN))
            for p in pieces
        ]
        return cls(np.array(rows, float).reshape(-1, 15))

    def put(self, place: int, piece: Segment) -> None:
        """Write a piece over the one at a place."""
        self.numbers[place] = SegmentTable.of([piece]).numbers[0]

    def take(self, which: np.ndarray) -> SegmentTable:
        """Those of these places."""
        return SegmentTable(self.numbers[which])


def relations(scene: Foreground, big: SegmentTable, small: SegmentTable, touch_px: np.ndarray, between: np.ndarray) -> np.ndarray:
    """RELATIONS (n, 19) of n pairs of pieces that share borders of ``touch_px`` (n,) pixels of the maps, where the wall
    has the mean ``between`` (n,).
    """
    axis, away = big.axis, small.middle - big.middle
    along, beside = _dot(away, axis), np.abs(_cross(axis, away))
    span = np.maximum(big.high, along + small.high) - np.minimum(big.low, along + small.low)
    apart = small.vote - big.vote
    start, end = _between(big, small, along)
    gap, thin = np.maximum(0.0, end - start), np.maximum(small.half, 1.0)
    ground, parted = np.zeros(len(gap)), gap > GAP_PX
    hidden, inverse, line = _gap(scene, big.take(parted), start[parted], end[parted])
    ground[parted] = 1.0 - (hidden | (inverse > NEARER * line)).sum(axis=1) / GAP_LOOKS
    return np.stack([
        np.minimum(touch_px / (2.0 * np.minimum(small.half, big.half)), 3.0),
        between,
        touch_px > 0.0,
        np.abs(_cross(small.axis, axis)) * np.minimum(small.slender, 4.0) / 4.0,
        np.abs(_cross(small.told, big.told)),
        np.minimum(beside / big.half, 4.0),
        np.minimum(np.abs(_cross(small.axis, away)) / thin, 6.0),
        np.minimum(np.abs(_dot(apart, axis)) / span, 1.5),
        np.minimum(np.abs(_cross(axis, apart)) / (big.half + small.half), 3.0),
        np.minimum(gap / span, 1.0),
        ground,
        np.minimum(10.0 * _depth_apart(big, small, along), 5.0),
        ~np.isnan(big.line_at + small.line_at),
        np.abs(np.log(small.half / big.half)),
        0.3 * np.log(small.count / scene.grain),
        0.2 * np.minimum(big.slender, 20.0),
        0.2 * np.minimum(small.slender, 20.0),
        0.2 * np.minimum(gap / (2.0 * np.maximum(big.half, 1.0)), 10.0),
        np.minimum(beside / (big.half + 0.05 * np.abs(along)), 5.0),
    ], axis=1).astype(np.float32)  # fmt: skip


def may_merge(scene: Foreground, big: SegmentTable, small: SegmentTable, touch_px: np.ndarray) -> np.ndarray:
    """Whether (n,) a judge need be asked: two pieces touch or lie near one line, and nothing parts them there: one
    neither looks past them at what is clearly farther nor sees an end.
    """
    away = small.middle - big.middle
    along, beside = _dot(away, big.axis), np.abs(_cross(big.axis, away))
    may = (touch_px > 0.0) | (beside <= BESIDE * big.half + LEAN * np.abs(along))
    start, end = _between(big, small, along)
    ask = np.flatnonzero(may & (np.abs(along) > 0.5 * (big.high - big.low)) & (beside <= big.half))
    middles = np.rint(big.middle + 0.5 * (start + end)[:, None] * big.axis).astype(int)
    for k in ask:
        (column, row), reach = middles[k], max(1, round(0.5 * float(small.half[k])))
        here = scene.ends[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        may[k] = not (here.size and float(here.max()) > LEAST_END and end[k] - start[k] < small.half[k])
    ask = ask[may[ask] & (end - start > GAP_PX)[ask]]
    hidden, inverse, line = _gap(scene, big.take(ask), start[ask], end[ask])
    may[ask] = (~hidden & (inverse < line / NEARER)).sum(axis=1) <= LEAST_SEEN * GAP_LOOKS
    return may


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _depth_apart(big: SegmentTable, small: SegmentTable, along: np.ndarray) -> np.ndarray:
    """By which share (n,) of its inverse depth one piece misses the other one's line, where that is straight enough; 0
    where one has none.
    """
    miss = np.abs(big.line_at + big.line_slope * along - small.line_at) / np.maximum(small.line_at, 1e-3)
    turned = np.where(_dot(big.axis, small.axis) > 0.0, 1.0, -1.0)
    back = np.abs(small.line_at - turned * small.line_slope * along - big.line_at) / np.maximum(big.line_at, 1e-3)
    apart = np.where(small.slender > SLENDER, np.minimum(miss, back), miss)
    return np.where(np.isnan(apart), 0.0, apart)


def _between(big: SegmentTable, small: SegmentTable, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the gap between two pieces begins and ends on the big one's axis; they overlap where it ends first."""
    after = along > 0.0
    return np.where(after, big.high, along + small.high), np.where(after, along + small.low, big.low)


def _gap(scene: Foreground, big: SegmentTable, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Along gaps (n, GAP_LOOKS): foreground, inverse depth, and that of the big piece's line, NaN unknown."""
    at = start[:, None] + (end - start)[:, None] * LOOK_AT
    place = np.rint(big.middle[:, None] + at[..., None] * big.axis[:, None]).astype(int)
    row = np.clip(place[..., 1], 0, scene.foreground.shape[0] - 1)
    column = np.clip(place[..., 0], 0, scene.foreground.shape[1] - 1)
    line = big.line_at[:, None] + big.line_slope[:, None] * at
    return scene.foreground[row, column], scene.inverse[row, column], line
