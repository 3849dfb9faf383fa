"""The analytic renderer: a scene and a view in, colour, depth and instances out.  Exact; `sim.camera.noise` adds noise.

Equal inputs give equal bytes on one machine and build.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, fields
from functools import cache

import numpy as np

from sim.camera.geometry import View
from sim.camera.ground_visibility import draw_grid, draw_plane
from sim.camera.scene import BARK, Boxes, Rods, Scene, SceneBuilder
from sim.camera.shading import GRAIN_PX, shade
from sim.camera.shadow import MAP_PX, shadow_map
from sim.camera.textures import textures
from sim.camera.visibility import SKY_CODE, draw_objects

NEAREST_PLANE_M = 0.05  # least height above the plane beyond the grid at which it is drawn
SHADOW_EDGE_M = 12.0  # edge length of the square with shadows
FINE_GRID_REACH_M, COARSE_STRIDE, GROUND_REACH_M = (
    21.0,
    4,
    60.0,
)  # heights are drawn in full this near, every 4th point beyond


@dataclass(frozen=True, slots=True)
class Picture:
    """rgb (H, W, 3) uint8; depth_m (H, W) float32, optical z, NaN in the sky; mask (H, W) int16, instance ids."""

    rgb: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True, slots=True)
class ImagingConditions:
    """Light and lens: unit vector towards the sun, gains of sun and sky, white balance, sensor grain, surfaces."""

    sun: tuple[float, float, float] = (0.43, -0.35, 0.83)
    sun_gain: float = 0.72
    sky_gain: float = 0.45
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    grain: float = 2.5
    surfaces: int = 0

    @classmethod
    def random(cls, seed: int) -> ImagingConditions:
        """Conditions drawn from ``seed``: sun 20..70 degrees high, clear to overcast, exposure, white balance."""
        rng = random.Random(f"look {seed}")
        azimuth, height = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(20.0, 70.0))
        clear, exposure = rng.uniform(0.0, 1.0), rng.uniform(0.75, 1.25)
        flat = math.cos(height)
        return cls(
            (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(height)),
            exposure * 0.95 * clear,
            exposure * (0.80 - 0.42 * clear),
            (rng.uniform(0.90, 1.10), 1.0, rng.uniform(0.88, 1.12)),
            rng.uniform(1.0, 5.0),
            rng.getrandbits(16),
        )


@cache
def _grain() -> np.ndarray:
    return np.random.default_rng(7).standard_normal((GRAIN_PX, GRAIN_PX)).astype(np.float32)


def render(scene: Scene, view: View, conditions: ImagingConditions = ImagingConditions(), frame: int = 0) -> Picture:
    """The picture of an ideal camera at ``view``.  ``frame`` changes the sensor's grain only."""
    pin, eye, turn = view.intrinsics, view.position_m, np.ascontiguousarray(view.rotation)
    lens: tuple[float, float, float, float] = (pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px)
    rods, boxes, ground = scene.rods, scene.boxes, scene.ground
    inverse, code = _blank(view)
    grid = (ground.x0_m, ground.y0_m, ground.cell_m, ground.heights_m)
    if ground.heights_m.size > 4:
        draw_grid(inverse, code, *grid, COARSE_STRIDE, FINE_GRID_REACH_M - 1.0, GROUND_REACH_M, eye, turn, *lens)
        draw_grid(inverse, code, *grid, 1, 0.0, FINE_GRID_REACH_M, eye, turn, *lens)
    else:
        draw_grid(inverse, code, *grid, 1, 0.0, 2.0 * ground.cell_m, eye, turn, *lens)
    below = float(eye[2]) - ground.mean_m
    if below > NEAREST_PLANE_M:
        draw_plane(inverse, code, turn[2], below, *lens)
    _draw(inverse, code, view, rods, boxes)
    ends = np.stack([rods.start_m, rods.end_m], axis=1)
    radii = np.stack([rods.radius_start_m, rods.radius_end_m], axis=1)

    kinds = textures(scene.style, conditions.surfaces)
    white, sun = np.asarray(conditions.white_balance), np.asarray(conditions.sun)
    cell = SHADOW_EDGE_M / MAP_PX
    x0, y0 = _middle(scene, view) - SHADOW_EDGE_M / 2 - ground.mean_m * sun[:2] / sun[2]
    casts = rods.surface == BARK  # blades and twigs are thinner than a cell
    shadows = shadow_map(ends[casts], radii[casts], boxes.centre_m, boxes.axes, boxes.half_m, sun, x0, y0, cell)
    shape = inverse.shape
    picture = Picture(np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32), np.empty(shape, np.int16))
    where = random.Random(f"grain {frame}")
    shade(
        inverse, code, eye, turn, *lens,
        ends, radii, rods.side, rods.along_m, rods.surface, rods.tint, rods.instance,
        boxes.centre_m, boxes.axes, boxes.half_m, boxes.colour, boxes.instance,
        ground.heights_m, *grid[:3],
        kinds.ground, kinds.patch, kinds.bark, kinds.end, kinds.horizon,
        _grain(), conditions.grain, where.getrandbits(8), where.getrandbits(8),
        sun, conditions.sun_gain * white, conditions.sky_gain * white, *shadows, x0, y0, cell,
        picture.rgb, picture.depth_m, picture.mask,
    )  # fmt: skip
    return picture


def surfaces_of(scene: Scene, view: View, instance: int) -> np.ndarray:
    """The pixels (H, W) bool of an instance's rods if nothing else were there."""
    inverse, code = _blank(view)
    own = scene.rods.instance == instance
    rods = Rods(*(getattr(scene.rods, f.name)[own] for f in fields(Rods)))
    _draw(inverse, code, view, rods, SceneBuilder(scene.ground).build().boxes)
    seen: np.ndarray = code != SKY_CODE
    return seen


def _blank(view: View) -> tuple[np.ndarray, np.ndarray]:
    shape = (view.intrinsics.height_px, view.intrinsics.width_px)
    return np.zeros(shape, np.float32), np.full(shape, SKY_CODE, np.int32)


def _draw(inverse: np.ndarray, code: np.ndarray, view: View, rods: Rods, boxes: Boxes) -> None:
    pin, eye, turn = view.intrinsics, view.position_m, view.rotation
    ends = np.stack([rods.start_m, rods.end_m], axis=1)
    normals = np.stack([rods.normal_start, rods.normal_end], axis=1) @ turn
    radii = np.stack([rods.radius_start_m, rods.radius_end_m], axis=1)
    axes = np.ascontiguousarray(turn.T @ boxes.axes)
    draw_objects(
        inverse, code, (ends - eye) @ turn, radii, normals, rods.caps,
        (boxes.centre_m - eye) @ turn, axes, boxes.half_m, pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px,
    )  # fmt: skip


def _middle(scene: Scene, view: View) -> np.ndarray:
    """Middle (x, y) of the shaded square: four to eight metres ahead in the viewing direction."""
    forward = view.rotation[:, 2]
    fall = (float(view.position_m[2]) - scene.ground.mean_m) / max(1e-3, -float(forward[2]))
    reach = min(max(fall, 0.0), 8.0) if forward[2] < 0.0 else 6.0
    return (view.position_m + forward * reach)[:2]
