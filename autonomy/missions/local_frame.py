"""WGS84 to local metres and back: the east-north-up frame at one place of the site.

A point and its height belong together: the same place 100 m higher is 5 cm farther away at 3 km.  A point without a
height is therefore placed at the origin's height, and ``site_frame`` gives the origin the height of the mission's first
point that has one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pymap3d

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.model import ForwardingMission, MissionError, Point, all_points


class LocalFrame(LocalPlane):
    """The local plane for arrays of positions."""

    def enu(self, latitude_deg: np.ndarray, longitude_deg: np.ndarray, altitude_m: np.ndarray) -> np.ndarray:
        """Return the local points [m] (..., 3) of latitudes, longitudes [deg] and heights [m] of one shape."""
        origin = (self.latitude_deg, self.longitude_deg, self.altitude_m)
        return np.stack(pymap3d.geodetic2enu(latitude_deg, longitude_deg, altitude_m, *origin), axis=-1)

    def points_enu(self, points: Sequence[Point]) -> np.ndarray:
        """Return the local points [m] (n, 3); a point without a height is placed at the origin's."""
        if not points:
            return np.empty((0, 3))
        height = (self.altitude_m if p.altitude_m is None else p.altitude_m for p in points)
        table = [(p.latitude_deg, p.longitude_deg, h) for p, h in zip(points, height, strict=True)]
        latitude, longitude, altitude = np.array(table, dtype=float).T
        return self.enu(latitude, longitude, altitude)

    def point(self, east_m: float, north_m: float, up_m: float = 0.0) -> Point:
        """Return the position of local metres."""
        return Point(*self.geodetic(east_m, north_m, up_m))


def yaw_from_bearing(bearing_deg: float) -> float:
    """Convert a bearing [deg, clockwise from north] to a yaw in the local plane [rad, counter-clockwise from east]."""
    return math.radians(90.0 - bearing_deg)


def bearing_from_yaw(yaw_rad: float) -> float:
    """Convert a yaw to a bearing in [0, 360) deg, the inverse of ``yaw_from_bearing``."""
    return (90.0 - math.degrees(yaw_rad)) % 360.0


def site_frame(mission: ForwardingMission) -> LocalFrame:
    """Make the local frame of a mission; its origin is the first waypoint, else the first place of any kind.

    Raises:
        MissionError: the mission has no place.
    """
    places = all_points(mission)
    if not places:
        raise MissionError("mission.no-place", "the mission contains no place")
    known = (p.altitude_m for p in places if p.altitude_m is not None)
    return LocalFrame(places[0].latitude_deg, places[0].longitude_deg, next(known, 0.0))
