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
from torch.nn import functional as F

from autonomy.networks.torch_net import TorchNet
from autonomy.perception.segmentation.network import MASK, network_input, unet
from training.common.loop import Schedule, initialised, stacked, train
from training.detection.augmentation import augmented
from training.detection.targets import targets
from training.pictures.labels import Labelled

PEAK_WEIGHT: Final = 20.0
EDGE_WEIGHT, BETWEEN_WEIGHT = 3.0, 8.0  # of edges, and additionally of those between two logs
OFFSET_SHARE, ANGLE_SHARE, PEAK_SHARE, EDGE_SHARE = 0.6, 2.0, 0.7, 2.0
CROPS: Final = ((160, 1.0), (304, 0.3))
"""Sizes of the windows that batches use in turn [px], and their share of a batch's pictures.  Most windows are small,
because pictures are mostly ground and small windows teach more in the same time; long logs need large ones."""
Picture = Callable[[int], Labelled]


def loss(net: torch.nn.Module, images: torch.Tensor, maps: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """The loss of a batch: cross entropy of mask, peaks and edges, distances of offsets and angles.

    Offsets and angles of a log are weighted with the square root of its size.
    """
    found = net(images)["maps"].float()
    weight, of_offset, of_angle = weights[:, :3].unbind(1)
    total = weight.sum() + 1.0

    def entropy(i: int, factor: torch.Tensor) -> torch.Tensor:
        return (F.binary_cross_entropy_with_logits(found[:, i], maps[:, i], reduction="none") * factor).sum() / total

    open_ = (weight > 0.0).float()
    probability, truth = torch.sigmoid(found[:, MASK]) * open_, maps[:, MASK] * open_
    shared, sizes = (probability * truth).sum((1, 2)), (probability + truth).sum((1, 2))
    dice = (1.0 - 2.0 * (shared + 1.0) / (sizes + 2.0)).mean()
    value = 4.0 * entropy(MASK, weight) + dice
    for i in (1, 6):
        value = value + PEAK_SHARE * entropy(i, weight * (1.0 + PEAK_WEIGHT * maps[:, i]))
    value = value + EDGE_SHARE * entropy(7, weight * (1.0 + EDGE_WEIGHT * maps[:, 7] + BETWEEN_WEIGHT * weights[:, 7]))
    miss = (found[:, 2:4] - maps[:, 2:4]).repeat(1, 2, 1, 1) * weights[:, 3:7]
    # Votes far off are lost anyway: the logarithm favours those that can still be corrected.
    offset = torch.log1p(miss[:, :2].sum(1).abs()) + torch.log1p(miss[:, 2:].sum(1).abs())
    angle = (found[:, 4:6] - maps[:, 4:6]).abs().sum(1)
    value = value + OFFSET_SHARE * (offset * of_offset).sum() / (of_offset.sum() + 1e-3)
    total_loss: torch.Tensor = value + ANGLE_SHARE * (angle * of_angle).sum() / (of_angle.sum() + 1e-3)
    return total_loss


def batches(
    picture: Picture, count: int, size: int, variant: str, seed: int
) -> Callable[[int], tuple[torch.Tensor, ...]]:
    """A function that returns the batch of a step from ``count`` pictures."""

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
) -> tuple[TorchNet, list[float]]:
    """Train a variant on ``count`` pictures in batches of ``size``; returns the net and the loss of every step.

    The training starts from the arrays ``start``, or from random parameters.
    """
    net = initialised(unet(variant), seed, start)
    what = (
        f"segmentation {variant}, {count} pictures, batch {size}, seed {seed}, {'scratch' if start is None else 'on'}"
    )
    batch = batches(picture, count, size, variant, seed)
    losses = train(net, batch, loss, schedule, checkpoint, what, f"logs, {variant}", console)
    return net.eval(), losses
