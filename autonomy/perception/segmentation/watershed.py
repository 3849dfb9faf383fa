"""The foreground parted into pieces: a wall where edges and turns of the axis are, flooded from its valleys.

An edge is seen from near by, so a small network draws it where it cannot tell how far away the middle of a log is; and
where two logs cross, the axis turns though the edge between them may be faint.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.perception.segmentation.network import COS2, EDGE, SIN2

LEVELS: Final = (*np.arange(0.05, 1.0, 0.05), 1.1)
DEPTH: Final = 0.08  # of a valley that is a piece; too many pieces are put together again, too few are never parted
LEAST_CORE: Final = 3  # pixels of a valley
TURN: Final = 0.4  # of a wall for each unit by which the double angle's arrow differs over two pixels
STEEPEST: Final = 0.97


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x))."""
    return 1.0 / (1.0 + np.exp(-x))


def wall(maps: np.ndarray) -> np.ndarray:
    """How surely each pixel (h, w) of maps (8, h, w) parts two logs, 0..1."""
    arrow = maps[COS2 : SIN2 + 1]
    arrow = arrow / (np.hypot(*arrow) + 1e-3)
    turn = np.zeros(maps.shape[1:], np.float32)
    turn[:, 1:-1] += ((arrow[:, :, 2:] - arrow[:, :, :-2]) ** 2).sum(axis=0)
    turn[1:-1] += ((arrow[:, 2:] - arrow[:, :-2]) ** 2).sum(axis=0)
    return np.maximum(sigmoid(maps[EDGE]), np.minimum(TURN * np.sqrt(turn), STEEPEST))


def watershed(wall: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    """Labels (h, w) int32, 0 outside ``foreground``, of the valleys of ``wall`` (h, w), 0..1.

    The water rises in LEVELS.  A pool without a label is a new valley; where pools with labels meet, those less than
    DEPTH deep are forgotten, and from there on nothing is labelled.  What is left goes to the nearest label that is in
    its patch of foreground.
    """
    rows, columns = np.flatnonzero(foreground.any(axis=1)), np.flatnonzero(foreground.any(axis=0))
    labels = np.zeros(wall.shape, np.int32)
    if len(rows):
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        labels[window] = _flooded(wall[window], foreground[window])
    return labels


def _flooded(wall: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    at = np.flatnonzero(foreground)
    height, label = wall.ravel()[at], np.zeros(len(at), np.int32)
    birth = [0.0]
    water = np.zeros(foreground.shape, bool)
    for level in LEVELS:
        water.ravel()[at] = height < level
        pools, count = ndimage.label(water)
        pool = pools.ravel()[at]
        taken = label > 0
        pairs = np.unique(pool[taken].astype(np.int64) * len(birth) + label[taken])
        of_pool, of_label = pairs // len(birth), pairs % len(birth)
        many, size = (np.bincount(of, minlength=count + 1) for of in (of_pool, pool))
        into = np.zeros(count + 1, np.int32)  # what a pool's pixels are labelled
        new = 1 + np.flatnonzero((many[1:] == 0) & (size[1:] >= LEAST_CORE))
        into[new] = len(birth) + np.arange(len(new))
        alone = many[of_pool] == 1
        into[of_pool[alone]] = of_label[alone]
        forgotten = np.zeros(len(birth), bool)
        for meeting in np.flatnonzero(many > 1):
            here = sorted(of_label[of_pool == meeting].tolist(), key=lambda i: birth[i])
            low = [i for i in here[1:] if level - birth[i] < DEPTH]
            forgotten[low] = True
            if len(low) == len(here) - 1:
                into[meeting] = here[0]
        label[forgotten[label]] = 0
        birth += [float(level)] * len(new)
        fill = (label == 0) & (pool > 0)
        label[fill] = into[pool[fill]]
    labels = np.zeros(wall.shape, np.int32)
    labels.ravel()[at] = label
    if label.any():
        nearest = tuple(ndimage.distance_transform_edt(labels == 0, return_distances=False, return_indices=True))
        patch, _ = ndimage.label(foreground, np.ones((3, 3)))
        rest = foreground & (labels == 0) & (patch[nearest] == patch)  # what is far from any valley is no log's
        labels[rest] = labels[nearest][rest]
    return labels
