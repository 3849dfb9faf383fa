"""Where a log that is let go over a bunk comes to lie: the heap seen along the bunk, logs as circles between stakes.

A log drops onto what is below it and rolls down to the nearest hollow; logs that lie askew count where they are at
both ends and in the middle of the new one.  Nothing is pushed aside: real heaps settle a little lower.  Inputs: the
bunk, the logs that may lie in it, the new log.  No clock, no randomness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, hypot, sin
from typing import Final

import numpy as np

from autonomy.perception.log_list.observation import LogObservation
from machine.profile import Bunk

GRID_M: Final = 0.01
RELEASE_ERROR_M: Final = 0.05
"""A log that is let go is so far beside where it was to be: tracking error, sway, a bent log."""
OPENING_CLEARANCE_M: Final = 0.17
"""What the tongs need beside a log while they open: its tips' way, and their thickness."""
_DROP_COST: Final = 0.6
"""A fall of a metre is worth so much height: what drops far may roll on or push others."""
_SPREAD_COST: Final = 2.0
"""A spread of a metre of where it comes to lie (a standard deviation) is worth so much height: what is let go on top
of another log rolls to either side, or stays there, and the last ones lie over the stakes."""
_COST_GRAIN_M: Final = 0.03
"""Places that differ by less are as good as each other."""
_ROLL_GRAIN_M: Final = 0.1
"""A log that rolls less far comes to lie where it was let go."""
_SECTION_SHARE: Final = 0.35
"""Sections through the new log, in its lengths from the middle."""


@dataclass(frozen=True, slots=True)
class RestingPlace:
    """A place across the bunk [m, from its middle] with the height of what is under the log and the tongs there, and
    the height at which the log's own middle comes to rest at the worst, m.
    """

    across_m: float
    support_z_m: float
    rest_z_m: float


class BunkLoad:
    """What lies in a bunk, for one log of the given diameter and length [m] that is laid along its middle line."""

    def __init__(self, bunk: Bunk, logs: Sequence[LogObservation], diameter_m: float, length_m: float) -> None:
        self._radius_m = radius = diameter_m / 2
        half = max(bunk.width_m / 2 - radius, 0.0)
        steps = int(half / GRID_M)
        self._across = np.arange(-steps, steps + 1) * GRID_M
        sections = np.array([-_SECTION_SHARE, 0.0, _SECTION_SHARE]) * length_m
        across, height, other = _sections(bunk, logs, sections)
        beside = np.abs(self._across[:, None] - across)
        wide = radius + other
        over = height + np.sqrt(np.maximum(wide**2 - beside**2, 0.0))
        self._bed = np.max(np.where(beside < wide, over, -np.inf), axis=1, initial=bunk.floor_z_m + radius)
        self._empty = bool(np.all(self._bed <= bunk.floor_z_m + radius))
        near = np.where(beside < wide + OPENING_CLEARANCE_M, height + other, -np.inf)
        self._under = np.max(near, axis=1, initial=bunk.floor_z_m)
        self._hollow = _hollows(self._bed)
        self._rest = self._bed[self._hollow]

    def at(self, across_m: float) -> RestingPlace:
        """What a log that is let go there comes to; beyond the stakes it counts as beside them."""
        return self._found(int(np.argmin(np.abs(self._across - across_m))))

    def falls(self, across_m: float) -> tuple[float, float]:
        """Where the middle of a log that is let go there comes to lie: across the bunk and its height, m."""
        i = int(self._hollow[np.argmin(np.abs(self._across - across_m))])
        return float(self._across[i]), float(self._bed[i])

    def lowest(self, reach_m: float) -> RestingPlace:
        """Where, at most ``reach_m`` from the middle, it comes to lie lowest.

        Of places as good as each other those where it rolls least, of these the middle of an empty bunk, then those by
        the stakes: what lies there cannot roll, and the middle fills by itself.
        """
        places = np.flatnonzero(np.abs(self._across) <= reach_m + 0.5 * GRID_M)
        found = [(i, self._found(int(i))) for i in places] or [(0, self.at(0.0))]
        sign = 1.0 if self._empty else -1.0

        def worth(item: tuple[int, RestingPlace]) -> tuple[int, int, float]:
            i, rest = item
            low = self._mean(i)
            cost = low + _DROP_COST * (rest.support_z_m + self._radius_m - low) + _SPREAD_COST * self._spread(i)
            rolls = abs(float(self._across[self._hollow[i]]) - rest.across_m)
            return round(cost / _COST_GRAIN_M), round(rolls / _ROLL_GRAIN_M), sign * abs(rest.across_m)

        return min(found, key=worth)[1]

    def _around(self, i: int, off_m: float = RELEASE_ERROR_M) -> slice:
        few = round(off_m / GRID_M)
        return slice(max(i - few, 0), i + few + 1)

    def _mean(self, i: int) -> float:
        return float(np.mean(self._rest[self._around(i)]))

    def _spread(self, i: int) -> float:
        """How much more what it comes to varies than the places it may be let go at."""
        around = self._around(i, 2.0 * RELEASE_ERROR_M)
        return max(float(np.std(self._across[self._hollow[around]]) - np.std(self._across[around])), 0.0)

    def _found(self, i: int) -> RestingPlace:
        return RestingPlace(float(self._across[i]), float(self._under[i]), float(np.max(self._rest[self._around(i)])))


