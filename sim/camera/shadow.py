"""A shadow map: for every ray of sunlight the height at which it is blocked.

A point (x, y, z) lies on the ray (x - z kx, y - z ky) with k = the sun's horizontal over its vertical part.  Rods
store the height of their axis and boxes that of their middle, so no lit surface shadows itself.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

MAP_PX = 1024
BLOCK_BITS = 4  # the map is stored in blocks of 16 cells; blocks without any shadow are never written
LOWEST_M = -1e6


@njit(cache=True)
def _span(ax: float, ay: float, bx: float, by: float, low: np.ndarray, high: np.ndarray) -> None:
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    slope = (bx - ax) / (by - ay) if by - ay > 1e-9 else 0.0
    for row in range(max(0, math.ceil(ay)), min(MAP_PX - 1, math.floor(by)) + 1):
        x = ax + slope * (row - ay)
        low[row], high[row] = min(low[row], x), max(high[row], x)


@njit(cache=True)
def _touch(out: np.ndarray, used: np.ndarray, row: int, first: int, last: int) -> None:
    """Clear the blocks of a row's cells at their first use."""
    i = row >> BLOCK_BITS
    for j in range(first >> BLOCK_BITS, (last >> BLOCK_BITS) + 1):
        if not used[i, j]:
            used[i, j] = True
            size = 1 << BLOCK_BITS
            out[i * size : (i + 1) * size, j * size : (j + 1) * size] = np.float32(LOWEST_M)


@njit(cache=True)
def shadow_map(
    ends: np.ndarray,
    radii: np.ndarray,
    centres: np.ndarray,
    axes: np.ndarray,
    halves: np.ndarray,
    sun: np.ndarray,
    x0: float,
    y0: float,
    cell: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Map the heights (MAP_PX, MAP_PX) of rods ends (S, 2, 3), radii (S, 2) and boxes in the world frame.

    (x0, y0) is the ray of cell 0.  Returns the map and which of its blocks are used; in those, cells without shadow
    hold LOWEST_M.
    """
    out = np.empty((MAP_PX, MAP_PX), np.float32)
    used = np.zeros((MAP_PX >> BLOCK_BITS, MAP_PX >> BLOCK_BITS), np.bool_)
    kx, ky = sun[0] / sun[2], sun[1] / sun[2]
    low, high = np.empty(MAP_PX), np.empty(MAP_PX)
    px, py = np.empty(8), np.empty(8)
    for i in range(ends.shape[0]):
        a, b = ends[i, 0], ends[i, 1]
        sx, sy = (a[0] - a[2] * kx - x0) / cell, (a[1] - a[2] * ky - y0) / cell
        ex, ey = (b[0] - b[2] * kx - x0) / cell, (b[1] - b[2] * ky - y0) / cell
        wx, wy, wz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        qx, qy, qz = wy * sun[2] - wz * sun[1], wz * sun[0] - wx * sun[2], wx * sun[1] - wy * sun[0]
        n = math.sqrt(qx * qx + qy * qy + qz * qz)
        if n < 1e-6:
            continue
        qx, qy = (qx - qz * kx) / n / cell, (qy - qz * ky) / n / cell
        r0, r1 = radii[i, 0], radii[i, 1]
        px[0], py[0], px[1], py[1] = sx + r0 * qx, sy + r0 * qy, ex + r1 * qx, ey + r1 * qy
        px[2], py[2], px[3], py[3] = ex - r1 * qx, ey - r1 * qy, sx - r0 * qx, sy - r0 * qy
        top, bottom = max(0, math.ceil(py[:4].min())), min(MAP_PX - 1, math.floor(py[:4].max()))
        if bottom < top or px[:4].max() < 0.0 or px[:4].min() > MAP_PX:
            continue
        low[top : bottom + 1], high[top : bottom + 1] = 1e9, -1e9
        for e in range(4):
            f = (e + 1) % 4
            _span(px[e], py[e], px[f], py[f], low, high)
        dx, dy = ex - sx, ey - sy
        det = dx * qy - dy * qx
        if abs(det) < 1e-12:
            continue
        for row in range(top, bottom + 1):
            first, last = max(0, math.ceil(low[row])), min(MAP_PX - 1, math.floor(high[row]))
            if last >= first:
                _touch(out, used, row, first, last)
            for x in range(first, last + 1):
                along = ((x - sx) * qy - (row - sy) * qx) / det
                z = a[2] + along * (b[2] - a[2])
                if z > out[row, x]:
                    out[row, x] = z
    for i in range(centres.shape[0]):
        c, r, h = centres[i], axes[i], halves[i]
        for k in range(8):
            u = h[0] if k & 1 else -h[0]
            v = h[1] if k & 2 else -h[1]
            w = h[2] if k & 4 else -h[2]
            z = c[2] + u * r[2, 0] + v * r[2, 1] + w * r[2, 2]
            px[k] = (c[0] + u * r[0, 0] + v * r[0, 1] + w * r[0, 2] - z * kx - x0) / cell
            py[k] = (c[1] + u * r[1, 0] + v * r[1, 1] + w * r[1, 2] - z * ky - y0) / cell
        top, bottom = max(0, math.ceil(py.min())), min(MAP_PX - 1, math.floor(py.max()))
        if bottom < top or px.max() < 0.0 or px.min() > MAP_PX:
            continue
        low[top : bottom + 1], high[top : bottom + 1] = 1e9, -1e9
        for k in range(8):
            for bit in (1, 2, 4):
                if not k & bit:
                    _span(px[k], py[k], px[k | bit], py[k | bit], low, high)
        for row in range(top, bottom + 1):
            first, last = max(0, math.ceil(low[row])), min(MAP_PX - 1, math.floor(high[row]))
            if last >= first:
                _touch(out, used, row, first, last)
            for x in range(first, last + 1):
                lx, ly = x * cell + x0 - c[0], row * cell + y0 - c[1]
                upper, under = 1e9, -1e9
                for k in range(3):
                    slope = r[0, k] * kx + r[1, k] * ky + r[2, k]
                    if abs(slope) < 1e-6:
                        continue
                    flat = r[2, k] * c[2] - r[0, k] * lx - r[1, k] * ly
                    z0, z1 = (flat - h[k]) / slope, (flat + h[k]) / slope
                    upper, under = min(upper, max(z0, z1)), max(under, min(z0, z1))
                z = (upper + under) / 2
                if z > out[row, x]:
                    out[row, x] = z
    return out, used
