"""Ground that is drawn from a seed: a slope, undulation, the ruts of earlier machines, stones and stumps.

Numbers are those of ground on which a forwarder works without trouble: obstacles of 10 to 30 cm, some 6 in 100 m^2
(Eriksson, Nilsson and Skramo 1978, The Inter-Nordic project of terrain and machines, Acta Forestalia Fennica 164,
https://doi.org/10.14214/aff.7598, classify ground by such counts), ruts no deeper than 15 cm.  Heights of a grid are
added to; the grid's middle node is the origin, and a wider grid changes nothing nearer by.
"""

from __future__ import annotations

import math
import random
from typing import Final

import numpy as np
from numpy.typing import NDArray

Heights = NDArray[np.float64]

MAX_RISE: Final = 0.07
"""Greatest rise per metre of the slope; its direction is drawn."""
UNDULATION: Final = (0.4, 0.9)
"""Share of the undulation of rough ground."""
BLOCK_M: Final = 20.0
"""Stones and stumps are drawn block by block, ..."""
STONES_IN_BLOCK: Final = (4, 10)
STUMPS_IN_BLOCK: Final = (6, 16)
"""... so many in each, least and greatest number."""
STONE_HEIGHT_M: Final = (0.10, 0.25)
STONE_RADIUS_M: Final = (0.30, 0.70)
STUMP_HEIGHT_M: Final = (0.10, 0.20)
STUMP_RADIUS_M: Final = (0.20, 0.30)
RUT_COUNT: Final = (2, 4)
"""Earlier passes, each a pair of ruts."""
RUT_DEPTH_M: Final = (0.05, 0.15)
RUT_HALF_WIDTH_M: Final = 0.35
RUT_APART_M: Final = 1.05
"""Half the distance between the two ruts of a pass: half the track of a forwarder."""
RUT_PLACE_M: Final = 40.0
"""A pass leads by the origin at most this far away."""
CLEAR_M: Final = 4.5
"""No stone, stump or rut is nearer to the origin, where the machine stands first."""


def extended(heights: Heights, reach_cells: float) -> Heights:
    """A periodic grid (last row and column equal the first) with at least ``reach_cells`` on every side of its middle.

    A grid that is wide enough is returned as it is.
    """
    period = len(heights) - 1
    half = max(period // 2, math.ceil(reach_cells))
    if half == period // 2:
        return heights
    at = (np.arange(-half, half + 1) + period // 2) % period
    return heights[np.ix_(at, at)]


def drawn_ground(undulation: Heights, cell_m: float, seed: int) -> Heights:
    """The undulation of rough ground in part, with slope, ruts, stones and stumps of a seed; height 0 in the middle."""
    rng = random.Random(f"drawn ground {seed}")
    half = len(undulation) // 2
    along: Heights = cell_m * (np.arange(len(undulation), dtype=np.float64) - half)
    x, y = along[:, None], along[None, :]
    rise, towards = rng.uniform(0.0, MAX_RISE), rng.uniform(-math.pi, math.pi)
    heights = rng.uniform(*UNDULATION) * undulation + rise * (math.cos(towards) * x + math.sin(towards) * y)
    for _ in range(rng.randint(*RUT_COUNT)):
        heights -= _pass(x, y, rng)
    reach = math.ceil(half * cell_m / BLOCK_M)
    for i in range(-reach, reach):
        for j in range(-reach, reach):
            for x_m, y_m, height_m, radius_m in _obstacles(random.Random(f"obstacles {seed} {i} {j}"), i, j):
                _raise(heights, cell_m, x_m, y_m, height_m, radius_m)
    drawn: Heights = (heights - heights[half, half]).astype(np.float32).astype(np.float64)
    return drawn


def _pass(x: Heights, y: Heights, rng: random.Random) -> Heights:
    """Depth [m] of the pair of ruts of one pass; they run out before the place where the machine stands first."""
    heading, aside_m = rng.uniform(-math.pi, math.pi), rng.uniform(-RUT_PLACE_M, RUT_PLACE_M)
    depth_m = rng.uniform(*RUT_DEPTH_M)
    off = np.abs(np.abs(math.cos(heading) * y - math.sin(heading) * x - aside_m) - RUT_APART_M)
    runs_out = np.clip(np.hypot(x, y) / CLEAR_M - 1.0, 0.0, 1.0)
    depth: Heights = depth_m * runs_out * np.clip(1.0 - (off / RUT_HALF_WIDTH_M) ** 2, 0.0, 1.0)
    return depth


def _obstacles(rng: random.Random, i: int, j: int) -> list[tuple[float, float, float, float]]:
    """Stones and stumps of a block: place, height and radius [m]."""
    found = []
    for count, heights_m, radii_m in (
        (STONES_IN_BLOCK, STONE_HEIGHT_M, STONE_RADIUS_M),
        (STUMPS_IN_BLOCK, STUMP_HEIGHT_M, STUMP_RADIUS_M),
    ):
        for _ in range(rng.randint(*count)):
            x_m, y_m = (i + rng.random()) * BLOCK_M, (j + rng.random()) * BLOCK_M
            height_m, radius_m = rng.uniform(*heights_m), rng.uniform(*radii_m)
            if math.hypot(x_m, y_m) - radius_m > CLEAR_M:
                found.append((x_m, y_m, height_m, radius_m))
    return found


def _raise(heights: Heights, cell_m: float, x_m: float, y_m: float, height_m: float, radius_m: float) -> None:
    """Add a rounded obstacle: a paraboloid over the ground; what lies outside the grid is left out."""
    half, span = len(heights) // 2, math.ceil(radius_m / cell_m)
    i0, j0 = round(x_m / cell_m) + half, round(y_m / cell_m) + half
    for i in range(max(0, i0 - span), min(len(heights), i0 + span + 1)):
        for j in range(max(0, j0 - span), min(len(heights), j0 + span + 1)):
            away = math.hypot((i - half) * cell_m - x_m, (j - half) * cell_m - y_m) / radius_m
            heights[i, j] += height_m * max(0.0, 1.0 - away * away)
