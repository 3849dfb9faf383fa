"""First pass: which surface each pixel sees, and its inverse depth.

Objects are drawn one after another into an inverse-depth buffer, only inside the rows and columns their bounding box
projects to.  In inverse depth s = 1/z everything is cheap: a plane is linear in the pixel, so a box is the smallest
of its front planes against the largest of its back planes, and a cone c s^2 + 2 b s + a = 0 has a constant c, a
linear b and a quadratic discriminant.  A pixel's ray is d = (u, v, 1) with u = (x - cx) / fx, v = (y - cy) / fy.

Surface codes: SKY_CODE, GROUND_CODE, then three per rod (side, start cap, end cap), then six per box (its faces
+x, -x, +y, -y, +z, -z).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

SKY_CODE, GROUND_CODE, FIRST_ROD = -1, 0, 1
NEAR_M = 0.05

_EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]], np.int64
)


@njit(cache=True)
def _stretch(ax: float, ay: float, bx: float, by: float, height: int, low: np.ndarray, high: np.ndarray) -> None:
    """Widen the row spans by the segment (ax, ay)-(bx, by) in pixels, with a margin of a pixel."""
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    first, last = max(0, math.floor(ay)), min(height - 1, math.ceil(by))
    if last < first:
        return
    slope = (bx - ax) / (by - ay) if by - ay > 1e-9 else 0.0
    for row in range(first, last + 1):
        # The part of the segment that passes within half a pixel above and below this row's centre.
        top, bottom = min(max(row - 1.0, ay), by), min(max(row + 1.0, ay), by)
        x0, x1 = (ax + slope * (top - ay), ax + slope * (bottom - ay)) if slope != 0.0 else (ax, bx)
        low[row] = min(low[row], min(x0, x1))
        high[row] = max(high[row], max(x0, x1))


@njit(cache=True)
def _spans(
    corners: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[int, int]:
    """Compute row spans of the convex hull of eight corners (8, 3) in the optical frame; return (first, last) row."""
    behind = 0
    px, py = np.empty(8), np.empty(8)
    for i in range(8):
        if corners[i, 2] < NEAR_M:
            behind += 1
        else:
            px[i] = corners[i, 0] / corners[i, 2] * fx + cx
            py[i] = corners[i, 1] / corners[i, 2] * fy + cy
    if behind == 8:
        return 0, -1
    if behind == 0:
        top, bottom, left, right = py.min(), py.max(), px.min(), px.max()
    else:
        top, bottom, left, right = 1e9, -1e9, 1e9, -1e9
        for e in range(12):
            a, b = _EDGES[e, 0], _EDGES[e, 1]
            za, zb = corners[a, 2], corners[b, 2]
            if za < NEAR_M and zb < NEAR_M:
                continue
            for end in (a, b):
                other = b if end == a else a
                x, y, z = corners[end, 0], corners[end, 1], corners[end, 2]
                if z < NEAR_M:
                    f = (NEAR_M - z) / (corners[other, 2] - z)
                    x, y, z = x + f * (corners[other, 0] - x), y + f * (corners[other, 1] - y), NEAR_M
                u, v = x / z * fx + cx, y / z * fy + cy
                top, bottom, left, right = min(top, v), max(bottom, v), min(left, u), max(right, u)
    if bottom < -1.0 or top > height or right < -1.0 or left > width:
        return 0, -1
    first, last = max(0, math.floor(top)), min(height - 1, math.ceil(bottom))
    for row in range(first, last + 1):
        low[row], high[row] = (1e9, -1e9) if behind == 0 else (left, right)
    if behind == 0:
        for e in range(12):
            a, b = _EDGES[e, 0], _EDGES[e, 1]
            _stretch(px[a], py[a], px[b], py[b], height, low, high)
    return first, last


@njit(cache=True)
def _columns(low: float, high: float, width: int) -> tuple[int, int]:
    return max(0, math.floor(low)), min(width - 1, math.ceil(high))


@njit(cache=True)
def _box_corners(centre: np.ndarray, axes: np.ndarray, half: np.ndarray, out: np.ndarray) -> None:
    for i in range(8):
        sx = half[0] if i & 1 else -half[0]
        sy = half[1] if i & 2 else -half[1]
        sz = half[2] if i & 4 else -half[2]
        for k in range(3):
            out[i, k] = centre[k] + sx * axes[k, 0] + sy * axes[k, 1] + sz * axes[k, 2]


@njit(cache=True)
def draw_box(
    inverse: np.ndarray,
    code: np.ndarray,
    first_code: int,
    centre: np.ndarray,
    axes: np.ndarray,
    half: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Draw one box in the optical frame."""
    height, width = inverse.shape
    corners = np.empty((8, 3))
    _box_corners(centre, axes, half, corners)
    first, last = _spans(corners, fx, fy, cx, cy, width, height, low, high)
    if last < first:
        return
    front, back = np.empty((3, 3)), np.empty((5, 3))
    face = np.empty(3, np.int64)
    fronts, backs = 0, 0
    for f in range(6):
        k, sign = f // 2, 1.0 - 2.0 * (f % 2)
        nx, ny, nz = sign * axes[0, k], sign * axes[1, k], sign * axes[2, k]
        away = nx * centre[0] + ny * centre[1] + nz * centre[2] + half[k]
        if abs(away) < 1e-9:
            continue
        if away > 0.0 and backs == 5:  # the camera is inside: its own housing does not hide the scene
            return
        plane = front[fronts] if away < 0.0 else back[backs]
        plane[0], plane[1], plane[2] = nx / away / fx, ny / away / fy, nz / away
        plane[2] -= plane[0] * cx + plane[1] * cy
        if away < 0.0:
            face[fronts] = first_code + f
            fronts += 1
        else:
            backs += 1
    if fronts == 0 or backs == 0:
        return
    for i in range(fronts, 3):
        front[i] = front[0]
        face[i] = face[0]
    for i in range(backs, 5):
        back[i] = back[0]
    for row in range(first, last + 1):
        x0, x1 = _columns(low[row], high[row], width)
        f0 = front[0, 1] * row + front[0, 2]
        f1 = front[1, 1] * row + front[1, 2]
        f2 = front[2, 1] * row + front[2, 2]
        b0 = back[0, 1] * row + back[0, 2]
        b1 = back[1, 1] * row + back[1, 2]
        b2 = back[2, 1] * row + back[2, 2]
        b3 = back[3, 1] * row + back[3, 2]
        b4 = back[4, 1] * row + back[4, 2]
        for x in range(x0, x1 + 1):
            s0, s1, s2 = f0 + front[0, 0] * x, f1 + front[1, 0] * x, f2 + front[2, 0] * x
            s = min(s0, min(s1, s2))
            out = max(b0 + back[0, 0] * x, max(b1 + back[1, 0] * x, b2 + back[2, 0] * x))
            out = max(out, max(b3 + back[3, 0] * x, b4 + back[4, 0] * x))
            if s > out and s > inverse[row, x]:
                inverse[row, x] = s
                code[row, x] = face[0] if s == s0 else (face[1] if s == s1 else face[2])


