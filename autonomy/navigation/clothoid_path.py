"""Drivable paths from polylines: straight legs, and corners rounded by clothoid, arc, clothoid.

``drivable_path(points, carrier)`` drops points that the line does not need, then rounds every corner within the
curvature and curvature rate of `Limits`.  A corner whose legs are too short gets the sharpest bend that the machine can
drive, and is refused when that is not enough.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from machine.geometry.carrier import turning_radius_m
from machine.profile import Carrier
from runtime.errors import TimberhandError

SPACING_M: Final = 0.05
TOLERANCE_M: Final = 0.05
"""Points this near to the line between their neighbours are dropped (Douglas and Peucker)."""
REVERSAL_M: Final = 4.0
"""A line that turns back by more than this is kept, and refused: shorter spikes are the scatter of a receiver."""
COMFORT_SHARE: Final = 0.80
"""Share of the maximum curvature used in a corner; the rest is left for correction."""
RATE_SHARE: Final = 0.70
"""Share of the articulation rate used in a corner at cruising speed."""
HARDEST_SHARE: Final = 0.95
"""Share of both where the legs are short."""
Point2 = tuple[float, float]


class PathRefused(TimberhandError, ValueError):
    """A polyline cannot be driven; the message says where and why."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Curvature [1/m] and curvature rate along the path [1/m^2]."""

    curve_1_m: float
    change_1_m2: float


@dataclass(frozen=True, slots=True)
class Path:
    """Samples at most ``SPACING_M`` apart: distance ``s_m`` (n,), ``xy_m`` (n, 2), ``heading_rad`` (n,) without jumps,
    ``curve_1_m`` (n,).  ``corners_m`` are the distances of the corners' centres.
    """

    s_m: np.ndarray
    xy_m: np.ndarray
    heading_rad: np.ndarray
    curve_1_m: np.ndarray
    corners_m: tuple[float, ...]

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(self.s_m[-1])

    def at(self, s_m: float) -> tuple[float, float, float, float]:
        """Return x, y [m], heading [rad] and curvature [1/m] at ``s_m``; the path goes on straight past either end."""
        s = min(max(s_m, 0.0), self.length_m)
        beyond = s_m - s
        i = min(bisect_right(self.s_m, s) - 1, len(self.s_m) - 2)  # called thousands of times: numpy would be slower
        from_m, to_m = self.s_m[i : i + 2].tolist()
        (x, y), (to_x, to_y) = self.xy_m[i : i + 2].tolist()
        heading, to_heading = self.heading_rad[i : i + 2].tolist()
        curve, to_curve = self.curve_1_m[i : i + 2].tolist()
        part = (s - from_m) / (to_m - from_m)
        heading += part * (to_heading - heading)
        x += part * (to_x - x) + beyond * math.cos(heading)
        y += part * (to_y - y) + beyond * math.sin(heading)
        return x, y, heading, 0.0 if beyond else curve + part * (to_curve - curve)

    def nearest(self, x_m: float, y_m: float, low_m: float = -math.inf, high_m: float = math.inf) -> float:
        """Find the distance along the path of the point nearest to (x, y) between ``low_m`` and ``high_m``; the path is
        extended straight before its start and past its end.
        """
        first, last = np.searchsorted(self.s_m, (low_m, high_m))
        first, last = int(min(first, len(self.s_m) - 1)), int(max(first + 1, last))
        off = self.xy_m[first:last] - (x_m, y_m)
        i = first + int(np.argmin(np.einsum("ij,ij->i", off, off)))
        heading = float(self.heading_rad[i])
        px, py = (float(v) for v in self.xy_m[i])
        along = (x_m - px) * math.cos(heading) + (y_m - py) * math.sin(heading)
        back = -math.inf if i == 0 else -SPACING_M
        forth = math.inf if i == len(self.s_m) - 1 else SPACING_M
        return float(self.s_m[i]) + min(max(along, back), forth)


