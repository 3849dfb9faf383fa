"""Measures of a drive: lateral errors of both methods, settling of the heading, consistency of the localization.

Lateral errors are distances of the true middle of the front axle.  Ours is measured from the planned path.  Paper B's
law has no path: its machine should converge to the same path from every start.  Its error is the distance from that
path, the mean of the last laps of all starts on the same ground with the same machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from autonomy.navigation.clothoid_path import Path, Point2
from autonomy.navigation.joining_path import joining_path
from experiments.navigation.trial import COLUMNS
from machine.profile import Carrier

SETTLED_RAD: Final = math.radians(5.0)
"""A corner ends when the heading is this near to the bearing."""
TURNED: Final = (0.1, 0.9)
"""Shares of the turn of a corner between which its rate is measured."""
MIN_TURN_RAD: Final = 1.0
"""A smaller turn is not a corner."""
STRAIGHT_1_M: Final = 1e-6
SAMPLE_COUNT: Final = 1200
"""Points of the mean lap."""
PASS_M: Final = 12.0
Array = np.ndarray


class Drive:
    """The rows of one outcome as columns by name, and the driven distance ``distance_m``."""

    def __init__(self, outcome: dict[str, Any]) -> None:
        rows = np.array([[math.nan if v is None else v for v in row] for row in outcome["rows"]], float)
        self._rows = rows.reshape(-1, len(COLUMNS))
        steps = np.hypot(np.diff(self["x_m"]), np.diff(self["y_m"]))
        self.distance_m = np.concatenate([[0.0], np.cumsum(steps)])[: len(self._rows)]
        self.outcome = outcome

    def __getitem__(self, column: str) -> Array:
        return self._rows[:, COLUMNS.index(column)]

    def __len__(self) -> int:
        return len(self._rows)


def heading_error(drive: Drive, points: Sequence[Point2]) -> Array:
    """Compute the bearing to the waypoint less heading [rad], as paper B's Fig. 14 (n,)."""
    goals = np.array(points)[drive["goal"].astype(int)]
    bearing = np.arctan2(goals[:, 1] - drive["y_m"], goals[:, 0] - drive["x_m"])
    error: Array = np.remainder(bearing - drive["yaw_rad"] + math.pi, 2.0 * math.pi) - math.pi
    return error


def after_first_corner(drive: Drive, points: Sequence[Point2]) -> int:
    """Find the row at which a drive by paper B's law has turned to the second waypoint; the row count if never."""
    error = np.abs(heading_error(drive, points))
    return int(np.argmax(np.append((drive["goal"] >= 1) & (error < SETTLED_RAD), True)))


def last_lap(drive: Drive, points: Sequence[Point2], lap: int) -> Array:
    """Return the positions (n, 2) from the switch after the last waypoint but ``lap`` to the end; ``lap`` waypoints
    make a lap.
    """
    rows = drive["goal"] >= len(points) - lap
    return np.column_stack([drive["x_m"], drive["y_m"]])[rows]


def common_path(laps: Sequence[Array]) -> Array:
    """Compute the mean (``SAMPLE_COUNT``, 2) of laps, each at equal shares of its length."""
    out = np.zeros((SAMPLE_COUNT, 2))
    for lap in laps:
        travel_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lap, axis=0).T))])
        share = np.linspace(0.0, travel_m[-1], SAMPLE_COUNT)
        out += np.column_stack([np.interp(share, travel_m, lap[:, k]) for k in (0, 1)]) / len(laps)
    return out


def distances(xy: Array, line: Array) -> Array:
    """Compute the distance from each point (n, 2) to the nearest of the line's segments (m, 2) [m]."""
    start, leg = line[:-1], np.diff(line, axis=0)
    square = np.maximum(np.einsum("ij,ij->i", leg, leg), 1e-12)
    out = np.empty(len(xy))
    for i, point in enumerate(xy):
        share = np.clip(np.einsum("ij,ij->i", point - start, leg) / square, 0.0, 1.0)
        off = point - start - share[:, None] * leg
        out[i] = math.sqrt(float(np.min(np.einsum("ij,ij->i", off, off))))
    return out