def log_in_bunk(bunk: Bunk, log: LogObservation) -> tuple[float, float]:
    """How far along and across a bunk from its middle a log's centre is, m."""
    return point_in_bunk(bunk, log.center_m[0], log.center_m[1])


def point_in_bunk(bunk: Bunk, x_m: float, y_m: float) -> tuple[float, float]:
    """How far along and across a bunk from its middle a point is, m."""
    return _rotated(bunk, x_m - bunk.center_m[0], y_m - bunk.center_m[1])


def is_over_bunk(bunk: Bunk, x_m: float, y_m: float) -> bool:
    """Whether a point is between the stakes, seen from above."""
    along, across = point_in_bunk(bunk, x_m, y_m)
    return abs(along) <= bunk.length_m / 2 and abs(across) <= bunk.width_m / 2


def settled_in_bunk(bunk: Bunk, log: LogObservation, logs: Sequence[LogObservation]) -> LogObservation:
    """A log that was let go over a bunk in which others lie, as it then lies; one beside the bunk stays as it is."""
    if not is_over_bunk(bunk, *log.center_m[:2]):
        return log
    across = log_in_bunk(bunk, log)[1]
    at, z = BunkLoad(bunk, logs, log.diameter_m, log.length_m).falls(across)
    c, s, aside = cos(bunk.yaw_rad), sin(bunk.yaw_rad), at - across
    level = hypot(*log.axis[:2])
    axis = (log.axis[0] / level, log.axis[1] / level, 0.0) if level > 0.0 else log.axis
    x, y, _ = log.center_m
    return replace(log, center_m=(x - s * aside, y + c * aside, z), axis=axis, covariance=None)


def _rotated(bunk: Bunk, x: float, y: float) -> tuple[float, float]:
    c, s = cos(bunk.yaw_rad), sin(bunk.yaw_rad)
    return x * c + y * s, -x * s + y * c


def _sections(bunk: Bunk, logs: Sequence[LogObservation], along: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places across and heights of the logs' axes, and their radii, in sections through the bunk, for all that reach
    them.
    """
    cuts = []
    for log in logs:
        middle = log_in_bunk(bunk, log)
        ahead, aside = _rotated(bunk, log.axis[0], log.axis[1])
        if abs(ahead) < _SECTION_SHARE:  # it lies across: as if it were everywhere between its ends
            ahead = _SECTION_SHARE if ahead >= 0.0 else -_SECTION_SHARE
        for at in along - middle[0]:
            share = at / ahead
            if abs(share) <= log.length_m / 2 + log.diameter_m / 2:
                rise = share * log.axis[2]
                cuts.append((middle[1] + share * aside, log.center_m[2] + rise, log.diameter_m / 2))
    across, height, radius = np.array(cuts).reshape(-1, 3).T
    return across, height, radius


def _hollows(bed: np.ndarray) -> np.ndarray:
    """For every place the index of the hollow that a log rolls down to from there; level ground keeps it."""
    last = len(bed) - 1
    to = np.full(len(bed), -1)
    for begin in np.argsort(bed, kind="stable"):  # the lowest first: what rolls comes to a place that is known
        i = int(begin)
        sides = [k for k in (i - 1, i + 1) if 0 <= k <= last and bed[k] < bed[i] - 1e-9]
        to[i] = to[min(sides, key=lambda k: float(bed[k]))] if sides else i
    return to
