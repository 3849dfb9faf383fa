"""A path from the machine's pose onto a route, whatever the machine's heading.

The first corner may be too sharp for its legs.  Points straight ahead and points round the first waypoint are tried
before it, and the shortest drivable path wins; a heading error at the start of the path is charged as extra length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from autonomy.localization.local_plane import wrapped
from autonomy.navigation.clothoid_path import Path, PathRefused, Point2, drivable_path
from machine.profile import Carrier

AHEAD_M: Final = (7.0, 10.0, 14.0)
ABOUT_M: Final = (10.0, 15.0)
ABOUT_POINTS: Final = 8
"""Points on each circle round the first waypoint."""
TRIAL_LEGS: Final = 3
"""Waypoints of a trial path: later ones do not depend on how it begins."""
TURN_M_RAD: Final = 8.0
"""Extra length per radian of heading error at the start of the path."""


def joining_path(here: Point2, yaw_rad: float, points: Sequence[Point2], carrier: Carrier) -> Path:
    """A path from ``here`` [m], the centre of the front axle, along ``points``.

    Raises:
        PathRefused: no path is drivable; the reason is that of the direct path.
    """
    first = points[:TRIAL_LEGS]
    best: tuple[float, list[Point2]] | None = None
    for before in _approaches(here, yaw_rad, first):
        try:
            path = drivable_path([here, *before, *first], carrier)
        except PathRefused:
            continue
        past = abs(wrapped(float(path.heading_rad[0]) - yaw_rad))
        cost = path.length_m + TURN_M_RAD * past
        if best is None or cost < best[0] - 1e-6:
            best = cost, before
    return drivable_path([here, *(best[1] if best else []), *points], carrier)


def _approaches(here: Point2, yaw_rad: float, points: Sequence[Point2]) -> Iterator[list[Point2]]:
    """Candidate points to drive through before the first one."""
    yield []
    if not points:
        return
    goal = points[0]
    ahead = [_off(here, yaw_rad, distance) for distance in AHEAD_M]
    around = [
        _off(goal, 2.0 * math.pi * k / ABOUT_POINTS, distance) for distance in ABOUT_M for k in range(ABOUT_POINTS)
    ]
    yield from ([point] for point in (*ahead, *around))
    yield from ([a, b] for a in ahead for b in around)


def _off(point: Point2, yaw_rad: float, distance_m: float) -> Point2:
    return point[0] + distance_m * math.cos(yaw_rad), point[1] + distance_m * math.sin(yaw_rad)
