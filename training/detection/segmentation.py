"""Training of the network that finds logs: targets of its eight maps, random changes of the picture, loss, and the run.

Pictures come from outside as a function of their number; where they are drawn or kept is not known here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console
from scipy import ndimage
from torch.nn import functional as F

from autonomy.networks.torch_net import TorchNet
from autonomy.perception.segmentation.network import MAPS, MASK, OFFSET_PX, STRIDE, network_input, unet
from training.common.loop import Schedule, begun, stacked, train
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
    cropped,
    enlarged,
    mirrored,
)

SPOT_PX: Final = 1.5  # sigma of the spots at centres and ends, in pixels of the maps
SPOT_WEIGHT: Final = 20.0
EDGE_WEIGHT, BETWEEN_WEIGHT = 3.0, 8.0  # of edges, and beside those between two logs
SMALL_WEIGHT, OUTLINE_WEIGHT = 10.0, 2.0
OFFSET_SHARE, ANGLE_SHARE, SPOT_SHARE, EDGE_SHARE = 0.6, 2.0, 0.7, 2.0
ALONG, ACROSS = (0.08, 1.0), (0.2, 0.4)
"""How far an offset may miss along a log (share of its length, pixels of the maps) and across it (of its width): about
a third of what the votes are gathered with, for a log is long and thin and its neighbours lie beside it."""
CROPS: Final = ((160, 1.0), (304, 0.3))
"""Sizes of the windows that batches are made of in turn [px] and their share of a batch's pictures: windows are mostly
small, for pictures are mostly ground and small ones teach more in the same time; long logs need large ones."""
ENLARGED: Final = 0.35  # share of windows half as large that are shown twice as large: small logs are looked at so
NO_DEPTH, NO_COLOUR = 0.1, 0.03  # share of pictures in which a sensor fails
Picture = Callable[[int], Labelled]


def targets(sample: Labelled) -> tuple[np.ndarray, np.ndarray]:
    """Maps (8, h, w) float32 that the network ought to give (probabilities where it gives logits), and weights
    (8, h, w): of mask, spots and edges (0 where nothing is judged), of the offset, of the angle; by what an error of
    the offset is multiplied (u, v each) to be that along the log and across it, in what it may miss; 1 where two logs
    meet."""
    h, w = (n // STRIDE for n in sample.ids.shape)
    blocks = sample.ids[: h * STRIDE, : w * STRIDE].reshape(h, STRIDE, w, STRIDE)
    ignored = (blocks == IGNORED).any(axis=(1, 3))
    ids = np.where(blocks == IGNORED, 0, blocks).max(axis=(1, 3))
    maps = np.zeros((len(MAPS), h, w), np.float32)
    maps[0] = ((blocks > 0) & (blocks != IGNORED)).mean(axis=(1, 3))
    weights = np.zeros((8, h, w), np.float32)
    size = np.bincount(ids.ravel(), minlength=256)
    middle = 0.5 * (STRIDE - 1)
    table = np.zeros((256, 10), np.float32)  # of every id: centre, cos, sin, two weights, along, across
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
        _spot(maps[1], log[CENTRE_U], log[CENTRE_V])
        for seen, u, v in ((START_SEEN, START_U, START_V), (END_SEEN, END_U, END_V)):
            if log[seen]:
                _spot(maps[6], log[u], log[v])
    of = table[ids].transpose(2, 0, 1)
    own = ids > 0
    columns, rows = np.arange(w) * STRIDE + middle, np.arange(h)[:, None] * STRIDE + middle
    maps[2], maps[3] = (of[0] - columns) * own / OFFSET_PX, (of[1] - rows) * own / OFFSET_PX
    maps[4], maps[5] = of[2], of[3]
    border = _border(ids)
    maps[7] = own & border
    # Small logs and outlines are few pixels, but they are what is to be learnt.
    small, outline = (ndimage.maximum_filter(x, 5) for x in (of[4], border))
    weights[0] = ~ignored * (1.0 + SMALL_WEIGHT * small + OUTLINE_WEIGHT * outline)
    weights[1:7] = of[4:]
    padded = np.pad(ids, 1)
    around = np.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]])
    weights[7] = ndimage.maximum_filter((own & (around > 0) & (around != ids)).any(axis=0), 3)
    return maps, weights


def _tolerances(x: np.ndarray, y: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """By how much the offsets of a log's pixels may miss along and across its axis [pixels of the maps]."""
    if not len(x):
        return 1.0, 1.0
    along, across = x * axis[0] + y * axis[1], y * axis[0] - x * axis[1]
    length, width = float(np.ptp(along)) + 1.0, float(np.sqrt(12.0) * across.std()) + 1.0
    return ALONG[0] * length + ALONG[1], ACROSS[0] * width + ACROSS[1]


