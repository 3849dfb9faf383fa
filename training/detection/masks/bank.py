"""Labelled pictures as tensors on one device, and random windows of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import torch
from torch.nn import functional as F

from training.pictures.labels import ANGLE, CENTRE_U, CENTRE_V, END_SEEN, END_U, END_V, ID, START_SEEN, START_U, START_V

MAX_LOGS: Final = 16
WOOD: Final = 254
"""In ``ids``: wood whose logs are not told apart (a photograph)."""
ZOOMS: Final = (0.45, 2.4)  # pixels of a window for each of the picture
TAPS: Final = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


@dataclass(frozen=True, slots=True)
class Bank:
    """N square pictures of S pixels.

    rgb (N, S, S, 3) uint8; depth_mm (N, S, S) int16, exact, 0 unknown; sensed_mm (N, S, S) int16, as a sensor saw it;
    sensed (N,) whether it did; ids (N, S, S) uint8 as ``training.pictures.labels``; plane (N, 3) of ``ground_plane``,
    NaN without; lens (N, 4); logs (N, MAX_LOGS, ROW); share (N,) of how often a picture is drawn.
    """

    rgb: torch.Tensor
    depth_mm: torch.Tensor
    sensed_mm: torch.Tensor
    sensed: torch.Tensor
    ids: torch.Tensor
    plane: torch.Tensor
    lens: torch.Tensor
    logs: torch.Tensor
    share: torch.Tensor

    def __len__(self) -> int:
        return len(self.ids)

    def to(self, device: torch.device | str) -> Bank:
        """Return the same pictures on a device."""
        return Bank(*(getattr(self, f.name).to(device) for f in fields(self)))


def joined(banks: Sequence[Bank]) -> Bank:
    """Join all pictures of several banks of one size."""
    return Bank(*(torch.cat([getattr(b, f.name) for b in banks]) for f in fields(Bank)))


@dataclass(frozen=True, slots=True)
class Windows:
    """B windows of C pixels: rgb (B, 3, C, C) 0..1, depth_m and slope (B, C, C), ids (B, C, C), the plane's size (B,),
    focal length [px] (B,), sensed (B,), and of every log (B, MAX_LOGS, ...) whether it is there, its axis, both ends
    and whether they are seen.

    A pixel at depth z is (1 - z slope) / size over the plane.
    """

    rgb: torch.Tensor
    depth_m: torch.Tensor
    slope: torch.Tensor
    ids: torch.Tensor
    size: torch.Tensor
    focal_px: torch.Tensor
    sensed: torch.Tensor
    axis: torch.Tensor
    ends: torch.Tensor
    seen: torch.Tensor


def windows(bank: Bank, count: int, side_px: int, generator: torch.Generator) -> Windows:
    """Cut random windows: place, zoom, turn, mirror, a lens's distortion."""
    device = bank.ids.device

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, device=device)

    pick = torch.multinomial(bank.share, count, replacement=True, generator=generator)
    logs, lens, plane = bank.logs[pick], bank.lens[pick], bank.plane[pick]
    s = bank.ids.shape[-1]
    there = logs[..., ID] > 0
    # The window's middle: near some log, or anywhere.
    choice = torch.where(there, rand(count, MAX_LOGS), torch.full_like(logs[..., 0], -1.0)).argmax(1)
    mark = logs[torch.arange(count, device=device), choice][:, [CENTRE_U, CENTRE_V]]
    lone = ~there.any(1) | (rand(count) < 0.12)
    zoom = torch.exp(rand(count) * math.log(ZOOMS[1] / ZOOMS[0]) + math.log(ZOOMS[0]))
    middle = torch.where(
        lone[:, None], rand(count, 2) * s, mark.clamp(0, s) + normal(count, 2) * 0.22 * side_px / zoom[:, None]
    )
    half = 0.5 * side_px / zoom[:, None]
    middle = torch.where(
        half < 0.5 * s, torch.minimum(torch.maximum(middle, half), s - half), torch.full_like(middle, 0.5 * s)
    )
    turn = normal(count) * 0.12 + (rand(count) < 0.08).float() * (rand(count) - 0.5) * 6.28
    flip = torch.where(rand(count) < 0.5, -1.0, 1.0)
    c, sn = torch.cos(turn) / zoom, torch.sin(turn) / zoom
    to_source = torch.stack([torch.stack([c * flip, -sn], 1), torch.stack([sn * flip, c], 1)], 1)  # (B, 2, 2)
    line = torch.arange(side_px, device=device, dtype=torch.float32) - 0.5 * (side_px - 1)
    grid = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1)  # (C, C, 2) x, y
    bend = normal(count) * 0.04 * (rand(count) < 0.4).float()
    radius = (grid / (0.5 * side_px)).square().sum(-1)

    def places(shift: tuple[float, float]) -> torch.Tensor:
        at = (grid + torch.tensor(shift, device=device))[None] * (1.0 + bend[:, None, None] * radius)[..., None]
        return torch.einsum("bij,bhwj->bhwi", to_source, at) + middle[:, None, None, :]

    whole = bank.rgb[pick].permute(0, 3, 1, 2).float()
    rgb = torch.zeros(count, 3, side_px, side_px, device=device)
    for tap in TAPS:
        rgb += F.grid_sample(whole, (2.0 * places(tap) + 1.0) / s - 1.0, "bilinear", "zeros", False) / (
            255.0 * len(TAPS)
        )
    at = places((0.0, 0.0))
    nearest = at.round().long()
    inside = ((nearest >= 0) & (nearest < s)).all(-1)
    flat = (nearest[..., 1].clamp(0, s - 1) * s + nearest[..., 0].clamp(0, s - 1)).flatten(1)
    use = bank.sensed[pick] & (rand(count) < 0.65)
    source = torch.where(use[:, None, None], bank.sensed_mm[pick], bank.depth_mm[pick])
    depth = source.flatten(1).gather(1, flat).view(count, side_px, side_px)
    depth_m = torch.where(
        (depth > 0) & inside, depth.float() * 1e-3, torch.full_like(depth, math.nan, dtype=torch.float32)
    )
    ids = bank.ids[pick].flatten(1).gather(1, flat).view(count, side_px, side_px)
    ids = torch.where(inside, ids, torch.full_like(ids, 255))
    ray_x = (at[..., 0] - lens[:, 2, None, None]) / lens[:, 0, None, None]
    ray_y = (at[..., 1] - lens[:, 3, None, None]) / lens[:, 1, None, None]
    slope = plane[:, 0, None, None] * ray_x + plane[:, 1, None, None] * ray_y + plane[:, 2, None, None]
    # Logs in the window's pixels.
    (m, o), (q, r) = to_source.unbind(1)[0].unbind(1), to_source.unbind(1)[1].unbind(1)
    back = torch.stack([torch.stack([r, -o], 1), torch.stack([-q, m], 1)], 1) / (m * r - o * q)[:, None, None]

    def moved(u: int, v: int) -> torch.Tensor:
        return torch.einsum("bij,bkj->bki", back, logs[..., [u, v]] - middle[:, None]) + 0.5 * (side_px - 1)

    axis = torch.einsum(
        "bij,bkj->bki", back, torch.stack([torch.cos(logs[..., ANGLE]), torch.sin(logs[..., ANGLE])], -1)
    )
    ends = torch.stack([moved(START_U, START_V), moved(END_U, END_V)], 2)
    seen = logs[..., [START_SEEN, END_SEEN]] > 0.5
    return Windows(
        rgb,
        depth_m,
        slope,
        ids,
        plane.norm(dim=1),
        lens[:, 0] * zoom,
        use,
        F.normalize(axis, dim=-1),
        ends,
        seen & there[..., None],
    )


def bank_of(arrays: dict[str, np.ndarray]) -> Bank:
    """Make a bank from numpy arrays of the same names; missing sensor depth is filled in as not sensed."""
    n = len(arrays["ids"])
    made = dict(arrays)
    made.setdefault("sensed", np.zeros(n, bool))
    made.setdefault("sensed_mm", made["depth_mm"])
    made.setdefault("share", np.ones(n, np.float32))
    return Bank(*(torch.from_numpy(np.ascontiguousarray(made[f.name])) for f in fields(Bank)))
