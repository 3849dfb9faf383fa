"""The label rule of ``autonomy.grasp.quality`` and the virtual camera, compiled for millions of training frames.

The formulas are the same, for one candidate at a time; ``tests/training`` compares both with their originals.  A world
is (n, 8): centre, axis, length, radius.  ``facts`` are numbers of the grapple and of the rule, ``outline`` (k, 2) is
the outline of its jaws.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numba import njit

from autonomy.grasp import quality
from autonomy.grasp.candidates import CENTRING_SCALE_M
from autonomy.grasp.grapple_heights import HALF_PLATE_M, SCOOP_SHARE, TIP_CLEARANCE_M
from autonomy.grasp.quality import Jaws

HALF_GAP, BLADE, PLATE, CAPACITY, TIP_FORCE, SCOOP_SPAN, ROOM = range(7)
_TIP, _SLACK = quality.TIP_HEIGHT_M, quality.STRICT_RULE.slack_m
_MAX_OBLIQUITY, _LEVER = quality.MAX_AXIS_OBLIQUITY, quality.LEVER_SCALE_M
_SCOOP, _FRICTION, _DENSITY = quality.STRICT_RULE.scoop_share, quality.FRICTION_COEFFICIENT, quality.DENSITY_KG_M3
_GRAVITY: Final = quality.GRAVITY_M_S2
_MIDDLE, _ALONE, _ROW = CENTRING_SCALE_M, quality.OFF_CENTRE_SCALE_M, quality.LOWEST_ROW_M
_WEDGED: Final = quality.WEDGED_SHARE
_LOW, _HIGH = TIP_CLEARANCE_M
_HALF_PLATE, _UNDER = HALF_PLATE_M, SCOOP_SHARE


def facts_of(jaws: Jaws) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers of a grapple for ``evaluate_candidate``: facts (7,) and outline (k, 2)."""
    facts = (
        jaws.half_gap_m,
        jaws.blade_m,
        jaws.plate_m,
        jaws.capacity_m2,
        jaws.tip_force_n,
        jaws.scoop_span_m,
        jaws.room_m,
    )
    return np.array(facts), np.array([jaws.height_m, jaws.half_width_m]).T.copy()


@njit(cache=True)
def _half_width(outline: np.ndarray, height: float) -> float:
    first: float = outline[0, 1]
    last: float = outline[-1, 1]
    if height <= outline[0, 0]:
        return first
    for i in range(1, len(outline)):
        if height <= outline[i, 0]:
            share = (height - outline[i - 1, 0]) / (outline[i, 0] - outline[i - 1, 0])
            between: float = outline[i - 1, 1] + share * (outline[i, 1] - outline[i - 1, 1])
            return between
    return last


