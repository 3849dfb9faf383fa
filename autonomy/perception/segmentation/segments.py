"""Segments of the foreground: their geometry in the picture and in depth, and the features by which they are scored.

All features are independent of scale, because a network learns from them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.perception.segmentation.network import COS2, EDGE, ENDS, OFFSET_PX, OFFSET_U, OFFSET_V, SIN2, STRIDE

MIN_KNOWN_PX: Final = 8  # pixels with depth that determine a line
MIN_SLOPE_PX: Final = 6.0  # of a map: shorter segments have one depth
MIN_ELONGATION: Final = 2.0  # extent along over extent across, from which on the shape determines the axis
SEGMENT_FEATURES: Final = (
    "probability",
    "size",
    "half_width",
    "elongation",
    "filled",
    "axis_agreement",
    "vote_spread_along",
    "vote_spread_across",
    "boundary_inside",
    "boundary_around",
    "shared_border",
    "merge_probability",
    "depth_known",
    "depth_error",
)
"""The numbers of ``segment_features``, in this order."""


@dataclass(frozen=True, slots=True)
class Foreground:
    """The foreground of a picture.

    ``x``, ``y`` (N,): its pixels.  ``values`` (7, N): x, y, probability of wood, vector of the double angle (2), voted
    centre (2).  ``boundary``, ``ends`` (probability), ``mask`` (bool), ``inverse`` depth [1/m], NaN unknown: (h, w).
    ``grain``: pixels of the maps for one independent pixel of the network.
    """

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    boundary: np.ndarray
    ends: np.ndarray
    mask: np.ndarray
    inverse: np.ndarray
    grain: int


@dataclass(frozen=True, slots=True)
class Segment:
    """A set of pixels of a foreground.

    ``members`` (n,): indices of its pixels.  ``middle`` (2,).  ``axis`` (2,): by its shape when it is elongated,
    otherwise ``predicted_axis`` (2,), that of the network's maps.  ``half_width``; ``low`` and ``high``: range along
    the axis from the middle; ``elongation``; ``vote`` (2,): median of the voted centres.  ``line``: inverse depth at
    the middle and its slope along the axis [1/m, 1/m per pixel], None unknown; ``line_error``: its relative median
    error.
    """

    members: np.ndarray
    middle: np.ndarray
    axis: np.ndarray
    predicted_axis: np.ndarray
    half_width: float
    low: float
    high: float
    elongation: float
    vote: np.ndarray
    line: tuple[float, float] | None
    line_error: float


def make_foreground(
    maps: np.ndarray, probability: np.ndarray, mask: np.ndarray, inverse: np.ndarray | None, grain: int
) -> Foreground:
    """Make the foreground ``mask`` (h, w) of maps (8, h, w) with the probability of wood (h, w)."""
    y, x = np.nonzero(mask)
    votes = OFFSET_PX / STRIDE * maps[OFFSET_U : OFFSET_V + 1, y, x]
    values = np.stack([x, y, probability[y, x], *maps[COS2 : SIN2 + 1, y, x], x + votes[0], y + votes[1]])
    depth = np.full(mask.shape, np.nan, np.float32) if inverse is None else inverse
    return Foreground(x, y, values.astype(np.float32), boundary_map(maps), sigmoid(maps[ENDS]), mask, depth, grain)


def make_segment(foreground: Foreground, members: np.ndarray) -> Segment:
    """Make the segment of the foreground's pixels ``members`` (n,)."""
    x, y, probability, c, s, *votes = foreground.values.take(members, axis=1)
    n = len(members)
    angle = 0.5 * math.atan2(float(s @ probability), float(c @ probability))
    axis = predicted = np.array([math.cos(angle), math.sin(angle)])
    middle = np.array([float(x.sum()) / n, float(y.sum()) / n])
    x, y = x - np.float32(middle[0]), y - np.float32(middle[1])
    xx, xy, yy = float(x @ x) / n, float(x @ y) / n, float(y @ y) / n
    mean, differ = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    thin, tall = max(mean - differ, 0.0), mean + differ
    if tall > MIN_ELONGATION**2 * thin:
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        axis = np.array([math.cos(angle), math.sin(angle)])
    to_east, to_south = axis.astype(np.float32)
    along, across = to_east * x + to_south * y, to_east * y - to_south * x
    half_width = _quantile(np.abs(across - np.float32(_median(across))), 0.9) + 0.5
    line, error = _depth_line(along, foreground.inverse[foreground.y[members], foreground.x[members]])
    low, high = float(along.min()), float(along.max())
    vote = np.array([_median(v) for v in votes])
    elongation = math.sqrt(tall / (thin + 0.1))
    return Segment(members, middle, axis, predicted, half_width, low, high, elongation, vote, line, error)


