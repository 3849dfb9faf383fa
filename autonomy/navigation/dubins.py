"""Turning manoeuvres between two headings: two arcs and a straight line (Dubins 1957).

Each is given by the corners of polygons round its arcs; `autonomy.navigation.clothoid_path.drivable_path` rounds them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from autonomy.navigation.clothoid_path import Point2

Heading = tuple[float, float, float]
"""A position [m] and a direction [rad]."""


def dubins_corners(start: Heading, goal: Heading, radius_m: float) -> Iterator[list[Point2]]:
    """Corner points of all manoeuvres from one heading to another with two arcs of a radius, the shortest first."""
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
    """Centre of the turning circle to the left (1) or right (-1)."""
    x, y, yaw = at
    return x - side * radius_m * math.sin(yaw), y + side * radius_m * math.cos(yaw)


def _angle(turn_rad: float) -> float:
    """Angle of an arc, 0 to 2 pi; a rounding error does not become a full circle."""
    angle = turn_rad % (2.0 * math.pi)
    return 0.0 if angle > 2.0 * math.pi - 1e-6 else angle


def _corners(at: Heading, side: float, angle_rad: float, radius_m: float) -> list[Point2]:
    """Corners round an arc from a heading to the left (1) or right (-1); none turns by more than a right angle."""
    x, y, yaw = at
    count = math.ceil(angle_rad / (0.5 * math.pi) - 1e-9)
    found = []
    for _ in range(count):
        reach_m = radius_m * math.tan(0.5 * angle_rad / count)
        x, y = x + reach_m * math.cos(yaw), y + reach_m * math.sin(yaw)
        found.append((x, y))
        yaw += side * angle_rad / count
        x, y = x + reach_m * math.cos(yaw), y + reach_m * math.sin(yaw)
    return found