def convergence_errors(drives: Sequence[Drive], points: Sequence[Point2], lap: int) -> list[tuple[Array, Array]]:
    """Compute for each start the distance from the common path after the first corner, before and on the last lap."""
    line = common_path([last_lap(d, points, lap) for d in drives])
    out = []
    for drive in drives:
        begin = after_first_corner(drive, points)
        off = distances(np.column_stack([drive["x_m"], drive["y_m"]])[begin:], line)
        last = drive["goal"][begin:] >= len(points) - lap
        out.append((off[~last], off[last]))
    return out


def planned(drive: Drive, points: Sequence[Point2], carrier: Carrier) -> Path:
    """Compute the path that the machine planned, from its estimated start."""
    x, y, yaw = drive.outcome["begin"]
    return joining_path((x, y), yaw, points, carrier)


def lateral(drive: Drive, path: Path) -> tuple[Array, Array]:
    """Compute the distance along the path and from it (+ left) [m] of every row."""
    ways, offs = np.empty(len(drive)), np.empty(len(drive))
    s: float | None = None
    for i, (x, y) in enumerate(zip(drive["x_m"], drive["y_m"], strict=True)):
        s = path.nearest(x, y) if s is None else path.nearest(x, y, s - 1.0, s + 2.0)
        px, py, heading, _ = path.at(s)
        ways[i], offs[i] = s, -math.sin(heading) * (x - px) + math.cos(heading) * (y - py)
    return ways, offs


def corner_end_m(path: Path, corner: Point2) -> float:
    """End of the first bend of the path about ``corner`` [m]."""
    away = np.hypot(*(path.xy_m - corner).T)
    near = np.flatnonzero(away < PASS_M)
    gaps = np.flatnonzero(np.diff(near) > 1)
    first = near[: gaps[0] + 1] if len(gaps) else near
    middle = first[int(np.argmin(away[first]))]
    straight = np.flatnonzero(np.abs(path.curve_1_m[middle + 1 :]) < STRAIGHT_1_M)
    return float(path.s_m[middle + 1 + straight[0]]) if len(straight) else path.length_m


def turn_rates(drive: Drive) -> tuple[list[float], list[float]]:
    """Turn of the front per metre [deg/m] in each corner of a drive by paper B's law.

    First between the shares ``TURNED`` of the corner, second while the articulation was at its limit.
    """
    rates, fulls = [], []
    goal = drive["goal"].astype(int)
    yaw, limit = np.unwrap(drive["yaw_rad"]), float(np.max(np.abs(drive["bend_rad"]), initial=0.0))
    for k in range(1, int(goal.max(initial=0)) + 1):
        rows = np.flatnonzero(goal == k)
        if len(rows) < 3:
            continue
        turned, travel_m = np.abs(yaw[rows] - yaw[rows[0]]), drive.distance_m[rows]
        if turned[-1] < MIN_TURN_RAD:
            continue
        a, b = (travel_m[int(np.argmax(turned >= share * turned[-1]))] for share in TURNED)
        rates.append(math.degrees((TURNED[1] - TURNED[0]) * turned[-1]) / (b - a))
        full = np.flatnonzero(np.abs(drive["bend_rad"][rows]) > 0.98 * limit)
        if len(full) > 3:
            i, j = rows[full[0]], rows[full[-1]]
            fulls.append(math.degrees(abs(yaw[j] - yaw[i])) / (drive.distance_m[j] - drive.distance_m[i]))
    return rates, fulls


def located(drive: Drive) -> Array:
    """Compute the error of the estimated position [m]."""
    error: Array = np.hypot(drive["seen_x_m"] - drive["x_m"], drive["seen_y_m"] - drive["y_m"])
    return error