@njit(cache=True)
def evaluate_candidate(
    facts: np.ndarray,
    outline: np.ndarray,
    world: np.ndarray,
    upon: np.ndarray,
    x: float,
    y: float,
    yaw: float,
    level: float,
    at: np.ndarray,
    captured: np.ndarray,
) -> tuple[float, float]:
    """Return (lever by middle, mass [kg]) of a safe candidate, otherwise (0, 0); ``at`` (n, 3) and ``captured`` (n,)
    are scratch."""
    n = len(world)
    cu, su = math.cos(yaw), math.sin(yaw)
    w, gap, tip = facts[BLADE] / 2, facts[HALF_GAP], level + _TIP
    some = False
    left, right = gap, -gap
    for i in range(n):
        captured[i] = False
        dx, dy = world[i, 0] - x, world[i, 1] - y
        half, r = world[i, 6] / 2, world[i, 7]
        dv = cu * dy - su * dx
        if abs(dv) > half + w:
            continue
        du = cu * dx + su * dy
        au, av = cu * world[i, 3] + su * world[i, 4], cu * world[i, 4] - su * world[i, 3]
        if abs(av) < 1e-3:
            av = math.copysign(1e-3, av)
        middle_s, reach = -dv / av, abs(w / av)
        s0, s1 = min(max(middle_s - reach, -half), half), min(max(middle_s + reach, -half), half)
        if s1 - s0 <= 1e-6:
            continue
        part, middle_s = 0.5 * (s1 - s0), 0.5 * (s0 + s1)
        u, z = du + middle_s * au, world[i, 2] + middle_s * world[i, 5]
        wide = part * abs(au) + r * math.sqrt(max(1.0 - au * au, 0.0))
        high = part * abs(world[i, 5]) + r
        if z + high <= tip - facts[PLATE] / 2:
            continue
        low_u, high_u = u - wide, u + wide
        farthest, nearest = max(-low_u, high_u), max(low_u, -high_u)
        clearance = min(max((_HALF_PLATE + _UNDER * 2.0 * r) / 2.0, _LOW), _HIGH)
        taken = z - high + 2.0 * _SCOOP * r >= level + clearance - _SLACK
        if not (taken and farthest < gap):
            if nearest > gap + facts[PLATE]:
                continue
            return 0.0, 0.0
        square = abs(au) < _MAX_OBLIQUITY * max(math.sqrt(1.0 - world[i, 5] * world[i, 5]), 1e-6)
        whole = part > 0.9 * min(reach, half)
        if not (square and whole and z + high - tip < facts[ROOM] and farthest < _half_width(outline, z - tip)):
            return 0.0, 0.0
        captured[i] = some = True
        left, right = min(left, low_u), max(right, high_u)
        at[i, 0], at[i, 1], at[i, 2] = z - high, dv, u
    if not some:
        return 0.0, 0.0
    area = mass = tilt = row = far = 0.0
    in_row, wedged = 0, False
    first_u, last_u = math.inf, -math.inf
    for i in range(n):
        if not captured[i]:
            continue
        r = world[i, 7]
        for j in range(n):
            if upon[i, j] and not captured[j]:
                return 0.0, 0.0
        wood = _DENSITY * math.pi * r * r * world[i, 6]
        area += math.pi * r * r
        mass += wood
        tilt += wood * at[i, 1]
        far = max(far, abs(at[i, 1]))
        if at[i, 0] < level + _ROW or not upon[:, i].any():
            row += 2.0 * r
            in_row += 1
            first_u, last_u = min(first_u, at[i, 2]), max(last_u, at[i, 2])
        else:
            wedged = True
    apart = row * (in_row - 1) / max(in_row, 1)
    if wedged and in_row > 0:
        apart = max(apart, _WEDGED * (last_u - first_u))
    if apart >= facts[SCOOP_SPAN]:
        return 0.0, 0.0
    if area >= facts[CAPACITY] or _GRAVITY * abs(tilt) >= _FRICTION * facts[TIP_FORCE] * facts[BLADE]:
        return 0.0, 0.0
    off = ((left + right) / 2 / _MIDDLE) ** 2 + (far / _ALONE) ** 2
    return math.exp(-((tilt / mass / _LEVER) ** 2) - off), mass


