"""Mission files as texts for tests: a 40 m by 30 m site, as other programs write it."""

from __future__ import annotations

import json
from typing import Any

from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.model import Point

SITE = LocalFrame(63.657853, 19.895562)


def at(east_m: float, north_m: float) -> Point:
    """A place of the site."""
    here = SITE.point(east_m, north_m)
    return Point(here.latitude_deg, here.longitude_deg)


ROUTE = [at(-18, -12), at(18, -12), at(18, 12)]
FENCE = [at(-30, -25), at(30, -25), at(30, 25), at(-30, 25)]


def lon_lat(points: list[Point]) -> list[list[float]]:
    """GeoJSON positions."""
    return [[p.longitude_deg, p.latitude_deg] for p in points]


def feature(kind: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    """A GeoJSON feature."""
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def collection(*features: dict[str, Any], **members: Any) -> bytes:
    """A GeoJSON file, indented as programs do."""
    return json.dumps({"type": "FeatureCollection", **members, "features": list(features)}, indent=1).encode()


def line(points: list[Point] = ROUTE, **properties: Any) -> dict[str, Any]:
    """A LineString feature."""
    return feature("LineString", lon_lat(points), **properties)


def polygon(points: list[Point] = FENCE, **properties: Any) -> dict[str, Any]:
    """A Polygon feature, closed."""
    return feature("Polygon", [lon_lat([*points, points[0]])], **properties)


def plan(items: list[dict[str, Any]], **geo_fence: Any) -> bytes:
    """A QGroundControl plan."""
    mission = {"items": items, "plannedHomePosition": [0, 0, 0], "version": 2}
    fence = {"circles": [], "polygons": [], "version": 2} | geo_fence
    return json.dumps({"fileType": "Plan", "geoFence": fence, "mission": mission, "version": 1}, indent=1).encode()


def item(point: Point, command: int = 16) -> dict[str, Any]:
    """A simple item at a place."""
    params = [0, 0, 0, None, point.latitude_deg, point.longitude_deg, 50]
    return {"type": "SimpleItem", "command": command, "frame": 3, "params": params}


def gpx(body: str) -> bytes:
    """A GPX file."""
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">\n'
    return f"{head}{body}</gpx>\n".encode()


def gpx_points(tag: str, points: list[Point] = ROUTE) -> str:
    """Elements of a route or track, one a line."""
    return "".join(f'<{tag} lat="{p.latitude_deg!r}" lon="{p.longitude_deg!r}"/>\n' for p in points)


def kml(body: str) -> bytes:
    """A KML file."""
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
    return f"{head}{body}</Document>\n</kml>\n".encode()


def kml_coordinates(points: list[Point] = ROUTE) -> str:
    """One position a line."""
    return "\n".join(f"{p.longitude_deg!r},{p.latitude_deg!r},0" for p in points)
