"""Missions for other programs: QGroundControl ``.plan``, GPX and KML beside GeoJSON, the native format.

Only GeoJSON holds everything.  ``export`` says in words what a format leaves out; what it does write is read back to
the same mission (`autonomy.missions.mission_file.read`).  Heights are left out everywhere but in GeoJSON, because the
other formats' heights are above sea level.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from autonomy.missions import geojson
from autonomy.missions.gpx_kml_write import write_gpx, write_kml
from autonomy.missions.model import ForwardingMission, KnownLog, MissionError, Options, Point, all_points
from autonomy.missions.qgc_plan import DO_CHANGE_SPEED, NAV_WAYPOINT

_MAV_FRAME_GLOBAL_RELATIVE_ALT: Final = 3
_MAV_AUTOPILOT_ARDUPILOT: Final = 3
_MAV_TYPE_GROUND_ROVER: Final = 10


class Exported(NamedTuple):
    """A file's bytes, and what it does not hold, in words."""

    data: bytes
    left_out: tuple[str, ...]


def export(mission: ForwardingMission, kind: str) -> Exported:
    """The mission as ``kind``, one of ``FORMATS``.

    Raises:
        MissionError: there is no such format.
    """
    if kind not in FORMATS:
        raise MissionError("mission.export-format", f'"{kind}" cannot be written; formats are {", ".join(FORMATS)}')
    write, holds = FORMATS[kind]
    return Exported(write(mission), _left_out(mission, holds))


def write_plan(mission: ForwardingMission) -> bytes:
    """Route, speed and fences as a plan for a ground rover."""
    items: list[dict[str, Any]] = []
    if mission.options.speed_m_s is not None:
        items.append(_item(DO_CHANGE_SPEED, [1, mission.options.speed_m_s, -1, 0, 0, 0, 0], 1))
    for point in mission.waypoints:
        at = [0, 0, 0, None, point.latitude_deg, point.longitude_deg, 0]
        items.append(_item(NAV_WAYPOINT, at, len(items) + 1))
    polygons = [
        {"inclusion": not fence.keep_out, "polygon": [_lat_lon(p) for p in fence.corners], "version": 1}
        for fence in mission.fences
    ]
    home = next(iter(all_points(mission)), Point(0.0, 0.0))
    document = {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": polygons, "version": 2},
        "groundStation": "timberhand",
        "mission": {
            "cruiseSpeed": mission.options.speed_m_s or 1, "firmwareType": _MAV_AUTOPILOT_ARDUPILOT,
            "globalPlanAltitudeMode": 1, "hoverSpeed": 1, "items": items,
            "plannedHomePosition": [*_lat_lon(home), 0], "vehicleType": _MAV_TYPE_GROUND_ROVER, "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }  # fmt: skip
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _item(command: int, params: list[float | None], number: int) -> dict[str, Any]:
    return {
        "autoContinue": True, "command": command, "doJumpId": number, "frame": _MAV_FRAME_GLOBAL_RELATIVE_ALT,
        "params": params, "type": "SimpleItem",
    }  # fmt: skip


def _lat_lon(point: Point) -> list[float]:
    return [point.latitude_deg, point.longitude_deg]


def _left_out(mission: ForwardingMission, holds: frozenset[str]) -> tuple[str, ...]:
    """What the mission has and the format does not hold."""
    usual = Options()
    changed = [name for name in usual.__struct_fields__ if getattr(mission.options, name) != getattr(usual, name)]
    options = [name for name in changed if f"options.{name}" not in holds]
    has = {
        "name": bool(mission.name),
        "fences": bool(mission.fences),
        "names of fences": any(fence.name for fence in mission.fences),
        "landings": bool(mission.landings),
        "bearings and assortments of landings": any(
            x.assortments or x.bearing_deg is not None for x in mission.landings
        ),
        "logs": bool(mission.logs),
        "sizes, bearings and kinds of logs": any(log != KnownLog(log.position, log.key) for log in mission.logs),
        "heights": any(p.altitude_m is not None for p in all_points(mission)),
    }
    left_out = [what for what, there in has.items() if there and what not in holds]
    return (*left_out, *(f"option {name}" for name in options))


_GPX: Final = frozenset({"name", "landings", "logs"})
_KML: Final = _GPX | {
    "fences", "names of fences", "bearings and assortments of landings", "sizes, bearings and kinds of logs",
}  # fmt: skip
_ALL: Final = _KML | {"heights", *(f"options.{name}" for name in Options.__struct_fields__)}
FORMATS: Final[dict[str, tuple[Callable[[ForwardingMission], bytes], frozenset[str]]]] = {
    "geojson": (geojson.write, _ALL),
    "plan": (write_plan, frozenset({"fences", "options.speed_m_s"})),
    "gpx": (write_gpx, _GPX),
    "kml": (write_kml, _KML),
}
"""Writer of each format by its file name extension, and what it holds."""
