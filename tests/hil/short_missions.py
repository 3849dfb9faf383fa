"""Short missions as files, for tests that drive one."""

from __future__ import annotations

from pathlib import Path

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.mission_file import save_mission
from autonomy.missions.model import ForwardingMission, KnownLog, Point

PLANE = LocalPlane(63.657853, 19.895562)


def point(east_m: float, north_m: float) -> Point:
    """A point of the plane in geodetic coordinates."""
    return Point(*PLANE.geodetic(east_m, north_m)[:2])


def mission_file(path: Path, *logs: tuple[float, float, float]) -> Path:
    """A route of 18 m to the east, and logs beside it (east, north [m], bearing [deg])."""
    known = tuple(KnownLog(point(e, n), bearing_deg=b, length_m=2.0, diameter_m=0.25) for e, n, b in logs)
    save_mission(path, ForwardingMission("short", (point(0.0, 0.0), point(18.0, 0.0)), logs=known))
    return path
