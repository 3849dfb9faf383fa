"""What cameras and weather do to windows: depth errors, colours, fog, rain, sun in the lens, lost senses."""

from __future__ import annotations

import math

import torch
from torch.nn import functional as F

from autonomy.perception.segmentation.mask_network import CHANNELS, PIXELS_PER_M_UNIT
from autonomy.perception.segmentation.network import HEIGHT_RANGE_M, HEIGHT_UNIT_M, MIN_COLOUR_SPREAD, MIN_KNOWN_SHARE
from training.detection.masks.bank import Windows

NO_DEPTH_SHARE, NO_COLOUR_SHARE = 0.24, 0.05
EXACT_SHARE = 0.35  # of windows with exact depth that keep it


class Chance:
    """Random tensors on a device."""

    def __init__(self, generator: torch.Generator) -> None:
        self._generator, self.device = generator, generator.device

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
        """Draw uniform numbers."""
        return low + (high - low) * torch.rand(*shape, generator=self._generator, device=self.device)

    def normal(self, *shape: int) -> torch.Tensor:
        """Draw standard normal numbers."""
        return torch.randn(*shape, generator=self._generator, device=self.device)

    def some(self, count: int, share: float) -> torch.Tensor:
        """Draw which of ``count`` it happens to, as 0 or 1."""
        return (self.uniform(count) < share).float()

    def smooth(self, count: int, side: int, cell: int) -> torch.Tensor:
        """Draw smooth noise (count, side, side) of about unit variance, ``cell`` pixels wide."""
        small = self.normal(count, 1, side // cell + 2, side // cell + 2)
        return 1.4 * F.interpolate(small, (side, side), mode="bicubic", align_corners=False)[:, 0]


def disturbed_depth(w: Windows, chance: Chance) -> torch.Tensor:
    """Compute depth (B, C, C) [m], NaN unknown, as a stereo camera of unknown quality delivers it."""
    b, side = w.ids.shape[0], w.ids.shape[-1]
    z = w.depth_m
    rough = (1.0 - chance.some(b, EXACT_SHARE)) * (~w.sensed).float()  # a sensed picture has its own errors
    inverse = torch.nan_to_num(1.0 / z, nan=0.0)
    # Near surfaces grow over those behind them.
    for reach in (3, 5, 9):
        use = (chance.some(b, 0.3) * rough)[:, None, None] * (chance.smooth(b, side, 8) > 0.0).float()
        grown = F.max_pool2d(inverse[:, None], reach, 1, reach // 2)[:, 0]
        inverse = torch.where((use > 0) & (grown - inverse > 0.02), grown, inverse)
    # Disparity errs by pixels of a camera with some baseline: coarse and fine, and in steps.
    per_px = torch.exp(chance.uniform(b, low=math.log(0.008), high=math.log(0.05)))[:, None, None]  # 1/m for each pixel
    sigma = torch.exp(chance.uniform(b, low=math.log(0.02), high=math.log(0.5)))[:, None, None] * rough[:, None, None]
    error = 0.7 * chance.smooth(b, side, 6) + 0.5 * chance.smooth(b, side, 16) + 0.3 * chance.normal(b, side, side)
    noisy = inverse + per_px * sigma * error
    step = per_px * chance.uniform(b, low=0.05, high=0.6)[:, None, None]
    stepped = (chance.some(b, 0.3) * rough)[:, None, None]
    noisy = torch.where(stepped > 0, torch.round(noisy / step) * step, noisy)
    scale = 1.0 + 0.03 * chance.normal(b)[:, None, None] * rough[:, None, None]
    known = (inverse > 0) & (noisy > 0.02)
    holes = chance.smooth(b, side, 10) > (3.0 - 1.9 * chance.uniform(b) * rough)[:, None, None]
    big = chance.smooth(b, side, 48) > (3.2 - 1.8 * chance.some(b, 0.3) * chance.uniform(b))[:, None, None]
    # What one eye cannot see: a strip beside every near edge.
    jump = F.pad(inverse[:, :, 1:] - inverse[:, :, :-1], (0, 1)) > 0.03
    strip = (
        F.max_pool2d(jump.float()[:, None], (1, 7), 1, (0, 3))[:, 0] * (chance.some(b, 0.5) * rough)[:, None, None] > 0
    )
    far = chance.uniform(b, low=6.0, high=40.0)[:, None, None]
    dark = (w.rgb.mean(1) < 0.06) & ((chance.some(b, 0.2) * rough)[:, None, None] > 0)
    z = scale / noisy.clamp(min=1e-3)
    known = known & ~holes & ~big & ~strip & ~dark & (z < far)
    return torch.where(known, z, torch.full_like(z, math.nan))


def disturbed_colour(w: Windows, chance: Chance) -> torch.Tensor:
    """Compute colours (B, 3, C, C), 0..1, of another camera, day and weather."""
    b, side, x = w.ids.shape[0], w.ids.shape[-1], w.rgb
    many = (slice(None), None, None, None)
    # Each log in a colour of its own, now and then; the ground's hue apart from the logs'.
    tint = torch.exp(chance.normal(b, 256, 3) * torch.tensor([0.22, 0.18, 0.25], device=x.device)) * torch.exp(
        0.35 * chance.normal(b, 256, 1)
    )
    tint = 1.0 + (tint - 1.0) * chance.some(b, 0.4)[:, None, None]
    x = x * tint.gather(1, w.ids.flatten(1).long()[..., None].expand(-1, -1, 3)).permute(0, 2, 1).view_as(x)
    angle = chance.normal(b) * 0.3 * chance.some(b, 0.5) + chance.some(b, 0.08) * chance.uniform(b, low=-3.1, high=3.1)
    c, s = torch.cos(angle), torch.sin(angle)
    eye, third = torch.eye(3, device=x.device), torch.full((3, 3), 1.0 / 3.0, device=x.device)
    cross = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]], device=x.device) / math.sqrt(3.0)
    mix = c[:, None, None] * eye + (1 - c)[:, None, None] * third + s[:, None, None] * cross
    fade = torch.where(chance.uniform(b) < 0.1, torch.zeros(b, device=x.device), chance.uniform(b, low=0.4, high=1.5))[
        :, None, None
    ]
    mix = (fade * eye + (1 - fade) * third) @ mix
    mix = mix * torch.exp(0.15 * chance.normal(b, 3, 1))
    x = torch.einsum("bij,bjhw->bihw", mix, x).clamp(0, 2)
    x = x ** torch.exp(0.4 * chance.normal(b))[many] * torch.exp(0.4 * chance.normal(b))[many]
    x = x + 0.08 * chance.normal(b)[many] * chance.some(b, 0.5)[many]
    # Uneven light: shade of trees, lamps.
    x = x * torch.exp(0.25 * chance.smooth(b, side, 40) * chance.some(b, 0.3)[:, None, None])[:, None]
    # Fog grows with depth.
    z = torch.nan_to_num(w.depth_m, nan=30.0)[:, None]
    clear = torch.exp(-z / torch.exp(chance.uniform(b, low=math.log(4.0), high=math.log(40.0)))[many])
    fog = chance.uniform(b, low=0.5, high=1.0)[many]
    x = torch.where(chance.some(b, 0.15)[many] > 0, fog + (x - fog) * clear, x)
    # Lens: blur of motion or focus, drops of rain, sun.
    soft = F.avg_pool2d(F.avg_pool2d(x, 3, 1, 1, count_include_pad=False), 3, 1, 1, count_include_pad=False)
    x = x + (soft - x) * (chance.uniform(b) * chance.some(b, 0.45))[many]
    line = F.avg_pool2d(x, (1, 9), 1, (0, 4), count_include_pad=False)
    tall = F.avg_pool2d(x, (9, 1), 1, (4, 0), count_include_pad=False)
    blur_choice = chance.uniform(b)[many]
    x = torch.where(blur_choice < 0.05, line, torch.where(blur_choice < 0.1, tall, x))
    drop = (chance.smooth(b, side, 24) > 1.9 - 0.7 * chance.uniform(b)[:, None, None]).float() * chance.some(b, 0.1)[
        :, None, None
    ]
    wide = F.avg_pool2d(soft, 15, 1, 7, count_include_pad=False)
    x = x + (1.15 * wide - x) * drop[:, None]
    at = chance.uniform(b, 2, low=-0.2, high=1.2) * side
    rows = torch.arange(side, device=x.device)
    away = (
        (rows[None, None] - at[:, 0, None, None]) ** 2 + (rows[None, :, None] - at[:, 1, None, None]) ** 2
    ).sqrt() / side
    flare = torch.exp(-away / chance.uniform(b, low=0.05, high=0.5)[:, None, None]) * chance.uniform(b)[:, None, None]
    x = x + (flare * chance.some(b, 0.1)[:, None, None])[:, None]
    grain = torch.exp(chance.uniform(b, low=math.log(0.004), high=math.log(0.06)))[many] * chance.some(b, 0.6)[many]
    x = x + grain * chance.normal(*x.shape)
    blocks = F.interpolate(F.avg_pool2d(x, 2), scale_factor=2.0, mode="bilinear", align_corners=False)
    x = torch.where(chance.some(b, 0.12)[many] > 0, blocks, x)
    return x.clamp(0.0, 1.0)