@njit(cache=True)
def draw(
    inverse: np.ndarray,
    owner: np.ndarray,
    world: np.ndarray,
    eye: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> None:
    """Write inverse depths of cylinders, seen straight down from ``eye``, to ``inverse`` and their numbers to
    ``owner``."""
    height, width = inverse.shape
    for i in range(len(world)):
        px, py, pz = world[i, 0] - eye[0], eye[1] - world[i, 1], eye[2] - world[i, 2]
        wx, wy, wz = world[i, 3], -world[i, 4], -world[i, 5]
        half, r = world[i, 6] / 2, world[i, 7]
        left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
        for sign in (-1.0, 1.0):
            ex, ey, ez = px + sign * half * wx, py + sign * half * wy, pz + sign * half * wz
            near = max(ez - r, 0.05)
            for side in (-1.0, 1.0):
                u = (
                    max((ex + side * r) / near, (ex + side * r) / (ez + r))
                    if side > 0
                    else min((ex + side * r) / near, (ex + side * r) / (ez + r))
                )
                v = (
                    max((ey + side * r) / near, (ey + side * r) / (ez + r))
                    if side > 0
                    else min((ey + side * r) / near, (ey + side * r) / (ez + r))
                )
                left, right = min(left, u), max(right, u)
                top, bottom = min(top, v), max(bottom, v)
        c0, c1 = max(0, math.floor(left * fx + cx)), min(width - 1, math.ceil(right * fx + cx))
        r0, r1 = max(0, math.floor(top * fy + cy)), min(height - 1, math.ceil(bottom * fy + cy))
        pw = px * wx + py * wy + pz * wz
        c = px * px + py * py + pz * pz - pw * pw - r * r
        bu, bv, b1 = px - pw * wx, py - pw * wy, pz - pw * wz
        for row in range(r0, r1 + 1):
            v = (row - cy) / fy
            for col in range(c0, c1 + 1):
                u = (col - cx) / fx
                dw = wx * u + wy * v + wz
                b = bu * u + bv * v + b1
                disc = b * b - c * (u * u + v * v + 1.0 - dw * dw)
                if disc > 0.0:
                    s = (b + math.sqrt(disc)) / c
                    if s > inverse[row, col] and abs(dw - s * pw) <= s * half:
                        inverse[row, col] = s
                        owner[row, col] = i
                for sign in (-1.0, 1.0):
                    ex, ey, ez = px + sign * half * wx, py + sign * half * wy, pz + sign * half * wz
                    away = sign * (wx * ex + wy * ey + wz * ez)
                    if away < 0.0:
                        s = sign * dw / away
                        qx, qy, qz = u - s * ex, v - s * ey, 1.0 - s * ez
                        if qx * qx + qy * qy + qz * qz <= r * r * s * s and s > inverse[row, col]:
                            inverse[row, col] = s
                            owner[row, col] = i


@njit(cache=True)
def label(
    facts: np.ndarray,
    outline: np.ndarray,
    worlds: np.ndarray,
    upon: np.ndarray,
    moves: np.ndarray,
    levels: np.ndarray,
    eye: np.ndarray,
    inverse: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    step: int,
    turned: np.ndarray,
    near: float,
    out: np.ndarray,
) -> None:
    """Write quality and direction (3, h, w) on a grid every ``step`` pixels to ``out``: the best closing direction
    there.

    ``worlds`` (1 + d, n, 8): as seen, then samples; ``moves`` (d, 4): errors of x, y, yaw, level; ``levels`` (m,):
    heights above which logs may be gripped; ``turned`` (k,): offsets from the direction across a log; only logs within
    ``near`` contribute their direction.
    """
    n, draws = worlds.shape[1], len(moves)
    at, captured = np.empty((n, 3)), np.empty(n, np.bool_)
    seen = worlds[0]
    wood = 0.0
    for i in range(n):
        wood += _DENSITY * math.pi * seen[i, 7] ** 2 * seen[i, 6]
    for row in range(out.shape[1]):
        for col in range(out.shape[2]):
            pr, pc = step // 2 + row * step, step // 2 + col * step
            z = 1.0 / inverse[pr, pc]
            x, y = eye[0] + (pc - cx) / fx * z, eye[1] - (pr - cy) / fy * z
            best, best_yaw, best_level = 0.0, 0.0, 0.0
            for i in range(n):
                dx, dy = x - seen[i, 0], y - seen[i, 1]
                if (
                    abs(dx * seen[i, 4] - dy * seen[i, 3]) > near
                    or abs(dx * seen[i, 3] + dy * seen[i, 4]) > seen[i, 6] / 2
                ):
                    continue
                square = math.atan2(seen[i, 4], seen[i, 3]) + math.pi / 2
                for turn in turned:
                    for level in levels:
                        lever, mass = evaluate_candidate(
                            facts, outline, seen, upon, x, y, square + turn, level, at, captured
                        )
                        value = lever * (0.6 + 0.4 * mass / wood) * math.exp(-abs(turn))
                        if value > best:
                            best, best_yaw, best_level = value, square + turn, level
            if best > 0.0:
                held = 0
                for d in range(draws):
                    m = moves[d]
                    lever, _ = evaluate_candidate(
                        facts,
                        outline,
                        worlds[1 + d],
                        upon,
                        x + m[0],
                        y + m[1],
                        best_yaw + m[2],
                        best_level + m[3],
                        at,
                        captured,
                    )
                    held += lever > 0.0
                best *= held / draws
            out[0, row, col] = best
            out[1, row, col] = math.cos(2.0 * best_yaw) if best > 0.0 else 0.0
            out[2, row, col] = -math.sin(2.0 * best_yaw) if best > 0.0 else 0.0