def _depth_line(along: np.ndarray, inverse: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Fit inverse depth along the axis, which is linear for a straight log, and compute its relative median error."""
    known = np.isfinite(inverse)
    if np.count_nonzero(known) < MIN_KNOWN_PX:
        return None, 0.0
    t, s = along[known], inverse[known]
    middle = _median(s)
    extent = _extent(t)
    if extent < MIN_SLOPE_PX:
        return (middle, 0.0), _median(np.abs(s - np.float32(middle))) / middle
    slope, at = _fitted_line(t, s)
    error = np.abs(s - np.float32(at) - np.float32(slope) * t)
    median_error = _median(error)
    good = error <= 2.0 * median_error
    if _extent(t[good]) > 0.5 * extent:
        slope, at = _fitted_line(t[good], s[good])
    return (at, slope), median_error / middle


def _extent(values: np.ndarray) -> float:
    return float(values.max()) - float(values.min())


def _median(values: np.ndarray) -> float:
    """Compute the median of values (n,); for the few pixels of a segment ten times as fast as numpy's."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    pair = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return 0.5 * (float(pair[0]) + float(pair[1]))


def _quantile(values: np.ndarray, share: float) -> float:
    """Compute the quantile of values (n,), interpolated as numpy's percentile."""
    at = share * (len(values) - 1)
    low = int(at)
    parted = np.partition(values, (low, min(low + 1, len(values) - 1)))
    below, above = float(parted[low]), float(parted[min(low + 1, len(values) - 1)])
    return below + (at - low) * (above - below)


def _fitted_line(t: np.ndarray, s: np.ndarray) -> tuple[float, float]:
    """Fit slope and value at 0 of the least-squares line through s (n,) over t (n,)."""
    t0, s0 = float(t.sum()) / len(t), float(s.sum()) / len(s)
    away = t - np.float32(t0)
    slope = float(away @ (s - np.float32(s0))) / float(away @ away)
    return slope, s0 - slope * t0


def segment_features(
    foreground: Foreground, one: Segment, border_px: float, boundary_around: float, merge_probability: float
) -> np.ndarray:
    """Compute SEGMENT_FEATURES (14,) of a segment.

    Args:
        foreground: that of the segment.
        one: the segment.
        border_px: length of the border that it shares with other segments [pixels of the maps].
        boundary_around: mean of the boundary map along that border.
        merge_probability: the highest probability that it and another segment are one log.
    """
    members = one.members
    length, root = one.high - one.low + 1.0, math.sqrt(foreground.grain)
    _, _, probability, c, s, *votes = foreground.values.take(members, axis=1)
    east, south = votes[0] - np.float32(one.vote[0]), votes[1] - np.float32(one.vote[1])
    to_east, to_south = one.axis.astype(np.float32)
    strays = _median(np.abs(to_east * east + to_south * south)), _median(np.abs(to_east * south - to_south * east))
    agreement = math.hypot(float(c.sum()), float(s.sum())) / (float(np.hypot(c, s).sum()) + 1e-6)
    return np.array(
        [
            float(probability.sum()) / len(members),
            0.3 * math.log(len(members) / foreground.grain),
            0.3 * math.log(one.half_width / root),
            0.2 * min(one.elongation, 20.0),
            min(len(members) / (2.0 * one.half_width * length), 2.0),
            agreement,
            min(4.0 * strays[0] / length, 3.0),
            min(strays[1] / one.half_width, 3.0),
            float(foreground.boundary[foreground.y[members], foreground.x[members]].sum()) / len(members),
            boundary_around,
            min(border_px / (2.0 * (length + 2.0 * one.half_width)), 1.0),
            merge_probability,
            float(one.line is not None),
            min(20.0 * one.line_error, 3.0),
        ],
        np.float32,
    )


# -- Over-segmentation of the foreground by a watershed of the boundary map.
#
# The boundary map combines the network's edges with turns of the log axis.  A small network draws an edge where it
# cannot tell how far away the middle of a log is; and where two logs cross, the axis turns even if the edge between
# them is faint.

LEVELS: Final = (*np.arange(0.05, 1.0, 0.05), 1.1)
MIN_BASIN_DEPTH: Final = 0.08  # of a separate basin; too many segments are merged later, too few are never split
MIN_BASIN_PX: Final = 3
TURN_WEIGHT: Final = 0.4  # boundary for each unit by which the vector of the double angle differs over two pixels
MAX_TURN_BOUNDARY: Final = 0.97


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Compute 1 / (1 + exp(-x))."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.maximum(x, -80.0))))


def boundary_map(maps: np.ndarray) -> np.ndarray:
    """Compute the strength (h, w), 0..1, of the boundary between two logs at each pixel of maps (8, h, w)."""
    arrow = maps[COS2 : SIN2 + 1]
    arrow = arrow / (np.hypot(*arrow) + 1e-3)
    turn = np.zeros(maps.shape[1:], np.float32)
    turn[:, 1:-1] += ((arrow[:, :, 2:] - arrow[:, :, :-2]) ** 2).sum(axis=0)
    turn[1:-1] += ((arrow[:, 2:] - arrow[:, :-2]) ** 2).sum(axis=0)
    return np.asarray(np.maximum(sigmoid(maps[EDGE]), np.minimum(TURN_WEIGHT * np.sqrt(turn), MAX_TURN_BOUNDARY)))


def watershed(boundary: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    """Label (h, w) int32 the basins of ``boundary`` (h, w), 0..1; 0 outside ``foreground`` (h, w) bool.

    The water rises in ``LEVELS``.  A pool without a label becomes a new basin.  Where labelled pools meet, basins that
    are shallower than ``MIN_BASIN_DEPTH`` are removed, and from there on no pixels are labelled.  The remaining pixels
    get the nearest label in their connected part of the foreground.
    """
    rows, columns = np.flatnonzero(foreground.any(axis=1)), np.flatnonzero(foreground.any(axis=0))
    labels = np.zeros(boundary.shape, np.int32)
    if len(rows):
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        labels[window] = _watershed(boundary[window], foreground[window])
    return labels


def _watershed(boundary: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    at = np.flatnonzero(foreground)
    height, label = boundary.ravel()[at], np.zeros(len(at), np.int32)
    birth = [0.0]  # level at which each label appeared
    water = np.zeros(foreground.shape, bool)
    for level in LEVELS:
        water.ravel()[at] = height < level
        pools, count = ndimage.label(water)
        pool = pools.ravel()[at]
        labelled = label > 0
        pairs = np.unique(pool[labelled].astype(np.int64) * len(birth) + label[labelled])
        of_pool, of_label = pairs // len(birth), pairs % len(birth)
        label_count, size = (np.bincount(of, minlength=count + 1) for of in (of_pool, pool))
        into = np.zeros(count + 1, np.int32)  # the label of a pool's unlabelled pixels
        new = 1 + np.flatnonzero((label_count[1:] == 0) & (size[1:] >= MIN_BASIN_PX))
        into[new] = len(birth) + np.arange(len(new))
        alone = label_count[of_pool] == 1
        into[of_pool[alone]] = of_label[alone]
        removed = np.zeros(len(birth), bool)
        for meeting in np.flatnonzero(label_count > 1):
            meeting_labels = sorted(of_label[of_pool == meeting].tolist(), key=lambda i: birth[i])
            shallow = [i for i in meeting_labels[1:] if level - birth[i] < MIN_BASIN_DEPTH]
            removed[shallow] = True
            if len(shallow) == len(meeting_labels) - 1:
                into[meeting] = meeting_labels[0]
        label[removed[label]] = 0
        birth += [float(level)] * len(new)
        fill = (label == 0) & (pool > 0)
        label[fill] = into[pool[fill]]
    labels = np.zeros(boundary.shape, np.int32)
    labels.ravel()[at] = label
    if label.any():
        nearest = tuple(ndimage.distance_transform_edt(labels == 0, return_distances=False, return_indices=True))
        part, _ = ndimage.label(foreground, np.ones((3, 3)))
        rest = foreground & (labels == 0) & (part[nearest] == part)  # parts without a basin stay unlabelled
        labels[rest] = labels[nearest][rest]
    return labels