def path_limits(carrier: Carrier, share: float = COMFORT_SHARE, rate_share: float = RATE_SHARE) -> Limits:
    """Return the limits of the machine at its cruising speed."""
    sharpest = 1.0 / turning_radius_m(carrier, carrier.articulation_limit_rad)
    articulation_rad_m = rate_share * carrier.articulation_rate_limit_rad_s / carrier.cruise_speed_m_s
    return Limits(share * sharpest, articulation_rad_m / (carrier.front_axle_m + carrier.rear_axle_m))


def drivable_path(points: Sequence[Point2], carrier: Carrier) -> Path:
    """Plan the path along ``points`` [m] in the plane.

    Raises:
        PathRefused: fewer than two different points, a non-finite point, or corners too sharp for their legs.
    """
    xy = np.asarray(points, float).reshape(-1, 2)
    if not np.all(np.isfinite(xy)):
        i = int(np.argmin(np.all(np.isfinite(xy), axis=1)))
        raise PathRefused("path.not-finite", f"point {i + 1} of the path is not finite: {tuple(xy[i].tolist())}")
    xy = _needed(xy) if len(xy) else xy
    if len(xy) < 2:
        raise PathRefused("path.too-short", "a path needs at least two different points")
    hard = path_limits(carrier, HARDEST_SHARE, HARDEST_SHARE)
    bends = _bends(xy, path_limits(carrier), hard)
    return _sampled(xy, bends)


@dataclass(frozen=True, slots=True)
class _Bend:
    """One corner: its turn [rad], its limits, and the length it needs on each leg [m]."""

    turn_rad: float
    limits: Limits
    reach_m: float


def _needed(xy: np.ndarray) -> np.ndarray:
    """Return the points without repetitions and without those close to the line, but with those where it turns back."""
    apart = np.hypot(*np.diff(xy, axis=0).T) if len(xy) > 1 else np.empty(0)
    xy = xy[np.concatenate([[True], apart > 1e-3])]
    keep = np.zeros(len(xy), bool)
    keep[[0, -1]] = True
    todo = [(0, len(xy) - 1)]
    while todo:
        a, b = todo.pop()
        if b - a < 2:
            continue
        between, leg = xy[a + 1 : b] - xy[a], xy[b] - xy[a]
        length = max(float(leg @ leg), 1e-12)
        share = np.clip(between @ leg / length, 0.0, 1.0)
        off = np.hypot(*(between - share[:, None] * leg).T)
        worst = int(np.argmax(off))
        along = between @ leg / math.sqrt(length)
        back = np.maximum.accumulate(along) - along
        turns_back = float(back.max()) > REVERSAL_M
        if turns_back:
            worst = int(np.argmax(along[: int(np.argmax(back)) + 1]))
        if turns_back or off[worst] > TOLERANCE_M:
            middle = a + 1 + worst
            keep[middle] = True
            todo += [(a, middle), (middle, b)]
    return xy[keep]


def _bends(xy: np.ndarray, soft: Limits, hard: Limits) -> list[_Bend]:
    legs = np.diff(xy, axis=0)
    lengths = np.hypot(*legs.T)
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    turns = [math.remainder(b - a, 2.0 * math.pi) for a, b in pairwise(headings)]
    bends = []
    for i, turn in enumerate(turns):
        if abs(turn) > math.radians(170.0):
            raise PathRefused("path.reverses", f"the path reverses at {_place(xy[i + 1])}; add a point beside it")
        bends.append(_Bend(turn, soft, _reach(turn, soft)))
    for i, length in enumerate(lengths):
        ends = [k for k in (i - 1, i) if 0 <= k < len(bends)]
        if sum(bends[k].reach_m for k in ends) > length:
            for k in ends:
                bends[k] = _Bend(bends[k].turn_rad, hard, _reach(bends[k].turn_rad, hard))
    for i, length in enumerate(lengths):
        needed = sum(bends[k].reach_m for k in (i - 1, i) if 0 <= k < len(bends))
        if needed > length:
            raise PathRefused(
                "path.short-leg",
                f"the leg from {_place(xy[i])} to {_place(xy[i + 1])} is {length:.1f} m long, but the bends at its "
                f"ends need {needed:.1f} m; move the points apart or make the corners less sharp",
            )
    return bends


