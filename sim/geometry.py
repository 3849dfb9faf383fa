"""Plain geometry of the plant: boxes, vectors and rotations, and local metres to WGS-84."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# -- Boxes, vectors and rotations: the plant's bodies consist of boxes, for collision, drawing and the cameras.

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Shape:
    """A box: full edge lengths [m] and pose in the frame of ``link``; ``solid`` ones collide, others are only drawn."""

    link: str
    size_m: Vector
    position_m: Vector
    quaternion: Quaternion
    colour: Vector
    solid: bool = True


def rpy_quaternion(roll: float, pitch: float, yaw: float = 0.0) -> Quaternion:
    """Compute the quaternion (x, y, z, w) of rotations about the fixed axes x, then y, then z [rad], as URDF's rpy."""
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def quaternion_rpy(q: Quaternion) -> Vector:
    """Compute roll, pitch, yaw [rad] of a quaternion (x, y, z, w): the inverse of ``rpy_quaternion``."""
    x, y, z, w = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return (roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


# -- Local metres to WGS-84: a point in an east-north-up frame as latitude, longitude and height.
#
# Exact to far below a millimetre near the surface: rotation into the Earth-centred frame, then one step of
# Bowring's formula (B. R. Bowring, Survey Review 1976).  Angles in degrees, lengths in m, heights above the
# ellipsoid.

SEMI_MAJOR_AXIS_M: Final = 6378137.0
FLATTENING: Final = 1.0 / 298.257223563
SEMI_MINOR_AXIS_M: Final = SEMI_MAJOR_AXIS_M * (1.0 - FLATTENING)
ECCENTRICITY_SQUARED: Final = FLATTENING * (2.0 - FLATTENING)
SECOND_ECCENTRICITY_SQUARED: Final = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
Geodetic = tuple[float, float, float]


class LocalFrame:
    """The local frame with its origin at a latitude, longitude and height; x east, y north, z up."""

    def __init__(self, lat_deg: float, lon_deg: float, height_m: float = 0.0) -> None:
        lat, lon = math.radians(lat_deg), math.radians(lon_deg)
        self._sin_lat, self._cos_lat, self._sin_lon, self._cos_lon = (
            math.sin(lat),
            math.cos(lat),
            math.sin(lon),
            math.cos(lon),
        )
        n = SEMI_MAJOR_AXIS_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * self._sin_lat**2)
        across = (n + height_m) * self._cos_lat
        self._origin = (
            across * self._cos_lon,
            across * self._sin_lon,
            (n * (1.0 - ECCENTRICITY_SQUARED) + height_m) * self._sin_lat,
        )

    def geodetic(self, east_m: float, north_m: float, up_m: float) -> Geodetic:
        """Compute latitude and longitude [deg] and height [m] of a local point."""
        out = self._cos_lat * up_m - self._sin_lat * north_m
        x = self._origin[0] + self._cos_lon * out - self._sin_lon * east_m
        y = self._origin[1] + self._sin_lon * out + self._cos_lon * east_m
        z = self._origin[2] + self._sin_lat * up_m + self._cos_lat * north_m
        p = math.hypot(x, y)
        parametric = math.atan2(z * SEMI_MAJOR_AXIS_M, p * SEMI_MINOR_AXIS_M)
        lat = math.atan2(
            z + SECOND_ECCENTRICITY_SQUARED * SEMI_MINOR_AXIS_M * math.sin(parametric) ** 3,
            p - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS_M * math.cos(parametric) ** 3,
        )
        s, c = math.sin(lat), math.cos(lat)
        height = p * c + z * s - SEMI_MAJOR_AXIS_M * math.sqrt(1.0 - ECCENTRICITY_SQUARED * s * s)
        return math.degrees(lat), math.degrees(math.atan2(y, x)), height
