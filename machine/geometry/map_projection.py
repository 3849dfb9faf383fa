"""Local map projection: degrees to metres east and north of the first place, accurate enough to draw a site.

The error grows with the square of the distance, to some centimetres at 500 m, and is the same for all parts of the map.
"""

from __future__ import annotations

import math
from typing import Final

_A_M: Final = 6_378_137.0
_E2: Final = 0.006_694_379_990_14
"""WGS84: equatorial radius, first eccentricity squared."""

Metres = tuple[float, float]


class MapProjection:
    """Projection of the map; its origin is the first place that is projected."""

    def __init__(self) -> None:
        self._origin: tuple[float, float] | None = None
        self._scale = (0.0, 0.0)

    def metres(self, latitude_deg: float, longitude_deg: float) -> Metres:
        """Compute east and north of the origin."""
        if self._origin is None:
            s = math.sin(math.radians(latitude_deg))
            across = _A_M / math.sqrt(1.0 - _E2 * s * s)
            along = across * (1.0 - _E2) / (1.0 - _E2 * s * s)
            self._origin = (latitude_deg, longitude_deg)
            self._scale = (math.radians(across * math.cos(math.radians(latitude_deg))), math.radians(along))
        off_deg = math.remainder(longitude_deg - self._origin[1], 360.0)
        return round(off_deg * self._scale[0], 3), round((latitude_deg - self._origin[0]) * self._scale[1], 3)