def _border(ids: np.ndarray) -> np.ndarray:
    differs = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    differs[:, 1:] |= across
    differs[:, :-1] |= across
    differs[1:] |= down
    differs[:-1] |= down
    return differs


def _spot(heat: np.ndarray, u_px: float, v_px: float) -> None:
    h, w = heat.shape
    x, y = (u_px + 0.5) / STRIDE - 0.5, (v_px + 0.5) / STRIDE - 0.5
    reach = int(3 * SPOT_PX) + 1
    x0, x1, y0, y1 = (
        max(0, int(x) - reach),
        min(w, int(x) + reach + 2),
        max(0, int(y) - reach),
        min(h, int(y) + reach + 2),
    )
    if x0 >= x1 or y0 >= y1:
        return
    dx, dy = np.arange(x0, x1) - x, np.arange(y0, y1)[:, None] - y
    spot = np.exp(-(dx * dx + dy * dy) / (2.0 * SPOT_PX * SPOT_PX))
    np.maximum(heat[y0:y1, x0:x1], spot, out=heat[y0:y1, x0:x1])


def changed(sample: Labelled, rng: np.random.Generator, size_px: int) -> Labelled:
    """A square window of the picture about one of its logs, mirrored or not, in other colours, now and then without
    depth or colour."""
    if rng.random() < ENLARGED:
        sample = enlarged(cropped(sample, *_window(sample, rng, size_px // 2), size_px // 2))
    else:
        sample = cropped(sample, *_window(sample, rng, size_px), size_px)
    if rng.random() < 0.5:
        sample = mirrored(sample)
    depth, height = sample.depth_m, sample.height_m
    if rng.random() < NO_DEPTH:
        depth = np.full_like(depth, np.nan)
        height = None if height is None else depth
    rgb = np.zeros_like(sample.rgb) if rng.random() < NO_COLOUR else recoloured(sample.rgb, rng)
    return replace(sample, rgb=rgb, depth_m=depth, height_m=height)


def _window(sample: Labelled, rng: np.random.Generator, size_px: int) -> tuple[int, int]:
    """Left and top: anywhere in a tenth of the pictures, else such that the middle of some log is well inside."""
    room = np.array(sample.ids.shape[::-1]) - size_px
    if not len(sample.logs) or rng.random() < 0.1:
        left, top = rng.integers(0, room + 1)
    else:
        centre = sample.logs[rng.integers(len(sample.logs)), [CENTRE_U, CENTRE_V]]
        left, top = np.clip(centre - size_px * rng.uniform(0.25, 0.75, 2), 0, room).astype(int)
    return int(left), int(top)


def recoloured(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another camera on another day (H, W, 3) float32: gains, hue, saturation, contrast, gamma, grain."""
    mix = np.eye(3, dtype=np.float32)
    if rng.random() < 0.3:
        turn = rng.uniform(-0.6, 0.6) if rng.random() < 0.7 else rng.uniform(-np.pi, np.pi)
        c, s, third = np.cos(turn), np.sin(turn), 1.0 / 3.0
        k = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]], np.float32) * np.sqrt(third) * s
        mix = (c * np.eye(3) + (1.0 - c) * third + k).astype(np.float32)  # about the grey axis
    saturation = 0.0 if rng.random() < 0.1 else rng.uniform(0.5, 1.4)
    mix = (saturation * np.eye(3) + (1.0 - saturation) / 3.0).astype(np.float32) @ mix
    mix = mix * rng.uniform(0.8, 1.2, (3, 1)).astype(np.float32)
    gain, lift = rng.uniform(0.6, 1.4), rng.uniform(-30.0, 30.0)
    gamma = np.exp(rng.uniform(-0.6, 0.6)) if rng.random() < 0.5 else 1.0
    table = np.clip(255.0 * gain * np.linspace(0.0, 1.0, 256) ** gamma + lift, 0.0, 255.0).astype(np.float32)
    x = table[rgb.reshape(-1, 3)] @ mix.T
    if rng.random() < 0.5:
        grain = rng.standard_normal(4096, np.float32) * rng.uniform(1.0, 12.0)
        x += np.resize(np.roll(grain, rng.integers(4096)), x.shape[0] * 3).reshape(x.shape)
    return np.clip(x, 0.0, 255.0, out=x).reshape(rgb.shape)


def loss(net: torch.nn.Module, images: torch.Tensor, maps: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Of a batch: cross entropy of mask, spots and edges, distance of offsets and angles, where a log counts by
    the root of its size."""
    found = net(images)["maps"].float()
    judged, of_offset, of_angle = weights[:, :3].unbind(1)
    total = judged.sum() + 1.0

    def entropy(i: int, weight: torch.Tensor) -> torch.Tensor:
        return (F.binary_cross_entropy_with_logits(found[:, i], maps[:, i], reduction="none") * weight).sum() / total

    open_ = (judged > 0.0).float()
    probability, truth = torch.sigmoid(found[:, MASK]) * open_, maps[:, MASK] * open_
    shared, sizes = (probability * truth).sum((1, 2)), (probability + truth).sum((1, 2))
    dice = (1.0 - 2.0 * (shared + 1.0) / (sizes + 2.0)).mean()
    value = 4.0 * entropy(MASK, judged) + dice
    for i in (1, 6):
        value = value + SPOT_SHARE * entropy(i, judged * (1.0 + SPOT_WEIGHT * maps[:, i]))
    value = value + EDGE_SHARE * entropy(7, judged * (1.0 + EDGE_WEIGHT * maps[:, 7] + BETWEEN_WEIGHT * weights[:, 7]))
    miss = (found[:, 2:4] - maps[:, 2:4]).repeat(1, 2, 1, 1) * weights[:, 3:7]
    # A vote that misses by far is lost anyway: the logarithm minds those that can still be won.
    offset = torch.log1p(miss[:, :2].sum(1).abs()) + torch.log1p(miss[:, 2:].sum(1).abs())
    angle = (found[:, 4:6] - maps[:, 4:6]).abs().sum(1)
    value = value + OFFSET_SHARE * (offset * of_offset).sum() / (of_offset.sum() + 1e-3)
    return value + ANGLE_SHARE * (angle * of_angle).sum() / (of_angle.sum() + 1e-3)


def batches(
    picture: Picture, count: int, size: int, variant: str, seed: int
) -> Callable[[int], tuple[torch.Tensor, ...]]:
    """Batch of a step from ``count`` pictures."""

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        rng = np.random.default_rng([seed, step])
        crop_px, share = CROPS[step % len(CROPS)]
        rows = []
        for index in rng.integers(0, count, max(2, round(share * size))):
            sample = changed(picture(int(index)), rng, crop_px)
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
    """Train a variant on ``count`` pictures in batches of ``size``, from the arrays ``start`` or from scratch; the net
    and the loss of every step."""
    net = begun(unet(variant), seed, start)
    what = (
        f"segmentation {variant}, {count} pictures, batch {size}, seed {seed}, {'scratch' if start is None else 'on'}"
    )
    batch = batches(picture, count, size, variant, seed)
    losses = train(net, batch, loss, schedule, checkpoint, what, f"logs, {variant}", console)
    return net.eval(), losses
