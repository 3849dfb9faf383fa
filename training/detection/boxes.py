"""Training of paper B's detector in its role: boxes of logs from colour, learnt from labelled pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console
from torch.nn import functional as F

from autonomy.networks.torch_net import TorchNet
from autonomy.perception.papers.box_detector import STRIDE, box_net, network_input
from training.common.loop import Schedule, begun, stacked, train
from training.detection.segmentation import Picture, changed
from training.pictures.labels import ID, IGNORED, Labelled

CROPS: Final = ((256, 1.0), (512, 0.25))
"""Sizes of the windows of small and of large pictures [px] and their share of a batch's pictures: a log that is longer
than its window teaches nothing of where it ends."""
CORE: Final = 0.5  # cells whose spot is higher than this learn the box's sides
SIDE_SHARE, OVERLAP_SHARE = 1.0, 2.0
LEAST_PX: Final = 20


def targets(sample: Labelled) -> tuple[np.ndarray, np.ndarray]:
    """Maps (5, h, w) float32: spots (probability) at the middles of boxes, and logarithms of the distances to the sides
    in STRIDE; weights (2, h, w) of both."""
    h, w = (n // STRIDE for n in sample.ids.shape)
    maps, weights = np.zeros((5, h, w), np.float32), np.ones((2, h, w), np.float32)
    x, y = np.arange(w), np.arange(h)[:, None]
    weights[1] = 0.0
    for log in sample.logs:
        rows, columns = (np.flatnonzero((sample.ids == log[ID]).any(axis=a)) for a in (1, 0))
        if len(rows) * len(columns) < LEAST_PX:
            continue
        left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
        u, v = ((left + right) / 2 / STRIDE - 0.5, (top + bottom) / 2 / STRIDE - 0.5)
        spread = 0.8 + 0.05 * min(right - left, bottom - top) / STRIDE
        # The cell that the middle falls into is always a full hit.
        near_u, near_v = (min(max(round(c), 0), n - 1) for c, n in ((u, w), (v, h)))
        spot = np.exp(-((x - near_u) ** 2 + (y - near_v) ** 2) / (2.0 * spread * spread)).astype(np.float32)
        core = (spot > CORE) & (spot >= maps[0])
        middle = (x + 0.5) * STRIDE + 0.0 * y, (y + 0.5) * STRIDE + 0.0 * x
        sides = (middle[0] - left, middle[1] - top, right - middle[0], bottom - middle[1])
        for i, side in enumerate(sides, 1):
            maps[i][core] = np.log(np.maximum(side[core], 0.5) / STRIDE)
        weights[1][core] = 1.0
        maps[0] = np.maximum(maps[0], spot)
    blocks = sample.ids[: h * STRIDE, : w * STRIDE].reshape(h, STRIDE, w, STRIDE)
    weights[0][(blocks == IGNORED).any(axis=(1, 3)) & (maps[0] < CORE)] = 0.0
    return maps, weights


def loss(net: torch.nn.Module, images: torch.Tensor, maps: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Focal cross entropy of the spots (Zhou et al. 2019), distance of the sides' logarithms, and what the boxes'
    overlap lacks."""
    found = net(images)["boxes"].float()
    spot, logit = maps[:, 0], found[:, 0]
    probability = torch.sigmoid(logit)
    hit = (spot == 1.0).float()
    away = (1.0 - spot) ** 4 * probability**2 * -F.logsigmoid(-logit)
    near = (1.0 - probability) ** 2 * -F.logsigmoid(logit)
    score = ((hit * near + (1.0 - hit) * away) * weights[:, 0]).sum() / (hit.sum() + 1.0)
    sides = (found[:, 1:] - maps[:, 1:]).abs().sum(1) + OVERLAP_SHARE * _apart(found[:, 1:], maps[:, 1:])
    return score + SIDE_SHARE * (sides * weights[:, 1]).sum() / (weights[:, 1].sum() + 1.0)


def _apart(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """1 less the generalised overlap (N, h, w) (Rezatofighi et al. 2019) of boxes about the same cells, by the
    logarithms of their sides (N, 4, h, w)."""
    one, other = (x.clamp(-4.0, 5.0).exp() for x in (found, truth))
    shared, around = _area(torch.minimum(one, other)), _area(torch.maximum(one, other))
    union = _area(one) + _area(other) - shared
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
) -> tuple[TorchNet, list[float]]:
    """Train on ``sources``, small pictures and, where there are any, large ones, each with their number, in batches of
    ``size``, from the arrays ``start`` or from scratch; the net and the loss of every step."""
    net = begun(box_net(), seed, start)
    what = f"boxes, {' and '.join(str(count) for _, count in sources)} pictures, batch {size}, seed {seed}"
    losses = train(net, batches(sources, size, seed), loss, schedule, checkpoint, what, "boxes of logs", console)
    return net.eval(), losses


def batches(sources: Sequence[tuple[Picture, int]], size: int, seed: int) -> Callable[[int], tuple[torch.Tensor, ...]]:
    """Batch of a step, of the sources in turn."""

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        rng = np.random.default_rng([seed, step])
        turn = step % len(sources)
        (picture, count), (crop_px, share) = sources[turn], CROPS[turn]
        rows = []
        for index in rng.integers(0, count, max(2, round(share * size))):
            sample = changed(picture(int(index)), rng, crop_px)
            rows.append((network_input(sample.rgb), *targets(sample)))
        return stacked(rows)

    return batch
