"""Instances of logs in a picture: from the network's maps to masks, boxes, axes and ends.

The outline of a mask runs between pixels of the maps: the probability is interpolated to the picture's resolution and
thresholded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.perception.segmentation.network import ENDS, MASK, STRIDE
from autonomy.perception.segmentation.resize import bilinear
from autonomy.perception.segmentation.segment_merging import LogSegment, SegmentScorers, segment_logs
from autonomy.perception.segmentation.segments import Foreground, make_foreground, sigmoid

MIN_MASK_PROBABILITY: Final = 0.5
MIN_END_PROBABILITY: Final = 0.3
MIN_DEPTH_M: Final = 0.1


@dataclass(frozen=True, slots=True)
class Instance:
    """One log in one picture.

    mask (H, W) bool; ``box_px`` left, top, right, bottom of the mask, the last two exclusive; score 0..1; ``axis_px``
    angle of the log's axis in the picture [rad, -pi/2..pi/2); ``ends_px`` both ends of the axis (u, v) [px] in its
    direction; ``ends_seen`` which of them are visible, not hidden by something.
    """

    mask: np.ndarray
    box_px: tuple[int, int, int, int]
    score: float
    axis_px: float
    ends_px: tuple[tuple[float, float], tuple[float, float]]
    ends_seen: tuple[bool, bool]


def decode_instances(
    maps: np.ndarray, scale: int, depth_m: np.ndarray, scorers: SegmentScorers
) -> tuple[Instance, ...]:
    """Decode the logs of maps (8, h, w) in descending order of score.

    A pixel of the maps is ``scale`` pixels wide in the picture, whose depth is ``depth_m`` (H, W).
    """
    foreground = foreground_of(maps, scale, depth_m)
    logs = segment_logs(foreground, scorers)
    if not logs:
        return ()
    probability, x, y, shape = sigmoid(maps[MASK]), foreground.x, foreground.y, depth_m.shape
    labels = np.zeros(probability.shape, np.int32)
    for number, log in enumerate(logs, 1):
        labels[y[log.members], x[log.members]] = number
    probability = np.where((probability > MIN_MASK_PROBABILITY) & (labels == 0), 0.0, probability)
    # Pixels beside a log with a lower probability belong to it, too, because its outline runs through them.
    nearest = ndimage.distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
    labels = labels[tuple(nearest)]
    ends = sigmoid(maps[ENDS])
    instances = []
    for number, log in enumerate(logs, 1):
        instance = instance_at(log, number, x, y, labels, probability, ends, scale, (shape[0], shape[1]))
        if instance is not None:
            instances.append(instance)
    return tuple(sorted(instances, key=lambda i: -i.score))


def foreground_of(maps: np.ndarray, scale: int, depth_m: np.ndarray) -> Foreground:
    """Return the foreground of maps (8, h, w), with depth from the middle of each map pixel in the picture (H, W)."""
    probability = sigmoid(maps[MASK])
    inverse = np.full(probability.shape, np.nan, np.float32)
    middle = depth_m[scale // 2 :: scale, scale // 2 :: scale][: probability.shape[0], : probability.shape[1]]
    inverse[: middle.shape[0], : middle.shape[1]] = 1.0 / np.maximum(middle, MIN_DEPTH_M)
    grain = max(1, STRIDE // scale) ** 2
    return make_foreground(maps, probability, probability > MIN_MASK_PROBABILITY, inverse, grain)


def instance_at(
    log: LogSegment,
    number: int,
    x: np.ndarray,
    y: np.ndarray,
    labels: np.ndarray,
    probability: np.ndarray,
    ends: np.ndarray,
    scale: int,
    shape: tuple[int, int],
) -> Instance | None:
    """Return the log at the picture's resolution, ``scale`` pixels for each of a map's; None when it has no pixel."""
    px, py = x[log.members], y[log.members]
    x0, x1 = max(0, int(px.min()) - 2), min(probability.shape[1], int(px.max()) + 3)
    y0, y1 = max(0, int(py.min()) - 2), min(probability.shape[0], int(py.max()) + 3)
    window = probability[y0:y1, x0:x1] * (labels[y0:y1, x0:x1] == number)
    fine = bilinear(y1 - y0, scale) @ window @ bilinear(x1 - x0, scale).T
    top, left = y0 * scale, x0 * scale
    inside = fine[: shape[0] - top, : shape[1] - left] > MIN_MASK_PROBABILITY
    v, u = np.nonzero(inside)
    if not len(u):
        return None
    v, u = v + top, u + left
    mask = np.zeros(shape, bool)
    mask[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    axis = log.axis if log.axis[0] >= 0.0 else -log.axis
    across = np.array([-axis[1], axis[0]])
    along, side = u * axis[0] + v * axis[1], float(np.median(u * across[0] + v * across[1]))
    low, high = np.percentile(along, (0.5, 99.5))
    half_width = float(np.percentile(np.abs(u * across[0] + v * across[1] - side), 90))
    points, ends_seen = [], []
    for position in (low, high):
        point, visible = _end(position * axis + side * across, ends, scale, max(2.0 * scale, 1.2 * half_width))
        points.append(point)
        ends_seen.append(visible)
    box = (int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1)
    return Instance(
        mask,
        box,
        log.score,
        math.atan2(float(axis[1]), float(axis[0])),
        (points[0], points[1]),
        (ends_seen[0], ends_seen[1]),
    )


def _end(point: np.ndarray, ends: np.ndarray, scale: int, reach_px: float) -> tuple[tuple[float, float], bool]:
    """Return the end near ``point`` in the map of ends and True, or ``point`` and False when there is none."""
    at, reach = (point + 0.5) / scale - 0.5, reach_px / scale
    x0, y0 = (max(0, math.floor(c - reach)) for c in at)
    patch = ends[y0 : math.ceil(at[1] + reach) + 1, x0 : math.ceil(at[0] + reach) + 1]
    if not patch.size or patch.max() < MIN_END_PROBABILITY:
        return (float(point[0]), float(point[1])), False
    row, column = np.unravel_index(int(np.argmax(patch)), patch.shape)
    weight = patch * (patch > 0.5 * patch.max())
    rows, columns = np.ogrid[: patch.shape[0], : patch.shape[1]]
    weight = weight * ((rows - row) ** 2 + (columns - column) ** 2 <= 9)
    total = weight.sum()
    u = (x0 + float((weight * columns).sum() / total) + 0.5) * scale - 0.5
    v = (y0 + float((weight * rows).sum() / total) + 0.5) * scale - 0.5
    return (u, v), True


def shifted_instance(found: Instance, left: int, top: int, shape: tuple[int, int]) -> Instance:
    """Move an instance of a window with its corner at (left, top) into the whole picture of ``shape`` (H, W)."""
    mask = np.zeros(shape, bool)
    mask[top : top + found.mask.shape[0], left : left + found.mask.shape[1]] = found.mask
    x0, y0, x1, y1 = found.box_px
    (a, b), (c, d) = found.ends_px
    ends = ((a + left, b + top), (c + left, d + top))
    box = (x0 + left, y0 + top, x1 + left, y1 + top)
    return Instance(mask, box, found.score, found.axis_px, ends, found.ends_seen)
