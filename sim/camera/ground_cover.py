"""Grass and fallen branches, scattered by a seed: they hide logs in a forest and litter a landing.

The ground is tiled in squares that each draw from their own seed, so a tuft stands at the same place from wherever
the camera comes.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from sim.camera.scene import GRASS, TWIG, Ground, Rods, SceneBuilder

TILE_M: Final = 4.0
BLADE_COUNT_RANGE: Final = (5, 9)  # of a tuft


@dataclass(frozen=True, slots=True)
class Density:
    """Tufts of grass and branches per square metre."""

    tufts_m2: float
    branches_m2: float


BARE, LANDING, CLEARING = Density(0.0, 0.0), Density(0.0, 0.04), Density(0.25, 0.10)


def _blade(b: SceneBuilder, rng: random.Random, x: float, y: float) -> None:
    z, height_m, direction_rad = b.ground.height(x, y), rng.uniform(0.10, 0.42), rng.uniform(-math.pi, math.pi)
    lean = height_m * rng.uniform(0.1, 0.8)
    dx, dy = lean * math.cos(direction_rad), lean * math.sin(direction_rad)
    points = [(x, y, z - 0.02), (x + 0.3 * dx, y + 0.3 * dy, z + 0.6 * height_m), (x + dx, y + dy, z + height_m)]
    dry = rng.random()
    tint = (88 + 80 * dry, 112 + 40 * dry, 48 + 38 * dry)
    b.rod(np.array(points), (0.004, 0.003, 0.001), GRASS, tint)


def _branch(b: SceneBuilder, rng: random.Random, x: float, y: float) -> None:
    direction_rad, thick = rng.uniform(-math.pi, math.pi), rng.uniform(0.006, 0.02)
    tint = [c * rng.uniform(0.8, 1.2) for c in (104, 82, 62)]
    points, step = [], rng.uniform(0.12, 0.35)
    for _ in range(5):
        points.append((x, y, b.ground.height(x, y) + thick + rng.uniform(0.0, 0.08)))
        direction_rad += rng.uniform(-0.35, 0.35)
        x, y = x + step * math.cos(direction_rad), y + step * math.sin(direction_rad)
    b.rod(np.array(points), [thick * f for f in (1.0, 0.85, 0.7, 0.5, 0.25)], TWIG, tint)
    for i in (1, 2, 3):
        if rng.random() < 0.7:
            px, py, pz = points[i]
            side, reach = direction_rad + rng.choice((-0.9, 0.9)), rng.uniform(0.1, 0.35)
            tip = (px + reach * math.cos(side), py + reach * math.sin(side), pz + rng.uniform(0.0, 0.15))
            b.rod(np.array([points[i], tip]), (0.4 * thick, 0.15 * thick), TWIG, tint)


def _some(rng: random.Random, mean: float) -> int:
    """Draw a random whole number whose mean is ``mean``."""
    return int(mean) + (rng.random() < mean % 1.0)


class GroundCover:
    """The ground cover of one site."""

    def __init__(self, ground: Ground, density: Density, seed: int) -> None:
        self._ground, self._density, self._seed = ground, density, seed
        self._tile = lru_cache(maxsize=400)(self._made)

    def around(self, x_m: float, y_m: float, reach_m: float = 8.0) -> Rods:
        """Return all rods on the tiles within ``reach_m`` of a place."""
        rods = SceneBuilder(self._ground).build().rods
        i0, i1 = math.floor((x_m - reach_m) / TILE_M), math.floor((x_m + reach_m) / TILE_M)
        j0, j1 = math.floor((y_m - reach_m) / TILE_M), math.floor((y_m + reach_m) / TILE_M)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                rods = rods + self._tile(i, j)
        return rods

    def _made(self, i: int, j: int) -> Rods:
        rng, b = random.Random(f"clutter {self._seed} {i} {j}"), SceneBuilder(self._ground)
        area = TILE_M * TILE_M
        for _ in range(_some(rng, area * self._density.tufts_m2)):
            x, y = (i + rng.random()) * TILE_M, (j + rng.random()) * TILE_M
            for _ in range(rng.randint(*BLADE_COUNT_RANGE)):
                _blade(b, rng, x + rng.gauss(0.0, 0.05), y + rng.gauss(0.0, 0.05))
        for _ in range(_some(rng, area * self._density.branches_m2)):
            _branch(b, rng, (i + rng.random()) * TILE_M, (j + rng.random()) * TILE_M)
        return b.build().rods
