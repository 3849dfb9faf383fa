"""The loss of the mask network: of its maps, of where kernels are, and of the masks that kernels make."""

from __future__ import annotations

from typing import Final

import torch
from torch.nn import functional as F

from autonomy.perception.segmentation.mask_network import FEATURES, KERNEL_STRIDE, PLACE_PX
from autonomy.perception.segmentation.network import MAPS, STRIDE
from training.detection.masks.goals import Goals

PEAK_WEIGHT: Final = 20.0
EDGE_WEIGHT, BETWEEN_WEIGHT = 3.0, 8.0
OFFSET_SHARE, ANGLE_SHARE, PEAK_SHARE, EDGE_SHARE = 0.1, 1.0, 0.4, 1.0
MAPS_SHARE, HEAT_SHARE, KERNEL_SHARE = 0.5, 1.0, 3.0
KERNELS_OF_A_LOG: Final = 2
KERNELS_OF_A_PICTURE: Final = 20


def loss(
    out: tuple[torch.Tensor, torch.Tensor], g: Goals, generator: torch.Generator
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The loss of a batch, and its parts for the record; ``out`` are maps and kernels."""
    maps, kernels = (values.float() for values in out)
    parts = {
        "maps": maps_loss(maps, g),
        "heat": heat_loss(kernels[:, 0], g),
        "kernel": kernel_loss(maps[:, len(MAPS) :], kernels[:, 1:], g, generator),
    }
    total = MAPS_SHARE * parts["maps"] + HEAT_SHARE * parts["heat"] + KERNEL_SHARE * parts["kernel"]
    return total, {name: part.detach() for name, part in parts.items()}


def maps_loss(found: torch.Tensor, g: Goals) -> torch.Tensor:
    """Cross entropy of mask, peaks and edges, distances of offsets and angles."""
    weight, angle_weight, meeting = g.weights.unbind(1)
    own = weight * g.valid

    def entropy(i: int, factor: torch.Tensor) -> torch.Tensor:
        error = F.binary_cross_entropy_with_logits(found[:, i], g.maps[:, i], reduction="none")
        return (error * factor).sum() / (factor.detach() > 0).sum().clamp(min=1)

    probability, truth = torch.sigmoid(found[:, 0]) * g.wood, g.maps[:, 0] * g.wood
    shared, sizes = (probability * truth).sum((1, 2)), (probability + truth).sum((1, 2))
    value = 4.0 * entropy(0, weight * g.wood) / 2.0 + (1.0 - 2.0 * (shared + 1.0) / (sizes + 2.0)).mean()
    for i in (1, 6):
        value = value + PEAK_SHARE * entropy(i, own * (1.0 + PEAK_WEIGHT * g.maps[:, i]))
    value = value + EDGE_SHARE * entropy(7, own * (1.0 + EDGE_WEIGHT * g.maps[:, 7] + BETWEEN_WEIGHT * meeting))
    inside = (g.maps[:, 4:6].abs().sum(1) > 0) * g.valid
    miss = torch.log1p((found[:, 2:4] - g.maps[:, 2:4]).abs().sum(1))
    value = value + OFFSET_SHARE * (miss * inside).sum() / (inside.sum() + 1.0)
    angle = (found[:, 4:6] - g.maps[:, 4:6]).abs().sum(1) * angle_weight * g.valid
    return value + ANGLE_SHARE * angle.sum() / ((angle_weight * g.valid).sum() + 1e-3)


def heat_loss(heat: torch.Tensor, g: Goals) -> torch.Tensor:
    """Focal loss of a ridge, as for centres of objects."""
    cell = KERNEL_STRIDE // STRIDE
    open_ = (F.avg_pool2d(g.valid[:, None], cell)[:, 0] > 0.6).float()
    p = torch.sigmoid(heat).clamp(1e-5, 1 - 1e-5)
    sure = (g.heat > 0.75).float()
    hit = -((1 - p) ** 2) * torch.log(p) * sure
    miss = -((1 - g.heat) ** 4) * p**2 * torch.log(1 - p) * (1 - sure)
    return ((hit + miss) * open_).sum() / sure.sum().clamp(min=1.0)


def kernel_loss(features: torch.Tensor, kernels: torch.Tensor, g: Goals, generator: torch.Generator) -> torch.Tensor:
    """Dice and cross entropy of the masks of a few kernels of every log."""
    b, n = g.masks.shape[:2]
    columns = kernels.shape[3]
    # For every log, cells near its middle, at random.
    numbers = torch.arange(n, device=features.device)[None, :, None, None]
    own = (g.owner[:, None] == numbers) * g.heat[:, None]
    noise = torch.rand(own.shape, generator=generator, device=own.device)
    value, cell = (own * (0.6 + 0.8 * noise)).flatten(2).topk(KERNELS_OF_A_LOG, dim=2)
    least = torch.tensor([0.05] + [0.35] * (KERNELS_OF_A_LOG - 1), device=value.device)
    value = torch.where((value > least) & (g.counts > 0)[..., None], value, torch.zeros_like(value))
    value, which = value.flatten(1).topk(KERNELS_OF_A_PICTURE, dim=1)
    use, log, at = (value > 0).float(), which // KERNELS_OF_A_LOG, cell.flatten(1).gather(1, which)
    k = kernels.flatten(2).gather(2, at[:, None].expand(-1, kernels.shape[1], -1)).transpose(1, 2)
    logits = mask_logits(features, k, at // columns, at % columns)
    rows = torch.arange(b, device=log.device)[:, None]
    truth, valid = g.masks[rows, log], g.valid[:, None]
    p = torch.sigmoid(logits) * valid
    shared, sizes = (p * truth).sum((2, 3)), (p.square() + truth).sum((2, 3))
    dice = 1.0 - (2.0 * shared + 2.0) / (sizes + 2.0)
    weight = (g.valid * (0.08 + g.maps[:, 0] + 2.0 * g.weights[:, 2]))[:, None]
    entropy = (F.binary_cross_entropy_with_logits(logits, truth, reduction="none") * weight).sum((2, 3))
    each = dice + 0.5 * entropy / (truth.sum((2, 3)) + 60.0)
    return (each * use).sum() / use.sum().clamp(min=1.0)


def mask_logits(features: torch.Tensor, kernels: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Logits (B, K, h, w) of the masks of kernels (B, K, KERNEL) at cells (B, K)."""
    h, w = features.shape[2:]
    middle, half = KERNEL_STRIDE / 2.0 - 0.5, 0.5 * (STRIDE - 1)
    x = torch.arange(w, device=features.device) * STRIDE + half - (column[..., None] * KERNEL_STRIDE + middle)
    y = torch.arange(h, device=features.device) * STRIDE + half - (row[..., None] * KERNEL_STRIDE + middle)
    x, y = (x / PLACE_PX)[:, :, None, :], (y / PLACE_PX)[:, :, :, None]
    a, b, c, d, e, one = kernels[..., FEATURES:, None, None].unbind(2)
    flat = torch.einsum("bkc,bchw->bkhw", kernels[..., :FEATURES], features)
    return flat + (a * x + c * x * x) + (b * y + e * y * y + one) + (d * y) * x
