"""Features of pairs of segments, for many pairs at once, and a fast test which pairs may be one log.

A log that another one crosses is several segments.  They lie on one line in the picture and in depth, vote for one
centre, and what lies between them is nearer.  All features are independent of scale, because a network learns from
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.segmentation.segments import Foreground, Segment

NEARER: Final = 1.03  # inverse depth of what hides a log, over the log's own
MIN_GAP_PX: Final = 3.0
GAP_SAMPLES: Final = 12
GAP_SHARES: Final = np.arange(1, GAP_SAMPLES + 1) / (GAP_SAMPLES + 1.0)
MAX_OFFSET_WIDTHS, MAX_OFFSET_SHARE = 3.0, 0.1
"""Largest offset of a segment from the other's axis: half widths, plus a share of the distance along the axis."""
UNKNOWN: Final = (np.nan, np.nan)
MIN_BACKGROUND_SHARE: Final = 0.6  # of a gap that separates two logs
MIN_END_PROBABILITY: Final = 0.5
MIN_ELONGATION: Final = 3.0  # from which on a segment's own slope of depth is used
PAIR_FEATURES: Final = (
    "border",
    "boundary",
    "touching",
    "turn",
    "predicted_turn",
    "offset",
    "offset_back",
    "votes_along",
    "votes_across",
    "gap",
    "gap_background",
    "depth_difference",
    "depth_known",
    "width_ratio",
    "size",
    "elongation_big",
    "elongation_small",
    "gap_widths",
    "offset_share",
)
"""The numbers of ``pair_features``, in this order."""


@dataclass(frozen=True, slots=True)
class SegmentTable:
    """Segments as one array ``numbers`` (n, 15), because many at a time are selected from it.

    The columns are the fields of ``Segment``, ``count`` of pixels, and the line of inverse depth as its value at the
    middle and its slope, NaN unknown.
    """

    numbers: np.ndarray

    @property
    def count(self) -> np.ndarray:
        return self.numbers[:, 0]

    @property
    def middle(self) -> np.ndarray:
        return self.numbers[:, 1:3]

    @property
    def axis(self) -> np.ndarray:
        return self.numbers[:, 3:5]

    @property
    def predicted_axis(self) -> np.ndarray:
        return self.numbers[:, 5:7]

    @property
    def half_width(self) -> np.ndarray:
        return self.numbers[:, 7]

    @property
    def low(self) -> np.ndarray:
        return self.numbers[:, 8]

    @property
    def high(self) -> np.ndarray:
        return self.numbers[:, 9]

    @property
    def elongation(self) -> np.ndarray:
        return self.numbers[:, 10]

    @property
    def vote(self) -> np.ndarray:
        return self.numbers[:, 11:13]

    @property
    def line_at(self) -> np.ndarray:
        return self.numbers[:, 13]

    @property
    def line_slope(self) -> np.ndarray:
        return self.numbers[:, 14]

    @classmethod
    def of(cls, segments: Sequence[Segment]) -> SegmentTable:
        """Make the table of a list of segments."""
        rows = [
            (
                len(s.members),
                *s.middle,
                *s.axis,
                *s.predicted_axis,
                s.half_width,
                s.low,
                s.high,
                s.elongation,
                *s.vote,
                *(s.line or UNKNOWN),
            )
            for s in segments
        ]
        return cls(np.array(rows, float).reshape(-1, 15))

    def put(self, row: int, segment: Segment) -> None:
        """Replace a row by a segment."""
        self.numbers[row] = SegmentTable.of([segment]).numbers[0]

    def take(self, which: np.ndarray) -> SegmentTable:
        """Return the table of some rows."""
        return SegmentTable(self.numbers[which])


