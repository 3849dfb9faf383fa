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
    """Plan a path from ``here`` [m], the centre of the front axle, along ``points``.

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
    """Yield candidate points to drive through before the first one."""
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


# -- Turning manoeuvres between two headings: two arcs and a straight line (Dubins 1957).
#
# Each is given by the corners of polygons round its arcs; `autonomy.navigation.clothoid_path.drivable_path` rounds
# them.

Heading = tuple[float, float, float]
"""A position [m] and a direction [rad]."""


def dubins_corners(start: Heading, goal: Heading, radius_m: float) -> Iterator[list[Point2]]:
    """Yield the corner points of all manoeuvres from one heading to another with two arcs of a radius, the shortest
    first.
    """
    manoeuvres = []
    for first in (1.0, -1.0):
        for last in (1.0, -1.0):
            begin, end = _circle_centre(start, first, radius_m), _circle_centre(goal, last, radius_m)
            centre_distance = math.dist(begin, end)
            straight = math.atan2(end[1] - begin[1], end[0] - begin[0])
            if first != last:
                if centre_distance < 2.0 * radius_m:
                    continue  # the circles overlap: no straight line leads from one side to the other
                straight += first * math.asin(2.0 * radius_m / centre_distance)
            out, back = _angle(first * (straight - start[2])), _angle(last * (goal[2] - straight))
            along = centre_distance if first == last else math.sqrt(centre_distance**2 - 4.0 * radius_m**2)
            manoeuvres.append((radius_m * (out + back) + along, first, out, last, back))
    for _, first, out, last, back in sorted(manoeuvres):
        onto = (goal[0], goal[1], goal[2] + math.pi)
        yield [*_corners(start, first, out, radius_m), *reversed(_corners(onto, -last, back, radius_m))]


def _circle_centre(at: Heading, side: float, radius_m: float) -> Point2:
    """Compute the centre of the turning circle to the left (1) or right (-1)."""
    x, y, yaw = at
    return x - side * radius_m * math.sin(yaw), y + side * radius_m * math.cos(yaw)


def _angle(turn_rad: float) -> float:
    """Compute the angle of an arc, 0 to 2 pi; a rounding error does not become a full circle."""
    angle = turn_rad % (2.0 * math.pi)
    return 0.0 if angle > 2.0 * math.pi - 1e-6 else angle


def _corners(at: Heading, side: float, angle_rad: float, radius_m: float) -> list[Point2]:
    """Compute the corners round an arc from a heading to the left (1) or right (-1); none turns by more than a right
    angle.
    """
    x, y, yaw = at
    count = math.ceil(angle_rad / (0.5 * math.pi) - 1e-9)
    corner_points = []
    for _ in range(count):
        reach_m = radius_m * math.tan(0.5 * angle_rad / count)
        x, y = x + reach_m * math.cos(yaw), y + reach_m * math.sin(yaw)
        corner_points.append((x, y))
        yaw += side * angle_rad / count
        x, y = x + reach_m * math.cos(yaw), y + reach_m * math.sin(yaw)
    return corner_points