def _place(point: np.ndarray) -> str:
    return f"({point[0]:.1f}, {point[1]:.1f}) m"


def _profile(turn_rad: float, limits: Limits) -> tuple[float, float]:
    """Compute the length of each clothoid and of the arc between them [m]."""
    size = abs(turn_rad)
    ramp = limits.curve_1_m / limits.change_1_m2
    if size < limits.curve_1_m * ramp:
        return math.sqrt(size / limits.change_1_m2), 0.0
    return ramp, size / limits.curve_1_m - ramp


def _corner(turn_rad: float, limits: Limits) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compute distance, points, heading and curvature of a corner that starts at the origin along x."""
    ramp, arc = _profile(turn_rad, limits)
    length = 2.0 * ramp + arc
    n = max(2, math.ceil(length / SPACING_M)) + 1
    s = np.linspace(0.0, length, n)
    peak = math.copysign(limits.change_1_m2 * ramp, turn_rad)
    curve = peak * np.clip(np.minimum(s, length - s) / ramp, 0.0, 1.0)
    fine = np.linspace(0.0, length, 4 * (n - 1) + 1)
    bent = peak * np.clip(np.minimum(fine, length - fine) / ramp, 0.0, 1.0)
    step = fine[1]
    heading = np.concatenate([[0.0], np.cumsum(0.5 * step * (bent[1:] + bent[:-1]))])
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(step * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(step * np.sin(middle))])
    return s, np.column_stack([x, y])[::4], heading[::4], curve


def _reach(turn_rad: float, limits: Limits) -> float:
    """Compute the distance from the start of a bend to the corner point [m]; it ends as far behind it."""
    if abs(turn_rad) < 1e-6:
        return 0.0
    return float(_corner(turn_rad, limits)[1][-1, 0]) / (1.0 + math.cos(turn_rad))


def _sampled(xy: np.ndarray, bends: Sequence[_Bend]) -> Path:
    """Compute the samples of all legs and corners in order."""
    s: list[np.ndarray] = []
    points: list[np.ndarray] = []
    headings: list[np.ndarray] = []
    curves: list[np.ndarray] = []
    corners: list[float] = []
    distance = 0.0
    heading = math.atan2(*(xy[1] - xy[0])[::-1])
    begin = 0.0
    for i in range(len(xy) - 1):
        ahead = np.array([math.cos(heading), math.sin(heading)])
        end = bends[i].reach_m if i < len(bends) else 0.0
        length = math.dist(xy[i], xy[i + 1]) - begin - end
        n = max(2, math.ceil(length / SPACING_M) + 1)
        along = np.linspace(0.0, length, n)
        s.append(distance + along)
        points.append(xy[i] + np.outer(begin + along, ahead))
        headings.append(np.full(n, heading))
        curves.append(np.zeros(n))
        distance += length
        if i < len(bends) and end > 0.0:
            ds, local, turned, curve = _corner(bends[i].turn_rad, bends[i].limits)
            side = np.array([-ahead[1], ahead[0]])
            start = xy[i + 1] - end * ahead
            s.append(distance + ds)
            points.append(start + np.outer(local[:, 0], ahead) + np.outer(local[:, 1], side))
            headings.append(heading + turned)
            curves.append(curve)
            corners.append(distance + 0.5 * float(ds[-1]))
            distance += float(ds[-1])
        if i < len(bends):
            heading += bends[i].turn_rad
        begin = end
    flat = np.concatenate(s)
    keep = np.concatenate([[True], np.diff(flat) > 1e-9])
    return Path(
        flat[keep],
        np.concatenate(points)[keep],
        np.concatenate(headings)[keep],
        np.concatenate(curves)[keep],
        tuple(corners),
    )
