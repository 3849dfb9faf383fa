"""Training of the box detector in the role of paper B's: boxes of logs from colour."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console
from torch.nn import functional as F

from autonomy.perception.papers import STRIDE, network_input
from training.common.loop import Schedule, initialised, stacked, train
from training.detection.augmentation import augmented
from training.detection.networks import BoxNetwork
from training.detection.segmentation import Picture
from training.pictures.labels import ID, IGNORED, Labelled

CROPS: Final = ((256, 1.0), (512, 0.25))
"""Sizes of the windows of small and of large pictures [px], and their share of a batch's pictures: a log that is longer
than its window says nothing of its ends."""
MIN_CORE_PEAK: Final = 0.5  # value of the peak from which on cells learn the sides of the box
SIDE_SHARE, OVERLAP_SHARE = 1.0, 2.0
MIN_BOX_PX: Final = 20


def targets(sample: Labelled) -> tuple[np.ndarray, np.ndarray]:
    """Compute target maps (5, h, w) float32 and their weights (2, h, w).

    The maps are peaks (probability) at the middles of boxes, and logarithms of the distances to the sides in STRIDE.
    """
    h, w = (n // STRIDE for n in sample.ids.shape)
    maps, weights = np.zeros((5, h, w), np.float32), np.ones((2, h, w), np.float32)
    x, y = np.arange(w), np.arange(h)[:, None]
    weights[1] = 0.0
    for log in sample.logs:
        rows, columns = (np.flatnonzero((sample.ids == log[ID]).any(axis=a)) for a in (1, 0))
        if len(rows) * len(columns) < MIN_BOX_PX:
            continue
        left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
        u, v = ((left + right) / 2 / STRIDE - 0.5, (top + bottom) / 2 / STRIDE - 0.5)
        peak_sigma = 0.8 + 0.05 * min(right - left, bottom - top) / STRIDE
        # The cell with the middle always has the value 1.
        near_u, near_v = (min(max(round(c), 0), n - 1) for c, n in ((u, w), (v, h)))
        peak = np.exp(-((x - near_u) ** 2 + (y - near_v) ** 2) / (2.0 * peak_sigma * peak_sigma)).astype(np.float32)
        core = (peak > MIN_CORE_PEAK) & (peak >= maps[0])
        middle = (x + 0.5) * STRIDE + 0.0 * y, (y + 0.5) * STRIDE + 0.0 * x
        sides = (middle[0] - left, middle[1] - top, right - middle[0], bottom - middle[1])
        for i, side in enumerate(sides, 1):
            maps[i][core] = np.log(np.maximum(side[core], 0.5) / STRIDE)
        weights[1][core] = 1.0
        maps[0] = np.maximum(maps[0], peak)
    blocks = sample.ids[: h * STRIDE, : w * STRIDE].reshape(h, STRIDE, w, STRIDE)
    weights[0][(blocks == IGNORED).any(axis=(1, 3)) & (maps[0] < MIN_CORE_PEAK)] = 0.0
    return maps, weights


def loss(net: torch.nn.Module, images: torch.Tensor, maps: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Compute the loss of a batch: focal cross entropy of the peaks (Zhou et al. 2019), distance of the logarithms of
    the sides, and 1 minus the generalised overlap of the boxes."""
    predicted_maps = net(images).float()
    peak, logit = maps[:, 0], predicted_maps[:, 0]
    probability = torch.sigmoid(logit)
    hit = (peak == 1.0).float()
    away = (1.0 - peak) ** 4 * probability**2 * -F.logsigmoid(-logit)
    near = (1.0 - probability) ** 2 * -F.logsigmoid(logit)
    score = ((hit * near + (1.0 - hit) * away) * weights[:, 0]).sum() / (hit.sum() + 1.0)
    sides = (predicted_maps[:, 1:] - maps[:, 1:]).abs().sum(1) + OVERLAP_SHARE * _giou_loss(
        predicted_maps[:, 1:], maps[:, 1:]
    )
    total: torch.Tensor = score + SIDE_SHARE * (sides * weights[:, 1]).sum() / (weights[:, 1].sum() + 1.0)
    return total


def _giou_loss(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Compute 1 minus the generalised overlap (N, h, w) (Rezatofighi et al. 2019) of boxes around the same cells, from
    the logarithms of their sides (N, 4, h, w)."""
    predicted_sides, true_sides = (x.clamp(-4.0, 5.0).exp() for x in (found, truth))
    shared, around = (
        _area(torch.minimum(predicted_sides, true_sides)),
        _area(torch.maximum(predicted_sides, true_sides)),
    )
    union = _area(predicted_sides) + _area(true_sides) - shared
    return 2.0 - shared / union - union / around


def _area(sides: torch.Tensor) -> torch.Tensor:
    left, top, right, bottom = sides.unbind(1)
    return (left + right) * (top + bottom)


def run(
    sources: Sequence[tuple[Picture, int]],
    schedule: Schedule,
    size: int,
    seed: int,
    checkpoint: Path | None,
    console: Console,
    start: Mapping[str, np.ndarray] | None = None,
) -> tuple[BoxNetwork, list[float]]:
    """Train in batches of ``size``; return the net and the loss of every step.

    ``sources`` are small pictures and, optionally, large ones, each with their count.  The training starts from the
    arrays ``start``, or from random parameters.
    """
    net = initialised(BoxNetwork, seed, start)
    run_name = f"boxes, {' and '.join(str(count) for _, count in sources)} pictures, batch {size}, seed {seed}"
    losses = train(net, batches(sources, size, seed), loss, schedule, checkpoint, run_name, "boxes of logs", console)
    return net.eval(), losses


def batches(sources: Sequence[tuple[Picture, int]], size: int, seed: int) -> Callable[[int], tuple[torch.Tensor, ...]]:
    """Make a function that returns the batch of a step; the sources alternate."""

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        rng = np.random.default_rng([seed, step])
        turn = step % len(sources)
        (picture, count), (crop_px, share) = sources[turn], CROPS[turn]
        rows = []
        for index in rng.integers(0, count, max(2, round(share * size))):
            sample = augmented(picture(int(index)), rng, crop_px)
            rows.append((network_input(sample.rgb), *targets(sample)))
        return stacked(rows)

    return batch
