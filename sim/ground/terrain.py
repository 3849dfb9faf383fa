"""The ground: one grid of heights shared by tyres, cameras and Bullet's contacts.

``heights[i, j]`` is the height [m] at (``origin_m[0]`` + i cell, ``origin_m[1]`` + j cell), world frame.  A cell is
two flat triangles that meet on the diagonal from (i + 1, j) to (i, j + 1), exactly as in Bullet's heightfield, so
tyres and logs touch the same surface.  Outside the grid the ground continues at the height of its edge; Bullet's body
ends there.
"""

from __future__ import annotations

import math
import random
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.bullet.client import BulletClient
from sim.errors import PlantError
from sim.geometry import Vector

# -- Ground that is drawn from a seed: a slope, undulation, the ruts of earlier machines, stones and stumps.
#
# Numbers are those of ground on which a forwarder works without trouble: obstacles of 10 to 30 cm, some 6 in 100
# m^2 (Eriksson, Nilsson and Skramo 1978, The Inter-Nordic project of terrain and machines, Acta Forestalia Fennica
# 164, https://doi.org/10.14214/aff.7598, classify ground by such counts), ruts no deeper than 15 cm.  Heights of a
# grid are added to; the grid's middle node is the origin, and a wider grid changes nothing nearer by.


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
    """Extend a periodic grid to at least ``reach_cells`` on every side of its middle.

    Its last row and column equal the first.  A grid that is wide enough is returned as it is.
    """
    period = len(heights) - 1
    half = max(period // 2, math.ceil(reach_cells))
    if half == period // 2:
        return heights
    at = (np.arange(-half, half + 1) + period // 2) % period
    return heights[np.ix_(at, at)]


def drawn_ground(undulation: Heights, cell_m: float, seed: int) -> Heights:
    """Draw rough ground: its undulation in part, slope, ruts, stones and stumps of a seed; height 0 in the middle."""
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
    """Draw the depth [m] of the two ruts of one pass; they run out before the place where the machine stands first."""
    heading, aside_m = rng.uniform(-math.pi, math.pi), rng.uniform(-RUT_PLACE_M, RUT_PLACE_M)
    depth_m = rng.uniform(*RUT_DEPTH_M)
    off = np.abs(np.abs(math.cos(heading) * y - math.sin(heading) * x - aside_m) - RUT_APART_M)
    runs_out = np.clip(np.hypot(x, y) / CLEAR_M - 1.0, 0.0, 1.0)
    depth: Heights = depth_m * runs_out * np.clip(1.0 - (off / RUT_HALF_WIDTH_M) ** 2, 0.0, 1.0)
    return depth


def _obstacles(rng: random.Random, i: int, j: int) -> list[tuple[float, float, float, float]]:
    """Draw the stones and stumps of a block: place, height and radius [m]."""
    obstacles = []
    for count, heights_m, radii_m in (
        (STONES_IN_BLOCK, STONE_HEIGHT_M, STONE_RADIUS_M),
        (STUMPS_IN_BLOCK, STUMP_HEIGHT_M, STUMP_RADIUS_M),
    ):
        for _ in range(rng.randint(*count)):
            x_m, y_m = (i + rng.random()) * BLOCK_M, (j + rng.random()) * BLOCK_M
            height_m, radius_m = rng.uniform(*heights_m), rng.uniform(*radii_m)
            if math.hypot(x_m, y_m) - radius_m > CLEAR_M:
                obstacles.append((x_m, y_m, height_m, radius_m))
    return obstacles


def _raise(heights: Heights, cell_m: float, x_m: float, y_m: float, height_m: float, radius_m: float) -> None:
    """Add a rounded obstacle: a paraboloid over the ground; what lies outside the grid is left out."""
    half, span = len(heights) // 2, math.ceil(radius_m / cell_m)
    i0, j0 = round(x_m / cell_m) + half, round(y_m / cell_m) + half
    for i in range(max(0, i0 - span), min(len(heights), i0 + span + 1)):
        for j in range(max(0, j0 - span), min(len(heights), j0 + span + 1)):
            away = math.hypot((i - half) * cell_m - x_m, (j - half) * cell_m - y_m) / radius_m
            heights[i, j] += height_m * max(0.0, 1.0 - away * away)


# -- The ground


class Soil(NamedTuple):
    """Factors of the tyres' friction and slip stiffness, the addition to their rolling resistance, and to that of logs.

    ``log_rolling_m``: rolling resistance of a log over its weight times its radius, times the radius [m], beyond what
    `sim.truth.body.Contact.log_rolling_m` has for any ground.
    """

    friction: float = 1.0
    stiffness: float = 1.0
    rolling: float = 0.0
    log_rolling_m: float = 0.0


KINDS: Final = ("flat", "rough", "slope", "hill", "mud", "drawn")
SIDE_SLOPE: Final = 0.10  # rise per metre towards +y of kind "slope"
HILL_SLOPE: Final = math.tan(math.radians(10.0))  # of kind "hill"
# A log of 0.25 m that lies 1 cm deep in moss and litter, 2 cm in mud (docs/reference/plant-model.md section 1).
FOREST_FLOOR: Final = Soil(log_rolling_m=0.019)
MUD: Final = Soil(0.5, 0.3, 0.10, 0.026)  # assumed: a wheel pulls at most a third of its load and sinks in
EXTENT_M: Final = 120.0  # least edge of all but rough and drawn
ROUGH_CELL_COUNT: Final = 400
ROUGH_CELL_M: Final = 0.2
# Roughness: standard deviation and smoothing length [m] of each layer; correlation falls to 1/e at twice the length.
ROUGHNESS_LAYERS: Final = ((0.06, 0.75), (0.20, 6.0))
THICKNESS_M: Final = 1.0  # of the box under flat and slope
LOG_FRICTION: Final = 0.8
"""Friction of a log, by which Bullet multiplies the rolling resistance of the ground under it."""


@njit(cache=True)
def surface_height(x: float, y: float, x0: float, y0: float, cell: float, heights: NDArray[np.float64]) -> float:
    """Compute the height [m] of the surface at one point."""
    u = min(max((x - x0) / cell, 0.0), heights.shape[0] - 1.0)
    v = min(max((y - y0) / cell, 0.0), heights.shape[1] - 1.0)
    i, j = min(int(u), heights.shape[0] - 2), min(int(v), heights.shape[1] - 2)
    u, v = u - i, v - j
    along, across = heights[i + 1, j], heights[i, j + 1]
    height: float
    if u + v <= 1.0:
        corner = heights[i, j]
        height = corner + u * (along - corner) + v * (across - corner)
    else:
        corner = heights[i + 1, j + 1]
        height = corner + (1.0 - u) * (across - corner) + (1.0 - v) * (along - corner)
    return height


def _smooth(noise: NDArray[np.float64], length_cells: float) -> NDArray[np.float64]:
    """Filter noise with a Gaussian, to unit standard deviation, wrapped at the edges."""
    f = np.fft.fftfreq(noise.shape[0])
    window = np.exp(-2.0 * (math.pi * length_cells) ** 2 * (f[:, None] ** 2 + f[None, : noise.shape[1] // 2 + 1] ** 2))
    smooth = np.fft.irfft2(np.fft.rfft2(noise) * window, noise.shape)
    normal: NDArray[np.float64] = (smooth - smooth.mean()) / smooth.std()
    return normal


def _rough(seed: int) -> NDArray[np.float64]:
    """Draw the undulation of ROUGHNESS_LAYERS with height 0 in the middle of the grid; exact in single precision."""
    rng = np.random.default_rng(random.Random(f"terrain {seed}").getrandbits(64))
    shape = (ROUGH_CELL_COUNT, ROUGH_CELL_COUNT)
    heights = np.zeros(shape)
    for s, length in ROUGHNESS_LAYERS:
        heights = heights + s * _smooth(rng.standard_normal(shape), length / ROUGH_CELL_M)
    heights = np.vstack([heights, heights[:1]])
    heights = np.hstack([heights, heights[:, :1]])
    heights -= heights[ROUGH_CELL_COUNT // 2, ROUGH_CELL_COUNT // 2]
    return heights.astype(np.float32).astype(np.float64)


class Terrain:
    """Ground of a kind: ``flat`` at ``datum_m``, ``slope`` and the steeper ``hill`` rising to +y, ``mud`` flat and
    slippery, ``rough`` undulating, ``drawn`` with a slope, undulation, ruts, stones and stumps; the last two follow
    ``seed``.  It reaches at least ``reach_m`` from the origin in x and y; a greater reach changes nothing nearer by.

    Raises:
        PlantError: the kind is not one of KINDS.
    """

    def __init__(self, kind: str = "flat", seed: int = 0, datum_m: float = 0.0, reach_m: float = 0.0) -> None:
        if kind not in KINDS:
            raise PlantError("terrain.unknown-kind", f"terrain {kind!r} is unknown; use one of {', '.join(KINDS)}")
        self.kind = kind
        self.colour: Vector = (0.55, 0.60, 0.45)
        self.soil = {"flat": Soil(), "mud": MUD}.get(kind, FOREST_FLOOR)
        if kind in ("rough", "drawn"):
            self.cell_m, heights = ROUGH_CELL_M, extended(_rough(seed), reach_m / ROUGH_CELL_M)
            heights = drawn_ground(heights, ROUGH_CELL_M, seed) if kind == "drawn" else heights
        else:
            rise = {"slope": SIDE_SLOPE, "hill": HILL_SLOPE}.get(kind, 0.0)
            self.cell_m = max(EXTENT_M, 2.0 * reach_m)
            edge = rise * self.cell_m / 2
            heights = np.array([[-edge, edge], [-edge, edge]])
        self.heights: NDArray[np.float64] = np.ascontiguousarray(heights + datum_m)
        half = (self.heights.shape[0] - 1) * self.cell_m / 2
        self.origin_m: tuple[float, float] = (-half, -half)
        self.grid = (*self.origin_m, self.cell_m, self.heights)
        self.body = -1

    @property
    def level(self) -> bool:
        """Whether all of it has one height."""
        return self.kind in ("flat", "mud")

    def height(self, x: float, y: float) -> float:
        """Return the height of the surface [m]."""
        return surface_height(x, y, *self.grid)

    def normal(self, x: float, y: float) -> Vector:
        """Compute the unit normal, upward, of the triangle at a point."""
        x0, y0 = self.origin_m
        last = self.heights.shape[0] - 2
        i, j = (max(0, min(int((at - low) / self.cell_m), last)) for at, low in ((x, x0), (y, y0)))
        h, near = self.heights, (x - x0) + (y - y0) <= (i + j + 1) * self.cell_m
        sx = (h[i + 1, j] - h[i, j] if near else h[i + 1, j + 1] - h[i, j + 1]) / self.cell_m
        sy = (h[i, j + 1] - h[i, j] if near else h[i + 1, j + 1] - h[i + 1, j]) / self.cell_m
        length = math.sqrt(sx * sx + sy * sy + 1.0)
        return (float(-sx / length), float(-sy / length), 1.0 / length)

    def add_to(self, client: BulletClient, friction: float) -> int:
        """Create the fixed body in a client that holds the logs; stores and returns its id."""
        if len(self.heights) > 2:
            low, high = float(self.heights.min()), float(self.heights.max())
            rows, columns = self.heights.shape
            shape = client.createCollisionShape(
                client.GEOM_HEIGHTFIELD,
                meshScale=[self.cell_m, self.cell_m, 1.0],
                heightfieldData=self.heights.ravel(order="F").tolist(),  # x runs fastest
                numHeightfieldRows=rows,
                numHeightfieldColumns=columns,
            )
            # Bullet puts the field's own origin halfway between its lowest and highest point.
            at, turn = [0.0, 0.0, (low + high) / 2], [0.0, 0.0, 0.0, 1.0]
        else:
            normal, middle = self.normal(0.0, 0.0), self.height(0.0, 0.0)
            half = [self.cell_m / 2, self.cell_m / 2 / normal[2], THICKNESS_M / 2]
            shape = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
            at = [-THICKNESS_M / 2 * normal[0], -THICKNESS_M / 2 * normal[1], middle - THICKNESS_M / 2 * normal[2]]
            turn = client.getQuaternionFromEuler([math.atan2(-normal[1], normal[2]), 0.0, 0.0])
        self.body = client.createMultiBody(0.0, shape, basePosition=at, baseOrientation=turn)
        rolling_m = self.soil.log_rolling_m / LOG_FRICTION
        client.changeDynamics(self.body, -1, lateralFriction=friction, rollingFriction=rolling_m)
        # Bullet computes the contacts of two bodies unless both sleep: sleeping ground makes logs at rest cost nothing.
        for state in (client.ACTIVATION_STATE_ENABLE_SLEEPING, client.ACTIVATION_STATE_SLEEP):
            client.changeDynamics(self.body, -1, activationState=state)
        return self.body