def pair_features(
    foreground: Foreground, big: SegmentTable, small: SegmentTable, border_px: np.ndarray, boundary: np.ndarray
) -> np.ndarray:
    """Compute PAIR_FEATURES (n, 19) of n pairs of segments.

    They share borders of ``border_px`` (n,) pixels of the maps, along which the boundary map has the mean ``boundary``
    (n,).
    """
    axis, away = big.axis, small.middle - big.middle
    along, offset = _dot(away, axis), np.abs(_cross(axis, away))
    span = np.maximum(big.high, along + small.high) - np.minimum(big.low, along + small.low)
    apart = small.vote - big.vote
    start, end = _between(big, small, along)
    gap, thin = np.maximum(0.0, end - start), np.maximum(small.half_width, 1.0)
    background, wide = np.zeros(len(gap)), gap > MIN_GAP_PX
    hidden, inverse, line = _gap(foreground, big.take(wide), start[wide], end[wide])
    background[wide] = 1.0 - (hidden | (inverse > NEARER * line)).sum(axis=1) / GAP_SAMPLES
    return np.stack(
        [
            np.minimum(border_px / (2.0 * np.minimum(small.half_width, big.half_width)), 3.0),
            boundary,
            border_px > 0.0,
            np.abs(_cross(small.axis, axis)) * np.minimum(small.elongation, 4.0) / 4.0,
            np.abs(_cross(small.predicted_axis, big.predicted_axis)),
            np.minimum(offset / big.half_width, 4.0),
            np.minimum(np.abs(_cross(small.axis, away)) / thin, 6.0),
            np.minimum(np.abs(_dot(apart, axis)) / span, 1.5),
            np.minimum(np.abs(_cross(axis, apart)) / (big.half_width + small.half_width), 3.0),
            np.minimum(gap / span, 1.0),
            background,
            np.minimum(10.0 * _depth_difference(big, small, along), 5.0),
            ~np.isnan(big.line_at + small.line_at),
            np.abs(np.log(small.half_width / big.half_width)),
            0.3 * np.log(small.count / foreground.grain),
            0.2 * np.minimum(big.elongation, 20.0),
            0.2 * np.minimum(small.elongation, 20.0),
            0.2 * np.minimum(gap / (2.0 * np.maximum(big.half_width, 1.0)), 10.0),
            np.minimum(offset / (big.half_width + 0.05 * np.abs(along)), 5.0),
        ],
        axis=1,
    ).astype(np.float32)


def may_merge(foreground: Foreground, big: SegmentTable, small: SegmentTable, border_px: np.ndarray) -> np.ndarray:
    """Tell whether (n,) the scorer must decide about a pair.

    Two segments may be one log when they touch or lie near one line, and when nothing separates them: between them
    there is neither background that is clearly farther away nor an end of a log.
    """
    away = small.middle - big.middle
    along, offset = _dot(away, big.axis), np.abs(_cross(big.axis, away))
    may = (border_px > 0.0) | (offset <= MAX_OFFSET_WIDTHS * big.half_width + MAX_OFFSET_SHARE * np.abs(along))
    start, end = _between(big, small, along)
    ask = np.flatnonzero(may & (np.abs(along) > 0.5 * (big.high - big.low)) & (offset <= big.half_width))
    middles = np.rint(big.middle + 0.5 * (start + end)[:, None] * big.axis).astype(int)
    for k in ask:
        (column, row), reach = middles[k], max(1, round(0.5 * float(small.half_width[k])))
        end_probabilities = foreground.ends[
            max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1
        ]
        has_end = end_probabilities.size and float(end_probabilities.max()) > MIN_END_PROBABILITY
        may[k] = not (has_end and end[k] - start[k] < small.half_width[k])
    ask = ask[may[ask] & (end - start > MIN_GAP_PX)[ask]]
    hidden, inverse, line = _gap(foreground, big.take(ask), start[ask], end[ask])
    may[ask] = (~hidden & (inverse < line / NEARER)).sum(axis=1) <= MIN_BACKGROUND_SHARE * GAP_SAMPLES
    return np.asarray(may)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _depth_difference(big: SegmentTable, small: SegmentTable, along: np.ndarray) -> np.ndarray:
    """Compute the relative difference (n,) of one's inverse depth and the other's line; 0 where one has no depth."""
    miss = np.abs(big.line_at + big.line_slope * along - small.line_at) / np.maximum(small.line_at, 1e-3)
    turned = np.where(_dot(big.axis, small.axis) > 0.0, 1.0, -1.0)
    back = np.abs(small.line_at - turned * small.line_slope * along - big.line_at) / np.maximum(big.line_at, 1e-3)
    apart = np.where(small.elongation > MIN_ELONGATION, np.minimum(miss, back), miss)
    return np.asarray(np.where(np.isnan(apart), 0.0, apart))


def _between(big: SegmentTable, small: SegmentTable, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find start and end (n,) of two segments' gap on the big one's axis; end before start when they overlap."""
    after = along > 0.0
    return np.where(after, big.high, along + small.high), np.where(after, along + small.low, big.low)


def _gap(
    foreground: Foreground, big: SegmentTable, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read along gaps (n, GAP_SAMPLES): foreground, inverse depth, and that of the big segment's line, NaN unknown."""
    at = start[:, None] + (end - start)[:, None] * GAP_SHARES
    pixels = np.rint(big.middle[:, None] + at[..., None] * big.axis[:, None]).astype(int)
    row = np.clip(pixels[..., 1], 0, foreground.mask.shape[0] - 1)
    column = np.clip(pixels[..., 0], 0, foreground.mask.shape[1] - 1)
    line = big.line_at[:, None] + big.line_slope[:, None] * at
    return foreground.mask[row, column], foreground.inverse[row, column], line
