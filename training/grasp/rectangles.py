"""Grasp rectangles and the rectangle metric for grasps on pictures (paper A II-D, after Jiang et al. 2011).

A rectangle is its centre [px], the direction in which the jaws close (x is_correct, y down), the opening along it and
the size of the jaws across it.  A grasp is correct when its intersection over union with one labelled rectangle is more
than a quarter and its direction differs by less than 30 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

MIN_IOU: Final = 0.25
MAX_ANGLE_RAD: Final = math.radians(30.0)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A grasp rectangle in a picture."""

    u_px: float
    v_px: float
    theta_rad: float
    opening_px: float
    jaw_px: float

    def corners(self) -> np.ndarray:
        """Its corners (4, 2) [px] in order; the first edge runs along the opening."""
        along = 0.5 * self.opening_px * np.array([math.cos(self.theta_rad), math.sin(self.theta_rad)])
        across = 0.5 * self.jaw_px * np.array([-math.sin(self.theta_rad), math.cos(self.theta_rad)])
        middle = np.array([self.u_px, self.v_px])
        return np.array(
            [middle - along - across, middle + along - across, middle + along + across, middle - along + across]
        )


def from_corners(corners: np.ndarray) -> Rectangle:
    """The rectangle of four corners (4, 2) as in the Cornell data, where hand-drawn ones are slightly skewed."""
    (p0, p1, p2, _), (u, v) = corners, corners.mean(axis=0)
    along, across = p1 - p0, p2 - p1
    theta = wrapped(math.atan2(along[1], along[0]))
    return Rectangle(float(u), float(v), theta, float(np.hypot(*along)), float(np.hypot(*across)))


def wrapped(theta_rad: float) -> float:
    """The direction in [-pi/2, pi/2), because half a turn does not change a grasp."""
    return (theta_rad + math.pi / 2) % math.pi - math.pi / 2


def angle_between(a_rad: float, b_rad: float) -> float:
    """The angle between two directions, 0 to pi/2."""
    return abs(wrapped(a_rad - b_rad))


def iou(a: Rectangle, b: Rectangle) -> float:
    """Exact intersection over union."""
    shared = _area(_clipped(a.corners(), b.corners()))
    return shared / (a.opening_px * a.jaw_px + b.opening_px * b.jaw_px - shared)


def is_correct(grasp: Rectangle, labels: Iterable[Rectangle]) -> bool:
    """Whether the grasp is correct for one of the labels."""
    return any(
        angle_between(grasp.theta_rad, label.theta_rad) < MAX_ANGLE_RAD and iou(grasp, label) > MIN_IOU
        for label in labels
    )


def _clipped(polygon: np.ndarray, window: np.ndarray) -> np.ndarray:
    """The part of a convex polygon inside a convex window of the same turning sense (Sutherland and Hodgman 1974)."""
    for start, end in zip(window, np.roll(window, -1, axis=0), strict=True):
        if len(polygon) == 0:
            break
        edge = end - start
        inside = edge[0] * (polygon[:, 1] - start[1]) - edge[1] * (polygon[:, 0] - start[0])
        kept = []
        for i, here in enumerate(inside):
            before = inside[i - 1]
            if (here >= 0.0) != (before >= 0.0):
                kept.append(polygon[i - 1] + before / (before - here) * (polygon[i] - polygon[i - 1]))
            if here >= 0.0:
                kept.append(polygon[i])
        polygon = np.array(kept)
    return polygon


def _area(polygon: np.ndarray) -> float:
    if len(polygon) < 3:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
