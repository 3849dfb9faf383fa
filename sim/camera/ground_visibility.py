"""First pass of the ground: which pixels see it, and their inverse depth; buffers and codes as in `visibility`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim.camera.visibility import GROUND_CODE, NEAR_M, SKY_CODE


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
    """A triangle of the ground in the optical frame."""
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
    place = np.empty((2, j1 - j0 + 1, 3))
    px, py = np.empty(4), np.empty(4)
    left, right = -(cx + 1.0) / fx, (width + 1.0 - cx) / fx
    for i in range(i0, i1 + 1):
        now, before = place[i & 1], place[1 - (i & 1)]
        for j in range(j0, j1 + 1):
            x, y = x0 + i * span - eye[0], y0 + j * span - eye[1]
            z = heights[i * stride, j * stride] - eye[2]
            for k in range(3):
                now[j - j0, k] = x * rotation[0, k] + y * rotation[1, k] + z * rotation[2, k]
        if i == i0:
            continue
        for j in range(j1 - j0):
            a, b, c, d = before[j], before[j + 1], now[j], now[j + 1]
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
    """The level ground ``below`` metres under the camera wherever nothing is drawn; ``up`` in the optical frame."""
    height, width = inverse.shape
    su, sv = -up[0] / below / fx, -up[1] / below / fy
    for row in range(height):
        s_row = -up[2] / below - su * cx + sv * (row - cy)
        for x in range(width):
            s = s_row + su * x
            if code[row, x] == SKY_CODE and s > 1e-4:
                inverse[row, x] = s
                code[row, x] = GROUND_CODE
