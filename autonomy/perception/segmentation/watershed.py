"""Over-segmentation of the foreground by a watershed of the boundary map.

The boundary map combines the network's edges with turns of the log axis.  A small network draws an edge where it cannot
tell how far away the middle of a log is; and where two logs cross, the axis turns even if the edge between them is
faint.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.perception.segmentation.network import COS2, EDGE, SIN2

LEVELS: Final = (*np.arange(0.05, 1.0, 0.05), 1.1)
MIN_BASIN_DEPTH: Final = 0.08  # of a separate basin; too many segments are merged later, too few are never split
MIN_BASIN_PX: Final = 3
TURN_WEIGHT: Final = 0.4  # boundary for each unit by which the vector of the double angle differs over two pixels
MAX_TURN_BOUNDARY: Final = 0.97


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x))."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.maximum(x, -80.0))))


def boundary_map(maps: np.ndarray) -> np.ndarray:
    """Strength (h, w), 0..1, of the boundary between two logs at each pixel of maps (8, h, w)."""
    arrow = maps[COS2 : SIN2 + 1]
    arrow = arrow / (np.hypot(*arrow) + 1e-3)
    turn = np.zeros(maps.shape[1:], np.float32)
    turn[:, 1:-1] += ((arrow[:, :, 2:] - arrow[:, :, :-2]) ** 2).sum(axis=0)
    turn[1:-1] += ((arrow[:, 2:] - arrow[:, :-2]) ** 2).sum(axis=0)
    return np.asarray(np.maximum(sigmoid(maps[EDGE]), np.minimum(TURN_WEIGHT * np.sqrt(turn), MAX_TURN_BOUNDARY)))


def watershed(boundary: np.ndarray, foreground: np.ndarray) -> np.ndarray:
    """Labels (h, w) int32 of the basins of ``boundary`` (h, w), 0..1; 0 outside ``foreground`` (h, w) bool.

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
            here = sorted(of_label[of_pool == meeting].tolist(), key=lambda i: birth[i])
            shallow = [i for i in here[1:] if level - birth[i] < MIN_BASIN_DEPTH]
            removed[shallow] = True
            if len(shallow) == len(here) - 1:
                into[meeting] = here[0]
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
