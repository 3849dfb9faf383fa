"""The area where a machine may drive: fences as polygons in the local plane [m].

Pure numpy geometry, exact for straight edges.  A point on an edge is inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

ON_EDGE_M: Final = 1e-3


@dataclass(frozen=True, slots=True)
class Area:
    """Rings of corners (n, 2) to stay inside of (none: everywhere) and to stay out of."""

    keep_in: tuple[np.ndarray, ...] = ()
    keep_out: tuple[np.ndarray, ...] = ()

    def outside_m(self, points: np.ndarray) -> np.ndarray:
        """Distance of each point (n, 2) outside the area [m]; 0 inside."""
        points = np.asarray(points, dtype=float).reshape(-1, 2)
        away = np.zeros(len(points))
        if self.keep_in:
            each = [np.where(inside(ring, points), 0.0, edge_distance_m(ring, points)) for ring in self.keep_in]
            away = np.min(each, axis=0)
        for ring in self.keep_out:
            deep = np.where(inside(ring, points), edge_distance_m(ring, points), 0.0)
            away = np.maximum(away, deep)
        return np.where(away <= ON_EDGE_M, 0.0, away)

    def leaves_m(self, start: np.ndarray, end: np.ndarray) -> float:
        """Greatest distance outside the area along the straight line from ``start`` to ``end`` (2,) [m], at least; 0
        when it stays inside.
        """
        cuts = [0.0, 1.0]
        for ring in (*self.keep_in, *self.keep_out):
            cuts += _cuts(ring, start, end)
        shares = np.unique(cuts)
        middles = 0.5 * (shares[1:] + shares[:-1])
        probes = np.concatenate([shares, middles])
        return float(np.max(self.outside_m(start + probes[:, None] * (end - start)), initial=0.0))


def inside(ring: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether each point (n, 2) lies within a ring, by counting the edges to its right."""
    x, y = points[:, 0], points[:, 1]
    found = np.zeros(len(points), dtype=bool)
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        between = (ay > y) != (by > y)
        found[between] ^= x[between] < ax + (bx - ax) * (y[between] - ay) / (by - ay)
    return found


def edge_distance_m(ring: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of each point (n, 2) from the edge of a ring [m]."""
    closed = np.vstack([ring, ring[:1]])
    return path_distance_m(closed, points)


def path_distance_m(path: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of each point (n, 2) from a polyline (m, 2) [m]."""
    nearest: np.ndarray = np.full(len(points), np.inf)
    if len(path) == 1:
        nearest = np.linalg.norm(points - path[0], axis=1)
        return nearest
    for a, b in pairwise(path):
        along = b - a
        square = float(along @ along)
        share = np.clip((points - a) @ along / square, 0.0, 1.0) if square > 0.0 else np.zeros(len(points))
        nearest = np.minimum(nearest, np.linalg.norm(points - a - share[:, None] * along, axis=1))
    return nearest


def signed_area_m2(ring: np.ndarray) -> float:
    """Area of a ring (n, 2), m^2; positive when its corners run counter-clockwise."""
    x, y = (ring - ring[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def crossing(ring: np.ndarray) -> tuple[int, int] | None:
    """The first two edges of a ring, by their first corners, that cross or touch without being neighbours."""
    count = len(ring)
    start, end = ring, np.roll(ring, -1, axis=0)
    for i in range(count):
        others = np.arange(i + 1, count)
        # Neighbours share a corner; they only cross if the second turns back over the first.
        far = others[(others != i + 1) & ((others + 1) % count != i)]
        hits = _meet(start[i], end[i], start[far], end[far])
        if hits.any():
            return i, int(far[np.argmax(hits)])
        before, corner, after = start[i], end[i], end[(i + 1) % count]
        back, on = before - corner, after - corner
        if abs(_cross(back, on)) <= 1e-9 * np.linalg.norm(back) * np.linalg.norm(on) and back @ on > 0.0:
            return i, (i + 1) % count
    return None


def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Whether the edge a-b meets each of the edges c-d (n, 2)."""
    sides = _cross(b - a, c - a), _cross(b - a, d - a), _cross(d - c, a - c), _cross(d - c, b - c)
    one, two, three, four = (np.sign(np.where(np.abs(s) < 1e-9, 0.0, s)) for s in sides)
    low, high = np.minimum(a, b), np.maximum(a, b)
    near = (np.minimum(c, d) <= high).all(axis=1) & (np.maximum(c, d) >= low).all(axis=1)
    met: np.ndarray = (one * two <= 0) & (three * four <= 0) & near
    return met


def _cuts(ring: np.ndarray, start: np.ndarray, end: np.ndarray) -> list[float]:
    """Positions, as shares of the line from ``start`` to ``end``, at which it meets the edges of a ring."""
    a, along = ring, np.roll(ring, -1, axis=0) - ring
    way = end - start
    flat = _cross(way, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = _cross(a - start, along) / flat
        edge = _cross(a - start, way) / flat
    hit = (np.abs(flat) > 1e-12) & (share >= 0.0) & (share <= 1.0) & (edge >= -1e-12) & (edge <= 1.0 + 1e-12)
    return [float(s) for s in share[hit]]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product: np.ndarray = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
