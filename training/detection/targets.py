"""Targets of the segmentation network's eight maps, with weights."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.perception.segmentation.network import MAPS, OFFSET_PX, STRIDE
from training.pictures.labels import (
    ANGLE,
    CENTRE_U,
    CENTRE_V,
    ELONGATION,
    END_SEEN,
    END_U,
    END_V,
    ID,
    IGNORED,
    START_SEEN,
    START_U,
    START_V,
    Labelled,
)

PEAK_SIGMA_PX: Final = 1.5  # of the peaks at centres and ends [pixels of the maps]
SMALL_WEIGHT, OUTLINE_WEIGHT = 10.0, 2.0
ALONG_TOLERANCE, ACROSS_TOLERANCE = (0.08, 1.0), (0.2, 0.4)
"""Tolerance of an offset along a log (share of its length, pixels of the maps) and across it (share of its width,
pixels): about a third of the radius within which votes are gathered, because a log is long and thin and its neighbours
lie beside it."""


def targets(sample: Labelled) -> tuple[np.ndarray, np.ndarray]:
    """The maps (8, h, w) float32 that the network should predict (probabilities for its logits), and weights (8, h, w).

    The weights are: of mask, peaks and edges (0 where the picture is ignored); of the offset; of the angle; four
    factors that turn an error of the offset (u, v) into errors along and across the log in units of the tolerance; 1
    where two logs meet.
    """
    h, w = (n // STRIDE for n in sample.ids.shape)
    blocks = sample.ids[: h * STRIDE, : w * STRIDE].reshape(h, STRIDE, w, STRIDE)
    ignored = (blocks == IGNORED).any(axis=(1, 3))
    ids = np.where(blocks == IGNORED, 0, blocks).max(axis=(1, 3))
    maps = np.zeros((len(MAPS), h, w), np.float32)
    maps[0] = ((blocks > 0) & (blocks != IGNORED)).mean(axis=(1, 3))
    weights = np.zeros((8, h, w), np.float32)
    size = np.bincount(ids.ravel(), minlength=256)
    middle = 0.5 * (STRIDE - 1)
    table = np.zeros((256, 10), np.float32)  # of each id: centre, cos, sin, two weights, along, across
    y, x = np.nonzero(ids)
    of = ids[y, x]
    for log in sample.logs:
        i = int(log[ID])
        share, own = 1.0 / np.sqrt(max(size[i], 1)), of == i
        axis = np.array([np.cos(log[ANGLE]), np.sin(log[ANGLE])])
        along, across = _tolerances(x[own], y[own], axis)
        unit = OFFSET_PX / STRIDE
        table[i] = (
            *log[[CENTRE_U, CENTRE_V]], np.cos(2 * log[ANGLE]), np.sin(2 * log[ANGLE]), share, share * log[ELONGATION],
            *(axis * unit / along), -axis[1] * unit / across, axis[0] * unit / across,
        )  # fmt: skip
        _add_peak(maps[1], log[CENTRE_U], log[CENTRE_V])
        for seen, u, v in ((START_SEEN, START_U, START_V), (END_SEEN, END_U, END_V)):
            if log[seen]:
                _add_peak(maps[6], log[u], log[v])
    of = table[ids].transpose(2, 0, 1)
    own = ids > 0
    columns, rows = np.arange(w) * STRIDE + middle, np.arange(h)[:, None] * STRIDE + middle
    maps[2], maps[3] = (of[0] - columns) * own / OFFSET_PX, (of[1] - rows) * own / OFFSET_PX
    maps[4], maps[5] = of[2], of[3]
    border = _border(ids)
    maps[7] = own & border
    # Small logs and outlines have few pixels but matter most.
    small, outline = (ndimage.maximum_filter(x, 5) for x in (of[4], border))
    weights[0] = ~ignored * (1.0 + SMALL_WEIGHT * small + OUTLINE_WEIGHT * outline)
    weights[1:7] = of[4:]
    padded = np.pad(ids, 1)
    around = np.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]])
    weights[7] = ndimage.maximum_filter((own & (around > 0) & (around != ids)).any(axis=0), 3)
    return maps, weights


def _tolerances(x: np.ndarray, y: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """Tolerances of the offsets of a log's pixels along and across its axis [pixels of the maps]."""
    if not len(x):
        return 1.0, 1.0
    along, across = x * axis[0] + y * axis[1], y * axis[0] - x * axis[1]
    length, width = float(np.ptp(along)) + 1.0, float(np.sqrt(12.0) * across.std()) + 1.0
    return ALONG_TOLERANCE[0] * length + ALONG_TOLERANCE[1], ACROSS_TOLERANCE[0] * width + ACROSS_TOLERANCE[1]


def _border(ids: np.ndarray) -> np.ndarray:
    differs = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    differs[:, 1:] |= across
    differs[:, :-1] |= across
    differs[1:] |= down
    differs[:-1] |= down
    return differs


def _add_peak(heat: np.ndarray, u_px: float, v_px: float) -> None:
    h, w = heat.shape
    x, y = (u_px + 0.5) / STRIDE - 0.5, (v_px + 0.5) / STRIDE - 0.5
    reach = int(3 * PEAK_SIGMA_PX) + 1
    x0, x1, y0, y1 = (
        max(0, int(x) - reach),
        min(w, int(x) + reach + 2),
        max(0, int(y) - reach),
        min(h, int(y) + reach + 2),
    )
    if x0 >= x1 or y0 >= y1:
        return
    dx, dy = np.arange(x0, x1) - x, np.arange(y0, y1)[:, None] - y
    peak = np.exp(-(dx * dx + dy * dy) / (2.0 * PEAK_SIGMA_PX * PEAK_SIGMA_PX))
    np.maximum(heat[y0:y1, x0:x1], peak, out=heat[y0:y1, x0:x1])