def inputs(w: Windows, chance: Chance) -> torch.Tensor:
    """Compute the network's input (B, 6, C, C); as ``mask_network.mask_input`` with all disturbances."""
    b = w.ids.shape[0]
    z = disturbed_depth(w, chance)
    rgb = disturbed_colour(w, chance)
    known = torch.isfinite(z)
    # The plane as found in the picture: a little off.
    off = (0.02 * chance.normal(b))[:, None, None]
    lean = (1.0 + 0.01 * chance.normal(b))[:, None, None]
    height = (1.0 - lean * z * w.slope) / w.size[:, None, None] + off
    per_m = torch.log2(w.focal_px[:, None, None] / PIXELS_PER_M_UNIT / z.clamp(min=0.1))
    lost = chance.some(b, NO_DEPTH_SHARE)[:, None, None] > 0
    known = known & ~lost & torch.isfinite(height)
    out = torch.zeros(b, CHANNELS, *w.ids.shape[1:], device=rgb.device)
    out[:, 3] = torch.where(known, height.clamp(*HEIGHT_RANGE_M) / HEIGHT_UNIT_M, 0.0)
    out[:, 4] = torch.where(known, per_m, 0.0)
    out[:, 5] = known.float()
    share = torch.where((known.float().mean((1, 2)) > MIN_KNOWN_SHARE)[:, None, None], known.float(), 1.0)[:, None]
    total = share.sum((2, 3), keepdim=True)
    grey = 255.0 * rgb
    mean = (grey * share).sum((2, 3), keepdim=True) / total
    spread = (((grey - mean) ** 2 * share).sum((2, 3), keepdim=True) / total).sqrt()
    colour = (grey - mean) / (spread + MIN_COLOUR_SPREAD)
    blind = (chance.some(b, NO_COLOUR_SHARE) * known.any(2).any(1).float())[:, None, None, None]
    out[:, :3] = torch.where(blind > 0, torch.zeros_like(colour), colour)
    return out
