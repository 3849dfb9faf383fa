"""Second pass: depth, instance and colour of every pixel from its surface code and inverse depth."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim.camera.scene import BARK, GROUND, SKY, TWIG
from sim.camera.shadow import BLOCK_BITS, MAP_PX
from sim.camera.textures import (
    BARK_LENGTH_M,
    BARK_PX,
    END_PX,
    GROUND_PX,
    GROUND_TEXEL_M,
    HORIZON_PX,
    HORIZON_RAD,
    MIP_LEVEL_COUNT,
    PATCH_PX,
    PATCH_TEXEL_M,
)
from sim.camera.visibility import FIRST_ROD, GROUND_CODE, SKY_CODE

GRAIN_PX = 256
_FAR = float(1 << 20)  # makes a texel's index positive before it is truncated
_BARK_REPEAT = BARK_PX / BARK_LENGTH_M
_TURN = BARK_PX / (2.0 * math.pi)
_GROUND_MASK, _BARK_MASK, _PATCH_MASK, _GRAIN_MASK = GROUND_PX - 1, BARK_PX - 1, PATCH_PX - 1, GRAIN_PX - 1


@njit(cache=True, fastmath=True)
def angle_of(y: float, x: float) -> float:
    """Compute atan2 to 0.005 rad: enough to look up a texture."""
    ax, ay = abs(x), abs(y)
    big = max(ax, ay)
    if big == 0.0:
        return 0.0
    a = min(ax, ay) / big
    r = a * (0.7853981 + 0.273 * (1.0 - a))
    if ay > ax:
        r = 1.5707963 - r
    if x < 0.0:
        r = 3.1415927 - r
    return -r if y < 0.0 else r


@njit(cache=True, fastmath=True)
def _byte(x: float) -> np.uint8:
    x = x if x > 0.0 else 0.0
    return np.uint8(np.int32(x if x < 255.0 else 255.0))


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def shade(
    inverse: np.ndarray,
    code: np.ndarray,
    eye: np.ndarray,
    rotation: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    ends: np.ndarray,
    radii: np.ndarray,
    side: np.ndarray,
    along: np.ndarray,
    surface: np.ndarray,
    tint: np.ndarray,
    rod_instance: np.ndarray,
    centres: np.ndarray,
    axes: np.ndarray,
    halves: np.ndarray,
    colours: np.ndarray,
    box_instance: np.ndarray,
    heights: np.ndarray,
    x0: float,
    y0: float,
    cell: float,
    ground: np.ndarray,
    patch: np.ndarray,
    bark: np.ndarray,
    end_grain: np.ndarray,
    horizon: np.ndarray,
    grain: np.ndarray,
    grain_gain: float,
    grain_row: int,
    grain_column: int,
    sun: np.ndarray,
    sun_light: np.ndarray,
    sky_light: np.ndarray,
    shadows: np.ndarray,
    shaded: np.ndarray,
    shadow_x0: float,
    shadow_y0: float,
    shadow_cell: float,
    rgb: np.ndarray,
    depth: np.ndarray,
    mask: np.ndarray,
) -> None:
    """Fill rgb, depth, mask.

    ``sun`` is the unit vector towards the sun; ``sun_light``, ``sky_light`` (3,) are gains of the textures; poses are
    in the world; the other arguments are described where they are made.
    """
    height, width = inverse.shape
    rods = ends.shape[0]
    first_box = FIRST_ROD + 3 * rods
    kx, ky = sun[0] / sun[2], sun[1] / sun[2]
    level_gain = fx * GROUND_TEXEL_M
    flat, per_m = heights.shape[0] == 2, 1.0 / cell
    last_i, last_j = heights.shape[0] - 1.001, heights.shape[1] - 1.001
    ux = (heights[1, 0] - heights[0, 0]) / cell
    uy = (heights[0, 1] - heights[0, 0]) / cell
    un = 1.0 / math.sqrt(ux * ux + uy * uy + 1.0)
    for row in range(height):
        v = (row - cy) / fy
        rx, ry, rz = (
            rotation[0, 1] * v + rotation[0, 2],
            rotation[1, 1] * v + rotation[1, 2],
            rotation[2, 1] * v + rotation[2, 2],
        )
        g_row = grain[(row + grain_row) & _GRAIN_MASK]
        level = -1
        for x in range(width):
            u = (x - cx) / fx
            dx, dy, dz = rx + rotation[0, 0] * u, ry + rotation[1, 0] * u, rz + rotation[2, 0] * u
            this = code[row, x]
            if this == SKY_CODE:
                depth[row, x] = np.nan
                mask[row, x] = SKY
                flatly = math.sqrt(dx * dx + dy * dy)
                up = min(max(int(dz / flatly * (HORIZON_PX[0] / HORIZON_RAD)), 0), HORIZON_PX[0] - 1)
                turn = int((angle_of(dy, dx) + math.pi) * (HORIZON_PX[1] / (2.0 * math.pi))) & (HORIZON_PX[1] - 1)
                for k in range(3):
                    rgb[row, x, k] = _byte(horizon[up, turn, k] * (sky_light[k] + 0.45 * sun_light[k]))
                continue
            z = 1.0 / inverse[row, x]
            depth[row, x] = z
            px, py, pz = eye[0] + dx * z, eye[1] + dy * z, eye[2] + dz * z
            jitter = g_row[(x + grain_column) & _GRAIN_MASK]
            g = grain_gain * jitter
            if this == GROUND_CODE:
                mask[row, x] = GROUND
                tx, ty = px * (1.0 / GROUND_TEXEL_M), py * (1.0 / GROUND_TEXEL_M)
                if x & 7 == 0 or level < 0:  # neighbours share a level
                    level, foot = 0, 1.5 * z / level_gain
                    while foot > 1.4 and level < MIP_LEVEL_COUNT - 1:
                        foot *= 0.5
                        level += 1
                shrink = 1.0 / (1 << level)
                i = int(tx * shrink + _FAR) & (_GROUND_MASK >> level)
                j = int(ty * shrink + _FAR) & (_GROUND_MASK >> level)
                texel = ground[level, i, j]
                other = patch[
                    int(px * (1.0 / PATCH_TEXEL_M) + 0.1 * jitter + _FAR) & _PATCH_MASK,
                    int(py * (1.0 / PATCH_TEXEL_M) - 0.1 * jitter + _FAR) & _PATCH_MASK,
                ] * (1.0 / 255.0)
                c0 = texel[0] * (1.0 - other) + texel[3] * other
                c1 = texel[1] * (1.0 - other) + texel[4] * other
                c2 = texel[2] * (1.0 - other) + texel[5] * other
                if flat:
                    nx, ny, nz = -ux * un, -uy * un, un
                else:
                    a = min(max((px - x0) * per_m, 0.0), last_i)
                    b = min(max((py - y0) * per_m, 0.0), last_j)
                    i, j = int(a), int(b)
                    a, b = a - i, b - j
                    h00, h10, h01, h11 = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
                    nx = -((h10 - h00) * (1.0 - b) + (h11 - h01) * b) * per_m
                    ny = -((h01 - h00) * (1.0 - a) + (h11 - h10) * a) * per_m
                    n = 1.0 / math.sqrt(nx * nx + ny * ny + 1.0)
                    nx, ny, nz = nx * n, ny * n, n
            elif this < first_box:
                i, part = (this - FIRST_ROD) // 3, (this - FIRST_ROD) % 3
                mask[row, x] = rod_instance[i]
                ax, ay, az = ends[i, 0, 0], ends[i, 0, 1], ends[i, 0, 2]
                wx, wy, wz = ends[i, 1, 0] - ax, ends[i, 1, 1] - ay, ends[i, 1, 2] - az
                length = math.sqrt(wx * wx + wy * wy + wz * wz)
                wx, wy, wz = wx / length, wy / length, wz / length
                qx, qy, qz = px - ax, py - ay, pz - az
                h = qx * wx + qy * wy + qz * wz
                nx, ny, nz = qx - h * wx, qy - h * wy, qz - h * wz
                n = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
                if surface[i] != BARK:
                    nx, ny, nz = nx * n, ny * n, nz * n
                    fleck = 1.0 + 0.3 * math.sin(h * 170.0) if surface[i] == TWIG else 0.75 + 0.5 * h / length
                    c0, c1, c2 = tint[i, 0] * fleck, tint[i, 1] * fleck, tint[i, 2] * fleck
                else:
                    sx, sy, sz = side[i, 0], side[i, 1], side[i, 2]
                    a = nx * sx + ny * sy + nz * sz
                    b = nx * (wy * sz - wz * sy) + ny * (wz * sx - wx * sz) + nz * (wx * sy - wy * sx)
                    if part == 0:
                        j = int((along[i] + h) * _BARK_REPEAT + _FAR) & _BARK_MASK
                        k = int((angle_of(b, a) + math.pi) * _TURN) & _BARK_MASK
                        c0, c1, c2 = bark[j, k, 0] * tint[i, 0], bark[j, k, 1] * tint[i, 1], bark[j, k, 2] * tint[i, 2]
                        nx, ny, nz = nx * n, ny * n, nz * n
                    else:
                        grow = 0.5 * END_PX / radii[i, part - 1]
                        j = min(max(int(a * grow + 0.5 * END_PX), 0), END_PX - 1)
                        k = min(max(int(b * grow + 0.5 * END_PX), 0), END_PX - 1)
                        c0, c1, c2 = end_grain[j, k, 0] * 1.0, end_grain[j, k, 1] * 1.0, end_grain[j, k, 2] * 1.0
                        facing = -1.0 if part == 1 else 1.0
                        nx, ny, nz = wx * facing, wy * facing, wz * facing
            else:
                i, face = (this - first_box) // 6, (this - first_box) % 6
                mask[row, x] = box_instance[i]
                k = face // 2
                facing = 1.0 - 2.0 * (face % 2)
                nx, ny, nz = axes[i, 0, k] * facing, axes[i, 1, k] * facing, axes[i, 2, k] * facing
                qx, qy, qz = px - centres[i, 0], py - centres[i, 1], pz - centres[i, 2]
                a = qx * axes[i, 0, 0] + qy * axes[i, 1, 0] + qz * axes[i, 2, 0]
                b = qx * axes[i, 0, 1] + qy * axes[i, 1, 1] + qz * axes[i, 2, 1]
                c = qx * axes[i, 0, 2] + qy * axes[i, 1, 2] + qz * axes[i, 2, 2]
                dirt = patch[
                    int((a + 0.7 * c) * 60.0 + _FAR) & _PATCH_MASK, int((b + 0.4 * c) * 60.0 + _FAR) & _PATCH_MASK
                ]
                worn = 1.0 - 0.0005 * dirt
                # A worn rim a centimetre wide separates one box from the next.
                rim = 0
                rim += abs(a) > halves[i, 0] - 0.012
                rim += abs(b) > halves[i, 1] - 0.012
                rim += abs(c) > halves[i, 2] - 0.012
                if rim > 1:
                    worn *= 0.72
                c0, c1, c2 = colours[i, 0] * 255.0 * worn, colours[i, 1] * 255.0 * worn, colours[i, 2] * 255.0 * worn
            lit = nx * sun[0] + ny * sun[1] + nz * sun[2]
            if lit > 0.0:
                i = int((py - pz * ky - shadow_y0) / shadow_cell + 0.5 + 0.6 * jitter)
                j = int((px - pz * kx - shadow_x0) / shadow_cell + 0.5 - 0.4 * jitter)
                if 0 <= i < MAP_PX and 0 <= j < MAP_PX and shaded[i >> BLOCK_BITS, j >> BLOCK_BITS]:
                    lit = 0.0 if shadows[i, j] > pz + 0.01 else lit
            else:
                lit = 0.0
            sky = 0.62 + 0.38 * nz
            rgb[row, x, 0] = _byte(c0 * (sky_light[0] * sky + sun_light[0] * lit) + g)
            rgb[row, x, 1] = _byte(c1 * (sky_light[1] * sky + sun_light[1] * lit) + g)
            rgb[row, x, 2] = _byte(c2 * (sky_light[2] * sky + sun_light[2] * lit) + g)
