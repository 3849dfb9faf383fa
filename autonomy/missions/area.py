"""The area where a machine may drive: fences as polygons in the local plane [m].  A point on an edge is inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely

ON_EDGE_M: Final = 1e-3
TOUCHING_M: Final = 1e-6
"""Edges closer together than this meet: a corner on an edge is only nearly there, once it is in local metres."""


@dataclass(frozen=True, slots=True)
class Area:
    """Rings of corners (n, 2) to stay inside of (none: everywhere) and to stay out of."""

    keep_in: tuple[np.ndarray, ...] = ()
    keep_out: tuple[np.ndarray, ...] = ()

    def outside_m(self, points: np.ndarray) -> np.ndarray:
        """Compute the distance of each point (n, 2) outside the area [m]; 0 inside."""
        places = shapely.points(np.asarray(points, dtype=float).reshape(-1, 2))
        away = np.zeros(len(places))
        if self.keep_in:
            away = np.min([shapely.distance(shapely.Polygon(ring), places) for ring in self.keep_in], axis=0)
        for ring in self.keep_out:
            forbidden = shapely.Polygon(ring)
            deep = np.where(shapely.contains(forbidden, places), shapely.distance(forbidden.exterior, places), 0.0)
            away = np.maximum(away, deep)
        return np.where(away <= ON_EDGE_M, 0.0, away)

    def leaves_m(self, start: np.ndarray, end: np.ndarray) -> float:
        """Compute the greatest distance outside the area along the straight line from ``start`` to ``end`` (2,) [m], at
        least; 0 when it stays inside.
        """
        line = shapely.LineString([start, end])
        rings = (shapely.LinearRing(ring) for ring in (*self.keep_in, *self.keep_out))
        stops = np.vstack([start, end, *(shapely.get_coordinates(shapely.intersection(line, ring)) for ring in rings)])
        stops = stops[np.argsort(np.linalg.norm(stops - start, axis=1))]
        return float(self.outside_m(np.vstack([stops, 0.5 * (stops[1:] + stops[:-1])])).max())


def path_distance_m(path: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Compute the distance of each point (n, 2) from a polyline (m, 2) [m]."""
    line = shapely.LineString(path) if len(path) > 1 else shapely.Point(path[0])
    return np.asarray(shapely.distance(line, shapely.points(points)))


def signed_area_m2(ring: np.ndarray) -> float:
    """Compute the area of a ring (n, 2), m^2; positive when its corners run counter-clockwise."""
    x, y = (ring - ring[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def crossing(ring: np.ndarray) -> tuple[int, int] | None:
    """Find the first two edges of a ring, by their first corners, that cross or touch without being neighbours.

    Neighbours share a corner; they only cross if one turns back over the other.
    """
    count, corners = len(ring), shapely.points(ring)
    edges = shapely.linestrings(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1))
    first_edges, second_edges = shapely.STRtree(edges).query(edges, "dwithin", TOUCHING_M)
    far = (second_edges - first_edges > 1) & (second_edges - first_edges < count - 1)
    met = sorted(zip(first_edges[far].tolist(), second_edges[far].tolist(), strict=True))
    back = shapely.dwithin(np.roll(corners, -2), edges, TOUCHING_M) | shapely.dwithin(
        corners, np.roll(edges, -1), TOUCHING_M
    )
    met += [(i, (i + 1) % count) for i in np.flatnonzero(back).tolist()]
    return min(met, key=lambda pair: pair[0], default=None)
