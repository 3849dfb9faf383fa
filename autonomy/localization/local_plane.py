"""The local plane for localization and driving: x east, y north, z up [m] about a WGS84 origin (ENU, ROS REP 103).

Angles in the plane are counter-clockwise from east; headings and bearings, clockwise from true north, are only used on
the bus and in the controller's reports.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pymap3d

from machine.geometry.carrier import Point
from runtime.errors import InputRefused


@dataclass(frozen=True, slots=True)
class LocalPlane:
    """East-north-up frame about an origin in degrees and metres above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    def __post_init__(self) -> None:
        good = abs(self.latitude_deg) <= 90.0 and abs(self.longitude_deg) <= 180.0 and math.isfinite(self.altitude_m)
        if not good:
            raise InputRefused(
                "plane.origin",
                f"invalid origin of the local plane: latitude {self.latitude_deg} deg, longitude "
                f"{self.longitude_deg} deg, altitude {self.altitude_m} m",
            )

    def local(self, latitude_deg: float, longitude_deg: float, altitude_m: float | None = None) -> Point:
        """Return east, north and up [m]; a point without an altitude is at that of the origin."""
        altitude = self.altitude_m if altitude_m is None else altitude_m
        e, n, u = pymap3d.geodetic2enu(
            latitude_deg, longitude_deg, altitude, self.latitude_deg, self.longitude_deg, self.altitude_m
        )
        return float(e), float(n), float(u)

    def geodetic(self, east_m: float, north_m: float, up_m: float = 0.0) -> Point:
        """Return latitude and longitude [deg] and altitude [m]."""
        lat, lon, altitude = pymap3d.enu2geodetic(
            east_m, north_m, up_m, self.latitude_deg, self.longitude_deg, self.altitude_m
        )
        return float(lat), float(lon), float(altitude)


def wrapped(angle_rad: float) -> float:
    """Return the same direction between -pi and pi."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def yaw_from_heading(heading_rad: float) -> float:
    """Convert a heading, clockwise from north, to a yaw, counter-clockwise from east."""
    return wrapped(0.5 * math.pi - heading_rad)