@njit(cache=True)
def _frame_of(wx: float, wy: float, wz: float, axes: np.ndarray) -> None:
    """Compute axes (3, 3) whose column 2 is the unit vector w."""
    if abs(wx) < 0.7:
        ux, uy, uz = 0.0, wz, -wy
    else:
        ux, uy, uz = -wz, 0.0, wx
    n = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / n, uy / n, uz / n
    axes[0, 0], axes[1, 0], axes[2, 0] = ux, uy, uz
    axes[0, 1], axes[1, 1], axes[2, 1] = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
    axes[0, 2], axes[1, 2], axes[2, 2] = wx, wy, wz


@njit(cache=True)
def _draw_cap(
    inverse: np.ndarray,
    code: np.ndarray,
    value: int,
    at: np.ndarray,
    axes: np.ndarray,
    sign: float,
    radius: float,
    corners: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Draw a disc at ``at`` whose outward normal is sign * column 2 of ``axes``."""
    height, width = inverse.shape
    nx, ny, nz = sign * axes[0, 2], sign * axes[1, 2], sign * axes[2, 2]
    away = nx * at[0] + ny * at[1] + nz * at[2]
    if away > -1e-9:
        return
    half = np.array((radius, radius, 0.0))
    _box_corners(at, axes, half, corners)
    first, last = _spans(corners, fx, fy, cx, cy, width, height, low, high)
    for row in range(first, last + 1):
        x0, x1 = _columns(low[row], high[row], width)
        v = (row - cy) / fy
        for x in range(x0, x1 + 1):
            u = (x - cx) / fx
            s = (nx * u + ny * v + nz) / away
            dx, dy, dz = u - s * at[0], v - s * at[1], 1.0 - s * at[2]
            if dx * dx + dy * dy + dz * dz <= radius * radius * s * s and s > inverse[row, x]:
                inverse[row, x] = s
                code[row, x] = value


@njit(cache=True)
def draw_rod(
    inverse: np.ndarray,
    code: np.ndarray,
    first_code: int,
    start: np.ndarray,
    end: np.ndarray,
    r0: float,
    r1: float,
    n0: np.ndarray,
    n1: np.ndarray,
    caps: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Draw one frustum in the optical frame: its side between the cutting planes, and its caps."""
    height, width = inverse.shape
    wx, wy, wz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = math.sqrt(wx * wx + wy * wy + wz * wz)
    wx, wy, wz = wx / length, wy / length, wz / length
    axes, corners = np.empty((3, 3)), np.empty((8, 3))
    _frame_of(wx, wy, wz, axes)
    widest = max(r0, r1)
    # A mitred joint reaches further along the axis on the outside of the bow.
    lean = min(abs(n0[0] * wx + n0[1] * wy + n0[2] * wz), abs(n1[0] * wx + n1[1] * wy + n1[2] * wz))
    reach = widest * math.sqrt(max(0.0, 1.0 - lean * lean)) / lean
    centre = np.array(((start[0] + end[0]) / 2, (start[1] + end[1]) / 2, (start[2] + end[2]) / 2))
    half = np.array((widest, widest, length / 2 + reach))
    _box_corners(centre, axes, half, corners)
    first, last = _spans(corners, fx, fy, cx, cy, width, height, low, high)
    k = (r1 - r0) / length
    m = 1.0 + k * k
    sw = start[0] * wx + start[1] * wy + start[2] * wz
    c = start[0] ** 2 + start[1] ** 2 + start[2] ** 2 - m * sw * sw + 2.0 * r0 * k * sw - r0 * r0
    if c > 0.0 and last >= first:  # else the camera is inside the infinite cone and sees a cap at most
        slide = m * sw - r0 * k
        bu, bv, b1 = slide * wx - start[0], slide * wy - start[1], slide * wz - start[2]
        p0 = n0[0] * start[0] + n0[1] * start[1] + n0[2] * start[2]
        p1 = n1[0] * end[0] + n1[1] * end[1] + n1[2] * end[2]
        ic = 1.0 / c
        step = 1.0 / fx
        for row in range(first, last + 1):
            x0, x1 = _columns(low[row], high[row], width)
            v = (row - cy) / fy
            b_row, w_row = bv * v + b1, wy * v + wz
            # discriminant b^2 - a c as a polynomial in u
            q2 = bu * bu - c * (1.0 - m * wx * wx)
            q1 = 2.0 * (bu * b_row + c * m * wx * w_row)
            q0 = b_row * b_row - c * (v * v + 1.0 - m * w_row * w_row)
            g0, g1 = n0[1] * v + n0[2], n1[1] * v + n1[2]
            for x in range(x0, x1 + 1):
                u = (x - cx) * step
                d = q0 + u * (q1 + u * q2)
                if d > 0.0:
                    s = (math.sqrt(d) - bu * u - b_row) * ic
                    if s > inverse[row, x] and n0[0] * u + g0 >= s * p0 and n1[0] * u + g1 <= s * p1:
                        inverse[row, x] = s
                        code[row, x] = first_code
    if caps & 1:
        _draw_cap(inverse, code, first_code + 1, start, axes, -1.0, r0, corners, fx, fy, cx, cy, low, high)
    if caps & 2:
        _draw_cap(inverse, code, first_code + 2, end, axes, 1.0, r1, corners, fx, fy, cx, cy, low, high)


@njit(cache=True)
def draw_objects(
    inverse: np.ndarray,
    code: np.ndarray,
    rod_ends: np.ndarray,
    rod_radii: np.ndarray,
    rod_normals: np.ndarray,
    caps: np.ndarray,
    centres: np.ndarray,
    axes: np.ndarray,
    halves: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> None:
    """Draw all rods, then all boxes, in the optical frame.  rod_ends and rod_normals (S, 2, 3), rod_radii (S, 2)."""
    low, high = np.empty(inverse.shape[0]), np.empty(inverse.shape[0])
    rods = rod_ends.shape[0]
    for i in range(rods):
        ends, normals, radii = rod_ends[i], rod_normals[i], rod_radii[i]
        value = FIRST_ROD + 3 * i
        draw_rod(
            inverse,
            code,
            value,
            ends[0],
            ends[1],
            radii[0],
            radii[1],
            normals[0],
            normals[1],
            caps[i],
            fx,
            fy,
            cx,
            cy,
            low,
            high,
        )
    for i in range(centres.shape[0]):
        value = FIRST_ROD + 3 * rods + 6 * i
        draw_box(inverse, code, value, centres[i], axes[i], halves[i], fx, fy, cx, cy, low, high)
