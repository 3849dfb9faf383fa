"""Writes GPX 1.1 and KML 2.2; `autonomy.missions.gpx_kml` reads both back.

In KML every property is extended data, including ``role``, so that only options and heights are lost.  In GPX the route
is a route, and landings and logs are waypoints whose ``type`` is their role.
"""

from __future__ import annotations

import re
from decimal import Decimal
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from autonomy.missions.model import Fence, ForwardingMission, KnownLog, Point

_NO_XML: Final = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold (section 2.2)."""


def write_gpx(mission: ForwardingMission) -> bytes:
    """Name, route, landings and logs."""
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
    """Everything but options and heights."""
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
        told = {"bearing_deg": landing.bearing_deg, "assortments": ", ".join(landing.assortments)}
        placed = _placemark(document, landing.name, role="landing", **told)
        _coordinates(SubElement(placed, "Point"), (landing.position,))
    for log in mission.logs:
        _log(document, log)
    return _bytes(root)


def _fence(document: Element, fence: Fence) -> None:
    polygon = SubElement(_placemark(document, fence.name, role="keep-out" if fence.keep_out else "fence"), "Polygon")
    ring = SubElement(SubElement(polygon, "outerBoundaryIs"), "LinearRing")
    _coordinates(ring, (*fence.corners, *fence.corners[:1]))


def _log(document: Element, log: KnownLog) -> None:
    told = {name: getattr(log, name) for name in log.__struct_fields__ if name != "position"}
    _coordinates(SubElement(_placemark(document, log.key, role="log", **told), "Point"), (log.position,))


def _placemark(document: Element, name: str, **properties: Any) -> Element:
    placed = SubElement(document, "Placemark")
    _text(placed, "name", name)
    data = SubElement(placed, "ExtendedData")
    for key, value in properties.items():
        if value is not None and value != "":
            _text(SubElement(data, "Data", name=key), "value", value if isinstance(value, str) else repr(value))
    return placed


def _coordinates(owner: Element, points: tuple[Point, ...]) -> None:
    """KML has longitude first."""
    text = " ".join(f"{_decimal(p.longitude_deg)},{_decimal(p.latitude_deg)}" for p in points)
    SubElement(owner, "coordinates").text = text


def _decimal(degrees: float) -> str:
    """All digits of a number, as XML schema's decimal: without an exponent."""
    return format(Decimal(repr(float(degrees))), "f")


def _text(parent: Element, name: str, text: str) -> None:
    SubElement(parent, name).text = _NO_XML.sub(" ", text)


def _bytes(root: Element) -> bytes:
    indent(root)
    data: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"
