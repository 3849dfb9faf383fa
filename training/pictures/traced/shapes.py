"""Shapes of logs, plants, stones and steel as plain arrays; numpy only: two renderers in two processes use them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

SIDES, RINGS = 40, 44  # of a log


@dataclass(frozen=True, slots=True)
class Shape:
    """Vertices (N, 3) and faces (M, 4) of three (the last index is -1) or four of them.

    ``slot`` (M,) is which of the shape's materials a face has; ``smooth`` (M,) whether light sees it as curved; ``uv``
    (N, 2) are turns around and metres along a log.
    """

    vertices: np.ndarray
    faces: np.ndarray
    slot: np.ndarray
    smooth: np.ndarray
    uv: np.ndarray | None = None


def shape_of(vertices: Any, faces: Any, slot: Any = 0, smooth: bool = False) -> Shape:
    """Make a shape; faces may be rows of three or four."""
    rows = np.array([(*f, -1) if len(f) == 3 else tuple(f) for f in faces], np.int64).reshape(-1, 4)
    slots = np.broadcast_to(np.asarray(slot, np.int64), len(rows)).copy()
    return Shape(np.asarray(vertices, float).reshape(-1, 3), rows, slots, np.full(len(rows), smooth))


def spin(angle_rad: float) -> np.ndarray:
    """Return a turn (3, 3) about the vertical."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def lying(axis: np.ndarray) -> np.ndarray:
    """Return a frame (3, 3) whose z is the axis (3,)."""
    z = axis / np.linalg.norm(axis)
    x = np.cross((0.0, 0.0, 1.0) if abs(z[2]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def stem(
    points: np.ndarray,
    radii: np.ndarray,
    rng: np.random.Generator,
    oval: float,
    bump: float,
    sides: int = SIDES,
    flare: float = 0.0,
    knots: int = 0,
) -> Shape:
    """Make a log in its own frame: spine (N, 3) along z, radii (N,); oval, uneven, butt flare, knots, slanted cuts.

    Its bark is slot 0, its sawn ends slot 1.
    """
    n, angle = len(points), np.arange(sides + 1) * 2.0 * math.pi / sides
    t = np.linspace(0.0, 1.0, n)[:, None]
    lobes = rng.uniform(0.0, 2.0 * math.pi, 4)
    r = 1.0 + oval * np.cos(2.0 * angle + lobes[0]) + 0.5 * oval * np.cos(3.0 * angle + 4.0 * t + lobes[1])
    r = r + flare * np.exp(-t / 0.06) * (1.0 + 0.4 * np.cos(5.0 * angle + lobes[2]))
    rough = rng.standard_normal((n, sides))
    rough = (rough + np.roll(rough, 1, 0) + np.roll(rough, 1, 1) + np.roll(rough, -1, 1)) / 2.0
    r = r + bump * np.concatenate([rough, rough[:, :1]], axis=1)
    for _ in range(knots):
        at, around = rng.uniform(0.05, 0.95), rng.uniform(0.0, 2.0 * math.pi)
        near = np.exp(-(((t - at) * n / 1.5) ** 2) - (np.angle(np.exp(1j * (angle - around))) / 0.25) ** 2)
        r = r + rng.uniform(0.08, 0.25) * near
    r = r * radii[:, None]
    x, y = points[:, 0, None] + r * np.cos(angle), points[:, 1, None] + r * np.sin(angle)
    z = np.broadcast_to(points[:, 2, None], x.shape).copy()
    for end in (0, -1):  # no saw cuts at a right angle
        slant = rng.normal(0.0, 0.06, 2)
        z[end] += slant[0] * x[end] + slant[1] * y[end]
    side = np.stack([x, y, z], axis=-1)
    columns = sides + 1  # the first and the last column are one place with two texture coordinates
    i, j = np.meshgrid(np.arange(n - 1), np.arange(sides), indexing="ij")
    a = (i * columns + j).ravel()
    faces = [np.stack([a, a + 1, a + 1 + columns, a + columns], 1)]
    vertices, first_vertex, k = [side.reshape(-1, 3)], n * columns, np.arange(sides)
    for end in (0, -1):
        rim = side[end]
        vertices += [rim, rim[:-1].mean(axis=0)[None]]
        turn = [first_vertex + k + 1, first_vertex + k] if end == 0 else [first_vertex + k, first_vertex + k + 1]
        faces.append(np.stack([*turn, np.full(sides, first_vertex + columns), np.full(sides, -1)], 1))
        first_vertex += columns + 1
    rows = np.concatenate(faces)
    bark = rows[:, 3] >= 0
    whole = np.concatenate(vertices)
    around_ = np.concatenate([np.tile(np.arange(columns) / sides, n), np.zeros(2 * (columns + 1))])
    uv = np.stack([around_, np.concatenate([np.repeat(points[:, 2], columns), np.zeros(2 * (columns + 1))])], 1)
    return Shape(whole, rows, (~bark).astype(np.int64), bark, uv)


def field(
    x0: float, y0: float, cell: float, heights: np.ndarray, finer: int, rough_m: float, rng: np.random.Generator
) -> Shape:
    """Make a ground of a grid of heights, refined ``finer`` times and roughened."""
    nx, ny = heights.shape
    gx, gy = np.linspace(0, nx - 1, (nx - 1) * finer + 1), np.linspace(0, ny - 1, (ny - 1) * finer + 1)
    i, j = np.minimum(gx.astype(int), nx - 2), np.minimum(gy.astype(int), ny - 2)
    fx, fy = (gx - i)[:, None], (gy - j)[None]
    h = heights
    z = (
        h[i][:, j] * (1 - fx) * (1 - fy)
        + h[i + 1][:, j] * fx * (1 - fy)
        + h[i][:, j + 1] * (1 - fx) * fy
        + h[i + 1][:, j + 1] * fx * fy
    )
    for size in (2, 5):
        small = rng.standard_normal((len(gx) // size + 3, len(gy) // size + 3))
        up = np.kron(small, np.ones((size, size)))
        for _ in range(2):
            up = (up + np.roll(up, 1, 0) + np.roll(up, 1, 1) + np.roll(np.roll(up, 1, 0), 1, 1)) / 4.0
        z = z + rough_m * up[: z.shape[0], : z.shape[1]]
    x, y = np.meshgrid(x0 + gx * cell, y0 + gy * cell, indexing="ij")
    columns = z.shape[1]
    a = (np.arange(z.shape[0] - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.stack([a, a + columns, a + columns + 1, a + 1], 1)
    return shape_of(np.stack([x, y, z], axis=-1), faces, smooth=True)


def tuft(rng: np.random.Generator, blades: int, height_m: float, width_m: float, lean: float) -> Shape:
    """Make a tuft of grass: bent blades of three triangles."""
    vertices: list[Any] = []
    faces: list[Any] = []
    for _ in range(blades):
        turn, away, high = rng.uniform(0.0, 6.28), 0.05 * rng.random(), height_m * rng.uniform(0.4, 1.0)
        c, s, bend, o = math.cos(turn), math.sin(turn), lean * high * rng.uniform(0.3, 1.5), len(vertices)
        x, y, w = away * c, away * s, width_m * rng.uniform(0.6, 1.3)
        for part, wide in ((0.0, 1.0), (0.55, 0.8)):
            reach = bend * part * part
            vertices += [
                (x + reach * c - w * wide * s, y + reach * s + w * wide * c, high * part),
                (x + reach * c + w * wide * s, y + reach * s - w * wide * c, high * part),
            ]
        vertices.append((x + bend * c, y + bend * s, high * (1.0 - 0.25 * lean)))
        faces += [(o, o + 1, o + 3, o + 2), (o + 2, o + 3, o + 4)]
    return shape_of(vertices, faces)


def fern(rng: np.random.Generator, fronds: int, reach_m: float) -> Shape:
    """Make a fern: arching fronds with leaflets to both sides."""
    vertices: list[Any] = []
    faces: list[Any] = []
    for k in range(fronds):
        turn = 6.28 * k / fronds + rng.normal(0.0, 0.2)
        c, s, long = math.cos(turn), math.sin(turn), reach_m * rng.uniform(0.6, 1.0)
        for i in range(14):
            t = (i + 1) / 15.0
            r, z = long * t, long * (0.9 * t - 0.85 * t * t)
            leaf = 0.22 * long * (1.0 - t) ** 0.8 * min(1.0, 5 * t)
            for side in (-1, 1):
                o, d = len(vertices), 0.025 * long
                vertices += [
                    (c * r, s * r, z),
                    (c * (r + d), s * (r + d), z),
                    (c * (r + 0.5 * leaf) - side * s * leaf, s * (r + 0.5 * leaf) + side * c * leaf, z - 0.25 * leaf),
                ]
                faces.append((o, o + 1, o + 2))
    return shape_of(vertices, faces)


def leaves(rng: np.random.Generator, count: int, reach_m: float, size_m: float) -> Shape:
    """Make loose leaves lying about."""
    vertices: list[Any] = []
    faces: list[Any] = []
    for _ in range(count):
        x, y = rng.uniform(-reach_m, reach_m, 2)
        turn, size, o = rng.uniform(0.0, 6.28), size_m * rng.uniform(0.5, 1.3), len(vertices)
        c, s = math.cos(turn) * size, math.sin(turn) * size
        lift = rng.uniform(0.0, 0.5, 4) * size + 0.012
        vertices += [
            (x + c, y + s, lift[0]),
            (x - 0.5 * s, y + 0.5 * c, lift[1]),
            (x - c, y - s, lift[2]),
            (x + 0.5 * s, y - 0.5 * c, lift[3]),
        ]
        faces.append((o, o + 1, o + 2, o + 3))
    return shape_of(vertices, faces)


def twig(
    rng: np.random.Generator, length_m: float, radius_m: float, forks: int, needles: bool = False, sides: int = 7
) -> Shape:
    """Make a branch along x with forks (slot 0), perhaps with needles (slot 1): what is left of the crowns."""
    vertices: list[Any] = []
    faces: list[Any] = []

    def rod(a: np.ndarray, b: np.ndarray, r0: float, r1: float) -> None:
        frame = lying(b - a)
        for i in range(5):
            t, o = i / 4.0, len(vertices)
            bow = 0.06 * np.linalg.norm(b - a) * (t - t * t) * 4.0
            middle = a + (b - a) * t + frame[:, 0] * bow * rng.uniform(0.6, 1.4)
            r = r0 + (r1 - r0) * t
            for k in range(sides):
                around = 6.2832 * k / sides
                vertices.append(middle + r * (math.cos(around) * frame[:, 0] + math.sin(around) * frame[:, 1]))
            if i:
                for k in range(sides):
                    m = (k + 1) % sides
                    faces.append((o - sides + k, o - sides + m, o + m, o + k))

    rods = [
        (np.zeros(3), np.array([length_m, rng.normal(0, 0.1) * length_m, rng.uniform(0, 0.08) * length_m]), radius_m)
    ]
    for _ in range(forks):
        start, end, r = rods[rng.integers(len(rods))]
        at = start + (end - start) * rng.uniform(0.2, 0.9)
        offset_m = (end - start) * rng.uniform(0.25, 0.5) + rng.normal(0, 0.22, 3) * np.linalg.norm(end - start) * (
            1,
            1,
            0.4,
        )
        offset_m[2] = abs(offset_m[2])
        rods.append((at, at + offset_m, 0.5 * r))
    for start, end, r in rods:
        rod(start, end, r, 0.35 * r)
    split = len(faces)
    if needles:
        for start, end, _ in rods[1:]:
            for _ in range(60):
                at = start + (end - start) * rng.uniform(0.1, 1.0)
                offset_m, o = rng.normal(0, 1, 3), len(vertices)
                offset_m *= rng.uniform(0.02, 0.05) / np.linalg.norm(offset_m)
                wide = np.cross(offset_m, rng.normal(0, 1, 3))
                wide *= 0.0035 / np.linalg.norm(wide)
                vertices += [at - wide, at + wide, at + offset_m]
                faces.append((o, o + 1, o + 2))
    return shape_of(vertices, faces, np.arange(len(faces)) >= split)


def stone(rng: np.random.Generator, size_m: Sequence[float]) -> Shape:
    """Make a stone: an uneven ellipsoid."""
    u, v = np.meshgrid(np.linspace(0, 2 * math.pi, 20, endpoint=False), np.linspace(0.02, math.pi - 0.02, 12))
    directions = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    r = np.ones(u.shape)
    for _ in range(9):
        side = rng.normal(0, 1, 3)
        side /= np.linalg.norm(side)
        r = np.minimum(r, rng.uniform(0.65, 0.95) / np.maximum(directions @ side, 0.05))
    vertices = (directions * r[..., None] * np.asarray(size_m)).reshape(-1, 3)
    a = (np.arange(11)[:, None] * 20 + np.arange(20)).ravel()
    b = (np.arange(11)[:, None] * 20 + (np.arange(20) + 1) % 20).ravel()
    return shape_of(vertices, np.stack([a, b, b + 20, a + 20], 1))


def box(half: Sequence[float]) -> Shape:
    """Make a box with its middle at the origin."""
    x, y, z = half
    corners = np.array([(i, j, k) for i in (-x, x) for j in (-y, y) for k in (-z, z)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return shape_of(corners, faces)
