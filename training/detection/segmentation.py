"""Training of the segmentation network: loss, batches and the run.

Pictures come from a function of their number; this module does not know how they are made or stored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console
from scipy import ndimage
from torch.nn import functional as F

from autonomy.perception.segmentation.network import MAPS, MASK, OFFSET_PX, STRIDE, network_input
from training.common.loop import Schedule, initialised, stacked, train
from training.detection.augmentation import augmented
from training.detection.networks import UNet
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

# -- Targets of the segmentation network's eight maps, with weights.


PEAK_SIGMA_PX: Final = 1.5  # of the peaks at centres and ends [pixels of the maps]
SMALL_WEIGHT, OUTLINE_WEIGHT = 10.0, 2.0
ALONG_TOLERANCE, ACROSS_TOLERANCE = (0.08, 1.0), (0.2, 0.4)
"""Tolerance of an offset along a log (share of its length, pixels of the maps) and across it (share of its width,
pixels): about a third of the radius within which votes are gathered, because a log is long and thin and its neighbours
lie beside it."""


def targets(sample: Labelled) -> tuple[np.ndarray, np.ndarray]:
    """Compute the maps (8, h, w) float32 that the network should predict (probabilities for its logits), and weights
    (8, h, w).

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
            *log[[CENTRE_U, CENTRE_V]],
            np.cos(2 * log[ANGLE]),
            np.sin(2 * log[ANGLE]),
            share,
            share * log[ELONGATION],
            *(axis * unit / along),
            -axis[1] * unit / across,
            axis[0] * unit / across,
        )
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
    """Compute tolerances of the offsets of a log's pixels along and across its axis [pixels of the maps]."""
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


# -- Training of the segmentation network


PEAK_WEIGHT: Final = 20.0
EDGE_WEIGHT, BETWEEN_WEIGHT = 3.0, 8.0  # of edges, and additionally of those between two logs
OFFSET_SHARE, ANGLE_SHARE, PEAK_SHARE, EDGE_SHARE = 0.6, 2.0, 0.7, 2.0
CROPS: Final = ((160, 1.0), (304, 0.3))
"""Sizes of the windows that batches use in turn [px], and their share of a batch's pictures.  Most windows are small,
because pictures are mostly ground and small windows teach more in the same time; long logs need large ones."""
Picture = Callable[[int], Labelled]


def loss(net: torch.nn.Module, images: torch.Tensor, maps: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Compute the loss of a batch: cross entropy of mask, peaks and edges, distances of offsets and angles.

    Offsets and angles of a log are weighted with the square root of its size.
    """
    predicted_maps = net(images).float()
    weight, of_offset, of_angle = weights[:, :3].unbind(1)
    total = weight.sum() + 1.0

    def entropy(i: int, factor: torch.Tensor) -> torch.Tensor:
        return (
            F.binary_cross_entropy_with_logits(predicted_maps[:, i], maps[:, i], reduction="none") * factor
        ).sum() / total

    open_ = (weight > 0.0).float()
    probability, truth = torch.sigmoid(predicted_maps[:, MASK]) * open_, maps[:, MASK] * open_
    shared, sizes = (probability * truth).sum((1, 2)), (probability + truth).sum((1, 2))
    dice = (1.0 - 2.0 * (shared + 1.0) / (sizes + 2.0)).mean()
    value = 4.0 * entropy(MASK, weight) + dice
    for i in (1, 6):
        value = value + PEAK_SHARE * entropy(i, weight * (1.0 + PEAK_WEIGHT * maps[:, i]))
    value = value + EDGE_SHARE * entropy(7, weight * (1.0 + EDGE_WEIGHT * maps[:, 7] + BETWEEN_WEIGHT * weights[:, 7]))
    miss = (predicted_maps[:, 2:4] - maps[:, 2:4]).repeat(1, 2, 1, 1) * weights[:, 3:7]
    # Votes far off are lost anyway: the logarithm favours those that can still be corrected.
    offset = torch.log1p(miss[:, :2].sum(1).abs()) + torch.log1p(miss[:, 2:].sum(1).abs())
    angle = (predicted_maps[:, 4:6] - maps[:, 4:6]).abs().sum(1)
    value = value + OFFSET_SHARE * (offset * of_offset).sum() / (of_offset.sum() + 1e-3)
    total_loss: torch.Tensor = value + ANGLE_SHARE * (angle * of_angle).sum() / (of_angle.sum() + 1e-3)
    return total_loss


def batches(
    picture: Picture, count: int, size: int, variant: str, seed: int
) -> Callable[[int], tuple[torch.Tensor, ...]]:
    """Make a function that returns the batch of a step from ``count`` pictures."""

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        rng = np.random.default_rng([seed, step])
        crop_px, share = CROPS[step % len(CROPS)]
        rows = []
        for index in rng.integers(0, count, max(2, round(share * size))):
            sample = augmented(picture(int(index)), rng, crop_px)
            image = network_input(sample.rgb, sample.depth_m, sample.intrinsics, variant, sample.height_m)
            rows.append((image, *targets(sample)))
        return stacked(rows)

    return batch


def run(
    picture: Picture,
    count: int,
    variant: str,
    schedule: Schedule,
    size: int,
    seed: int,
    checkpoint: Path | None,
    console: Console,
    start: Mapping[str, np.ndarray] | None = None,
) -> tuple[UNet, list[float]]:
    """Train a variant on ``count`` pictures in batches of ``size``; return the net and the loss of every step.

    The training starts from the arrays ``start``, or from random parameters.
    """
    net = initialised(lambda: UNet(variant), seed, start)
    run_name = (
        f"segmentation {variant}, {count} pictures, batch {size}, seed {seed}, {'scratch' if start is None else 'on'}"
    )
    batch = batches(picture, count, size, variant, seed)
    losses = train(net, batch, loss, schedule, checkpoint, run_name, f"logs, {variant}", console)
    return net.eval(), losses
