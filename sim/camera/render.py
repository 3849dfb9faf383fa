"""The analytic renderer: a scene and a view in, colour, depth and instances out.  Exact; `sim.camera.noise` adds noise.

Equal inputs give equal bytes on one machine and build.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
from numba import njit

from sim.camera.geometry import View
from sim.camera.scene import BARK, Boxes, Rods, Scene, SceneBuilder
from sim.camera.shading import GRAIN_PX, shade
from sim.camera.shadow import MAP_PX, shadow_map
from sim.camera.textures import textures
from sim.camera.visibility import GROUND_CODE, NEAR_M, SKY_CODE, draw_objects

# -- First pass of the ground: which pixels see it, and their inverse depth; buffers and codes as in `visibility`.


@njit(cache=True)
def _draw_triangle(
    inverse: np.ndarray,
    code: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    r: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    px: np.ndarray,
    py: np.ndarray,
) -> None:
    """Draw a triangle of the ground in the optical frame."""
    height, width = inverse.shape
    ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    away = nx * p[0] + ny * p[1] + nz * p[2]
    if abs(away) < 1e-12:
        return
    count = 0
    for i in range(3):
        a = p if i == 0 else (q if i == 1 else r)
        b = q if i == 0 else (r if i == 1 else p)
        if a[2] >= NEAR_M:
            px[count], py[count] = a[0] / a[2] * fx + cx, a[1] / a[2] * fy + cy
            count += 1
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            f = (NEAR_M - a[2]) / (b[2] - a[2])
            px[count] = (a[0] + f * (b[0] - a[0])) / NEAR_M * fx + cx
            py[count] = (a[1] + f * (b[1] - a[1])) / NEAR_M * fy + cy
            count += 1
    if count < 3:
        return
    top, bottom, left, right = 1e9, -1e9, 1e9, -1e9
    for i in range(count):
        top, bottom, left, right = min(top, py[i]), max(bottom, py[i]), min(left, px[i]), max(right, px[i])
    if right < 0.0 or left > width - 1.0:
        return
    su, sv = nx / away / fx, ny / away / fy
    s1 = nz / away - su * cx - sv * cy
    for row in range(max(0, math.ceil(top)), min(height - 1, math.floor(bottom)) + 1):
        low, high = 1e9, -1e9
        for i in range(count):
            j = i + 1 if i + 1 < count else 0
            ya, yb = py[i], py[j]
            if min(ya, yb) <= row <= max(ya, yb):
                if ya == yb:
                    low, high = min(low, min(px[i], px[j])), max(high, max(px[i], px[j]))
                else:
                    x = px[i] + (row - ya) / (yb - ya) * (px[j] - px[i])
                    low, high = min(low, x), max(high, x)
        s_row = s1 + sv * row
        for x in range(max(0, math.ceil(low)), min(width - 1, math.floor(high)) + 1):
            s = s_row + su * x
            if s > inverse[row, x]:
                inverse[row, x] = s
                code[row, x] = GROUND_CODE


@njit(cache=True)
def draw_grid(
    inverse: np.ndarray,
    code: np.ndarray,
    x0: float,
    y0: float,
    cell: float,
    heights: np.ndarray,
    stride: int,
    nearest: float,
    furthest: float,
    eye: np.ndarray,
    rotation: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> None:
    """Draw the height grid at every ``stride``-th point, two triangles per cell.

    Only cells whose middle is between ``nearest`` and ``furthest`` metres from the camera are drawn.
    """
    width = inverse.shape[1]
    span = cell * stride
    last_i, last_j = (heights.shape[0] - 1) // stride, (heights.shape[1] - 1) // stride
    i0, i1 = int((eye[0] - furthest - x0) / span), int((eye[0] + furthest - x0) / span) + 1
    j0, j1 = int((eye[1] - furthest - y0) / span), int((eye[1] + furthest - y0) / span) + 1
    i0, i1, j0, j1 = max(0, i0), min(last_i, i1), max(0, j0), min(last_j, j1)
    if i1 <= i0 or j1 <= j0:
        return
    row_points = np.empty((2, j1 - j0 + 1, 3))
    px, py = np.empty(4), np.empty(4)
    left, right = -(cx + 1.0) / fx, (width + 1.0 - cx) / fx
    for i in range(i0, i1 + 1):
        current_row, previous_row = row_points[i & 1], row_points[1 - (i & 1)]
        for j in range(j0, j1 + 1):
            x, y = x0 + i * span - eye[0], y0 + j * span - eye[1]
            z = heights[i * stride, j * stride] - eye[2]
            for k in range(3):
                current_row[j - j0, k] = x * rotation[0, k] + y * rotation[1, k] + z * rotation[2, k]
        if i == i0:
            continue
        for j in range(j1 - j0):
            a, b, c, d = previous_row[j], previous_row[j + 1], current_row[j], current_row[j + 1]
            if max(max(a[2], b[2]), max(c[2], d[2])) < NEAR_M:
                continue
            if min(min(a[0] - right * a[2], b[0] - right * b[2]), min(c[0] - right * c[2], d[0] - right * d[2])) > 0.0:
                continue
            if max(max(a[0] - left * a[2], b[0] - left * b[2]), max(c[0] - left * c[2], d[0] - left * d[2])) < 0.0:
                continue
            away = math.hypot(x0 + (i - 0.5) * span - eye[0], y0 + (j + j0 + 0.5) * span - eye[1])
            if away < nearest or away > furthest:
                continue
            _draw_triangle(inverse, code, a, c, b, fx, fy, cx, cy, px, py)
            _draw_triangle(inverse, code, c, d, b, fx, fy, cx, cy, px, py)


@njit(cache=True)
def draw_plane(
    inverse: np.ndarray,
    code: np.ndarray,
    up: np.ndarray,
    below: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> None:
    """Draw the level ground ``below`` metres under the camera where nothing is drawn; ``up`` in the optical frame."""
    height, width = inverse.shape
    su, sv = -up[0] / below / fx, -up[1] / below / fy
    for row in range(height):
        s_row = -up[2] / below - su * cx + sv * (row - cy)
        for x in range(width):
            s = s_row + su * x
            if code[row, x] == SKY_CODE and s > 1e-4:
                inverse[row, x] = s
                code[row, x] = GROUND_CODE


# -- The analytic renderer


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
        """Draw conditions from ``seed``: sun 20..70 degrees high, clear to overcast, exposure, white balance."""
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
    """Render the picture of an ideal camera at ``view``.  ``frame`` changes the sensor's grain only."""
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
        inverse,
        code,
        eye,
        turn,
        *lens,
        ends,
        radii,
        rods.side,
        rods.along_m,
        rods.surface,
        rods.tint,
        rods.instance,
        boxes.centre_m,
        boxes.axes,
        boxes.half_m,
        boxes.colour,
        boxes.instance,
        ground.heights_m,
        *grid[:3],
        kinds.ground,
        kinds.patch,
        kinds.bark,
        kinds.end,
        kinds.horizon,
        _grain(),
        conditions.grain,
        where.getrandbits(8),
        where.getrandbits(8),
        sun,
        conditions.sun_gain * white,
        conditions.sky_gain * white,
        *shadows,
        x0,
        y0,
        cell,
        picture.rgb,
        picture.depth_m,
        picture.mask,
    )
    return picture


def surfaces_of(scene: Scene, view: View, instance: int) -> np.ndarray:
    """Find the pixels (H, W) bool of an instance's rods if nothing else were there."""
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
        inverse,
        code,
        (ends - eye) @ turn,
        radii,
        normals,
        rods.caps,
        (boxes.centre_m - eye) @ turn,
        axes,
        boxes.half_m,
        pin.fx_px,
        pin.fy_px,
        pin.cx_px,
        pin.cy_px,
    )


def _middle(scene: Scene, view: View) -> np.ndarray:
    """Find the middle (x, y) of the shaded square: four to eight metres ahead in the viewing direction."""
    forward = view.rotation[:, 2]
    fall = (float(view.position_m[2]) - scene.ground.mean_m) / max(1e-3, -float(forward[2]))
    reach = min(max(fall, 0.0), 8.0) if forward[2] < 0.0 else 6.0
    return (view.position_m + forward * reach)[:2]
