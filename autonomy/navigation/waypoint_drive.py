"""Paper B's drive (3.2.1): head for a waypoint, and switch to the next one within a distance of the steering radius.

The steering loop is closed in the controller; this module switches the waypoints.  The position of the front axle is
the receiver's, unfiltered as in the paper.  The switching distance is R tan(turn / 2), with the radius R at full
articulation and the turn at the waypoint: what a circle needs (docs/reference/machines.md section 7.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from autonomy.localization.local_plane import LocalPlane, wrapped, yaw_from_heading
from autonomy.navigation.drive_request import DriveRequest
from can_dbc.messages.vehicle import Steering, VehicleReport
from machine.geometry.carrier import turning_radius_m
from machine.profile import Carrier
from runtime.errors import InputRefused

MIN_SWITCH_M: Final = 1.0
"""Least switching distance; with less, a machine that misses a waypoint would circle round it."""
MAX_SWITCH_M: Final = 12.0
FRESH_NS: Final = 500_000_000


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A position in WGS84 [deg]."""

    latitude_deg: float
    longitude_deg: float


class WaypointDrive:
    """One drive along ``waypoints``; ``number`` is the index of the current one.

    The last one is reached within ``MIN_SWITCH_M``, or once it lies behind the machine.
    """

    def __init__(self, carrier: Carrier, waypoints: Sequence[Waypoint], speed_m_s: float | None = None) -> None:
        if not waypoints:
            raise InputRefused("path.no-waypoints", "a drive needs at least one waypoint")
        self.number = 0
        self._plane = LocalPlane(waypoints[0].latitude_deg, waypoints[0].longitude_deg)
        self._waypoints = tuple(waypoints)
        self._points = [self._plane.local(w.latitude_deg, w.longitude_deg)[:2] for w in waypoints]
        self._ahead_m = carrier.front_axle_m - carrier.antenna_main_m[0]
        self._radius_m = turning_radius_m(carrier, carrier.articulation_limit_rad)
        self._speed = carrier.cruise_speed_m_s if speed_m_s is None else speed_m_s
        self._from: tuple[float, float] | None = None

    def switch_m(self, number: int) -> float:
        """Compute the distance from a waypoint at which the next one becomes the goal [m]."""
        if self._from is None or number + 1 >= len(self._points):
            return MIN_SWITCH_M
        before = self._points[number - 1] if number else self._from
        waypoint, after = self._points[number], self._points[number + 1]
        turn = wrapped(_bearing(waypoint, after) - _bearing(before, waypoint))
        return min(MAX_SWITCH_M, max(MIN_SWITCH_M, self._radius_m * math.tan(min(abs(turn), 3.0) / 2.0)))

    def step(self, report: VehicleReport) -> DriveRequest:
        """Compute the drive request for one report."""
        has_position = report.position_ns and report.stamp_ns - report.position_ns <= FRESH_NS
        if not has_position or not math.isfinite(report.latitude_deg + report.longitude_deg):
            return DriveRequest(Steering.WAYPOINT, stop_reason="no position from the receiver")
        if not math.isfinite(report.heading_rad) or report.stamp_ns - report.heading_ns > FRESH_NS:
            return DriveRequest(Steering.WAYPOINT, stop_reason="no heading from the receiver")
        east, north, _ = self._plane.local(report.latitude_deg, report.longitude_deg)
        yaw = yaw_from_heading(report.heading_rad)
        at = east + self._ahead_m * math.cos(yaw), north + self._ahead_m * math.sin(yaw)
        if self._from is None:
            self._from = at
        while math.dist(at, self._points[self.number]) <= self.switch_m(self.number):
            if self.number + 1 == len(self._points):
                return self._order(0.0, arrived=True)
            self.number += 1
        last = self.number + 1 == len(self._points)
        if last and self._behind(at):
            return self._order(0.0, arrived=True)
        return self._order(self._speed)

    def _behind(self, at: tuple[float, float]) -> bool:
        """Tell whether the machine has passed the current waypoint in the direction of its leg."""
        assert self._from is not None
        before = self._points[self.number - 1] if self.number else self._from
        goal = self._points[self.number]
        return (at[0] - goal[0]) * (goal[0] - before[0]) + (at[1] - goal[1]) * (goal[1] - before[1]) > 0.0

    def _order(self, speed_m_s: float, arrived: bool = False) -> DriveRequest:
        goal = self._waypoints[self.number]
        return DriveRequest(Steering.WAYPOINT, goal.latitude_deg, goal.longitude_deg, 0.0, 0.0, speed_m_s, arrived)


def _bearing(a: tuple[float, float], b: tuple[float, float]) -> float:
    return math.atan2(b[1] - a[1], b[0] - a[0])
