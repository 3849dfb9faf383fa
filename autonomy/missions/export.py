"""Missions for other programs: QGroundControl ``.plan``, GPX and KML beside GeoJSON, the native format.

Only GeoJSON holds everything.  ``export`` says in words what a format leaves out; what it does write is read back to
the same mission (`autonomy.missions.mission_file.read`).  Heights are left out everywhere but in GeoJSON, because the
other formats' heights are above sea level.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from decimal import Decimal
from typing import Any, Final, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from autonomy.missions import geojson
from autonomy.missions.gpx_kml import LANDING_ASSORTMENT
from autonomy.missions.model import Fence, ForwardingMission, KnownLog, MissionError, Options, Point, all_points
from autonomy.missions.qgc_plan import DO_CHANGE_SPEED, NAV_WAYPOINT

# -- Writes GPX 1.1 and KML 2.2; `autonomy.missions.gpx_kml` reads both back.
#
# In KML every property is extended data, including ``role``, so that only options and heights are lost.  In GPX the
# route is a route, and landings and logs are waypoints whose ``type`` is their role.


_NO_XML: Final = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold (section 2.2)."""


def write_gpx(mission: ForwardingMission) -> bytes:
    """Write name, route, landings and logs."""
    root = Element("gpx", version="1.1", creator="timberhand", xmlns="http://www.topografix.com/GPX/1/1")
    if mission.name:
        _text(SubElement(root, "metadata"), "name", mission.name)
    named = [(x.position, x.name, "landing") for x in mission.landings]
    for point, name, role in [*named, *((log.position, log.key, "log") for log in mission.logs)]:
        at = _gpx_point(root, "wpt", point)
        _text(at, "name", name)
        _text(at, "type", role)
    if mission.waypoints:
        route = SubElement(root, "rte")
        for point in mission.waypoints:
            _gpx_point(route, "rtept", point)
    return _bytes(root)


def _gpx_point(parent: Element, name: str, point: Point) -> Element:
    return SubElement(parent, name, lat=_decimal(point.latitude_deg), lon=_decimal(point.longitude_deg))


def write_kml(mission: ForwardingMission) -> bytes:
    """Write everything but options and heights."""
    root = Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = SubElement(root, "Document")
    _text(document, "name", mission.name)
    if len(mission.waypoints) == 1:
        _coordinates(SubElement(_placemark(document, "Route", role="waypoint"), "Point"), mission.waypoints)
    elif mission.waypoints:
        _coordinates(SubElement(_placemark(document, "Route", role="route"), "LineString"), mission.waypoints)
    for fence in mission.fences:
        _fence(document, fence)
    for landing in mission.landings:
        properties = {"bearing_deg": landing.bearing_deg, LANDING_ASSORTMENT: landing.assortments}
        placed = _placemark(document, landing.name, role="landing", **properties)
        _coordinates(SubElement(placed, "Point"), (landing.position,))
    for log in mission.logs:
        _log(document, log)
    return _bytes(root)


def _fence(document: Element, fence: Fence) -> None:
    polygon = SubElement(_placemark(document, fence.name, role="keep-out" if fence.keep_out else "fence"), "Polygon")
    ring = SubElement(SubElement(polygon, "outerBoundaryIs"), "LinearRing")
    _coordinates(ring, (*fence.corners, *fence.corners[:1]))


def _log(document: Element, log: KnownLog) -> None:
    properties = {name: getattr(log, name) for name in log.__struct_fields__ if name != "position"}
    _coordinates(SubElement(_placemark(document, log.key, role="log", **properties), "Point"), (log.position,))


def _placemark(document: Element, name: str, **properties: Any) -> Element:
    placed = SubElement(document, "Placemark")
    _text(placed, "name", name)
    data = SubElement(placed, "ExtendedData")
    for key, value in properties.items():
        for each in value if isinstance(value, tuple) else (value,):
            if each is not None and each != "":
                _text(SubElement(data, "Data", name=key), "value", each if isinstance(each, str) else repr(each))
    return placed


def _coordinates(owner: Element, points: tuple[Point, ...]) -> None:
    """Write positions; KML has longitude first."""
    text = " ".join(f"{_decimal(p.longitude_deg)},{_decimal(p.latitude_deg)}" for p in points)
    SubElement(owner, "coordinates").text = text


def _decimal(degrees: float) -> str:
    """Write all digits of a number, as XML schema's decimal: without an exponent."""
    return format(Decimal(repr(float(degrees))), "f")


def _text(parent: Element, name: str, text: str) -> None:
    SubElement(parent, name).text = _NO_XML.sub(" ", text)


def _bytes(root: Element) -> bytes:
    indent(root)
    data: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


# -- Missions for other programs


_MAV_FRAME_GLOBAL_RELATIVE_ALT: Final = 3
_MAV_AUTOPILOT_ARDUPILOT: Final = 3
_MAV_TYPE_GROUND_ROVER: Final = 10


class Exported(NamedTuple):
    """A file's bytes, and what it does not hold, in words."""

    data: bytes
    left_out: tuple[str, ...]


def export(mission: ForwardingMission, kind: str) -> Exported:
    """Write the mission as ``kind``, one of ``FORMATS``.

    Raises:
        MissionError: there is no such format.
    """
    if kind not in FORMATS:
        raise MissionError("mission.export-format", f'"{kind}" cannot be written; formats are {", ".join(FORMATS)}')
    write, holds = FORMATS[kind]
    return Exported(write(mission), _left_out(mission, holds))


def write_plan(mission: ForwardingMission) -> bytes:
    """Write route, speed and fences as a plan for a ground rover."""
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
            "cruiseSpeed": mission.options.speed_m_s or 1,
            "firmwareType": _MAV_AUTOPILOT_ARDUPILOT,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": 1,
            "items": items,
            "plannedHomePosition": [*_lat_lon(home), 0],
            "vehicleType": _MAV_TYPE_GROUND_ROVER,
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _item(command: int, params: list[float | None], number: int) -> dict[str, Any]:
    return {
        "autoContinue": True,
        "command": command,
        "doJumpId": number,
        "frame": _MAV_FRAME_GLOBAL_RELATIVE_ALT,
        "params": params,
        "type": "SimpleItem",
    }


def _lat_lon(point: Point) -> list[float]:
    return [point.latitude_deg, point.longitude_deg]


def _left_out(mission: ForwardingMission, holds: frozenset[str]) -> tuple[str, ...]:
    """List what the mission has and the format does not hold."""
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
    left_out = [item for item, present in has.items() if present and item not in holds]
    return (*left_out, *(f"option {name}" for name in options))


_GPX: Final = frozenset({"name", "landings", "logs"})
_KML: Final = _GPX | {
    "fences",
    "names of fences",
    "bearings and assortments of landings",
    "sizes, bearings and kinds of logs",
}
_ALL: Final = _KML | {"heights", *(f"options.{name}" for name in Options.__struct_fields__)}
FORMATS: Final[dict[str, tuple[Callable[[ForwardingMission], bytes], frozenset[str]]]] = {
    "geojson": (geojson.write, _ALL),
    "plan": (write_plan, frozenset({"fences", "options.speed_m_s"})),
    "gpx": (write_gpx, _GPX),
    "kml": (write_kml, _KML),
}
"""Writer of each format by its file name extension, and what it holds."""
