"""What the network should answer for windows: maps, and where kernels of logs belong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch.nn import functional as F

from autonomy.perception.segmentation.mask_network import KERNEL_STRIDE
from autonomy.perception.segmentation.network import OFFSET_PX, STRIDE
from training.detection.masks.bank import MAX_LOGS, WOOD, Windows

PEAK_SIGMA_PX: Final = 1.5
SMALL_WEIGHT, OUTLINE_WEIGHT = 8.0, 2.0
RIDGE: Final = 0.14  # width of the place where kernels belong, as a share of a log's visible length
MIN_CELL_SHARE: Final = 0.08
MIN_LOG_PX: Final = 8  # pixels of the maps


@dataclass(frozen=True, slots=True)
class Goals:
    """For B windows with maps of h x w pixels and kernels of k x l cells.

    masks (B, MAX_LOGS, h, w) float; valid (B, h, w): neither ignored nor wood without logs; maps (B, 8, h, w); weights
    of mask, of small logs, and where logs meet (B, 3, h, w); wood (B, h, w) counts for the mask alone; heat (B, k, l);
    owner (B, k, l) which log a cell belongs to, -1 none; counts (B, MAX_LOGS) pixels.
    """

    masks: torch.Tensor
    valid: torch.Tensor
    maps: torch.Tensor
    weights: torch.Tensor
    wood: torch.Tensor
    heat: torch.Tensor
    owner: torch.Tensor
    counts: torch.Tensor


@torch.no_grad()
def goals(w: Windows) -> Goals:
    """Compute the goals of windows."""
    b, side = w.ids.shape[0], w.ids.shape[-1]
    device, h = w.ids.device, side // STRIDE
    blocks = w.ids.view(b, h, STRIDE, h, STRIDE).permute(0, 1, 3, 2, 4).flatten(3)
    ignored = (blocks == 255).any(-1)
    loose = (blocks == WOOD).any(-1)
    ids = torch.where(blocks >= WOOD, torch.zeros_like(blocks), blocks).amax(-1).long()
    share = ((blocks > 0) & (blocks != 255)).float().mean(-1)
    masks = (
        F.one_hot(ids, 256)[..., 1 : MAX_LOGS + 1].permute(0, 3, 1, 2).float()
        if h < 64
        else torch.stack([(ids == k).float() for k in range(1, MAX_LOGS + 1)], 1)
    )
    masks = masks * (~ignored)[:, None]
    counts = masks.sum((2, 3))
    line = torch.arange(h, device=device, dtype=torch.float32) * STRIDE + 0.5 * (STRIDE - 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    ax, ay = w.axis[..., 0, None, None], w.axis[..., 1, None, None]
    along, across = ax * x + ay * y, ax * y - ay * x
    big = torch.full_like(along, 1e6)
    low = torch.where(masks > 0, along, big).amin((2, 3))
    high = torch.where(masks > 0, along, -big).amax((2, 3))
    n = counts.clamp(min=1.0)
    side_mean = (across * masks).sum((2, 3)) / n
    width = ((across - side_mean[..., None, None]).square() * masks).sum((2, 3)).div(n).sqrt() * 3.46
    mid, extent = 0.5 * (low + high), (high - low).clamp(min=1.0)
    cx = mid * w.axis[..., 0] - side_mean * w.axis[..., 1]
    cy = mid * w.axis[..., 1] + side_mean * w.axis[..., 0]
    there = counts >= MIN_LOG_PX

    def of(values: torch.Tensor) -> torch.Tensor:
        """Return a value of every log at its pixels, (B, h, w)."""
        table = torch.cat([torch.zeros(b, 1, device=device), values, torch.zeros(b, 255 - MAX_LOGS, device=device)], 1)
        return table.gather(1, ids.flatten(1)).view(b, h, h)

    own = (ids > 0).float()
    maps = torch.zeros(b, 8, h, h, device=device)
    maps[:, 0] = share
    maps[:, 1] = _peaks(cx[..., None], cy[..., None], there[..., None], x, y)
    maps[:, 2] = (of(cx) - x) * own / OFFSET_PX
    maps[:, 3] = (of(cy) - y) * own / OFFSET_PX
    maps[:, 4] = of(w.axis[..., 0] ** 2 - w.axis[..., 1] ** 2)
    maps[:, 5] = of(2.0 * w.axis[..., 0] * w.axis[..., 1])
    maps[:, 6] = _peaks(w.ends[..., 0], w.ends[..., 1], w.seen & there[..., None], x, y)
    differs = torch.zeros_like(own, dtype=torch.bool)
    meets = torch.zeros_like(differs)
    for dim in (1, 2):
        a, c = ids.narrow(dim, 0, h - 1), ids.narrow(dim, 1, h - 1)
        for start in (0, 1):
            differs.narrow(dim, start, h - 1).logical_or_(a != c)
            meets.narrow(dim, start, h - 1).logical_or_((a != c) & (a > 0) & (c > 0))
    maps[:, 7] = own * differs
    small = F.max_pool2d(of(counts.clamp(min=1.0).rsqrt())[:, None], 5, 1, 2)[:, 0]
    outline = F.max_pool2d(differs.float()[:, None], 5, 1, 2)[:, 0]
    valid = (~ignored).float()
    whole = 1.0 + SMALL_WEIGHT * small + OUTLINE_WEIGHT * outline
    meeting = F.max_pool2d(meets.float()[:, None], 3, 1, 1)[:, 0]
    weights = torch.stack(
        [valid * whole, of(counts.clamp(min=1.0).rsqrt() * (extent / (width + 1.0) / 3.0).clamp(0, 1)), meeting], 1
    )
    # Kernels belong to the middle of what is seen of a log.
    cell = KERNEL_STRIDE // STRIDE
    shares = F.avg_pool2d(masks, cell)
    ridge = torch.exp(-(((along - mid[..., None, None]) / (RIDGE * extent + 4.0)[..., None, None]) ** 2)) * masks
    ridge = F.max_pool2d(ridge, cell) * (shares > MIN_CELL_SHARE)
    most = ridge.amax((2, 3), keepdim=True)
    ridge = torch.where(most > 0.1, ridge / most.clamp(min=1e-3), ridge) * there[..., None, None]
    best, owner = (ridge * (0.5 + shares)).max(1)
    owner = torch.where(best > 0, owner, torch.full_like(owner, -1))
    return Goals(masks, valid * (~loose), maps, weights, valid, ridge.amax(1), owner, counts)


def _peaks(u: torch.Tensor, v: torch.Tensor, there: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Draw Gaussian peaks (B, h, w) at points (B, K, P)."""
    sigma = PEAK_SIGMA_PX * STRIDE
    out = torch.zeros(u.shape[0], *x.shape, device=x.device)
    for k in range(u.shape[-1]):
        away = (x - u[..., k, None, None]).square() + (y - v[..., k, None, None]).square()
        peak = torch.exp(-away / (2.0 * sigma * sigma)) * there[..., k, None, None]
        out = torch.maximum(out, peak.amax(1))
    return out
