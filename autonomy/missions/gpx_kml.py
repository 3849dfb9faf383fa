"""GPX and KML, as written by hand-held receivers and map programs.

Both are WGS84.  Their heights are above sea level, not above the ellipsoid, so they are ignored.  GPX names latitude
and longitude; KML has longitude, latitude, height.  In KML the extended data of a placemark are its properties,
including ``role``; in GPX a waypoint's ``type`` is its role if it is one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

from autonomy.missions.features import ROLES, Draft, Position, Shape, assemble
from autonomy.missions.model import MAX_LOGS, MAX_WAYPOINTS
from autonomy.missions.source import Place, Source
from autonomy.missions.xml_tree import ANY, Element, tree
from runtime.errors import CodedError

MAX_ELEMENTS: Final = 300_000
MAX_KML_POSITIONS: Final = 100_000
_GPX: Final = frozenset({
    "metadata", "name", "rte", "rtept", "trk", "trkseg", "trkpt", "wpt", "type",
})  # fmt: skip
_GPX_LIMITS: Final = {
    "rtept": (MAX_WAYPOINTS, "points in a route"),
    "trkpt": (MAX_WAYPOINTS, "points in a track"),
    "wpt": (MAX_LOGS, "waypoints"),
    ANY: (MAX_ELEMENTS, "elements"),
}
_KML: Final = frozenset({
    "Document", "Folder", "Placemark", "name", "ExtendedData", "Data", "value", "SchemaData", "SimpleData",
    "MultiGeometry", "Point", "LineString", "LinearRing", "Polygon", "outerBoundaryIs", "innerBoundaryIs",
    "coordinates",
})  # fmt: skip
_KML_LIMITS: Final = {"Placemark": (MAX_LOGS, "placemarks"), ANY: (MAX_ELEMENTS, "elements")}
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_WORD: Final = re.compile(r"\S+")


class NumberError(CodedError, ValueError):
    """A text is not a number."""


def decimal(text: str, what: str) -> float:
    """The number in a text.

    Raises:
        NumberError: it is not a number.
    """
    word = text.strip()
    if _NUMBER.fullmatch(word):
        return float(word)
    if re.fullmatch(r"[+-]?\d+,\d+", word):
        raise NumberError("mission.decimal-comma", f'{what} "{word[:40]}" has a decimal comma; write a decimal point')
    raise NumberError("mission.number", f'{what} "{word[:40]}" is not a number')


def read_gpx(data: bytes, name: str) -> Draft:
    """The mission in a GPX file: its route, else its track, else its waypoints."""
    root = tree(data, name, _GPX, _GPX_LIMITS)
    source = Source(name)
    routes = [("route", list(route.all("rtept")), route) for route in root.all("rte")]
    tracks = [
        ("track", [p for seg in track.all("trkseg") for p in seg.all("trkpt")], track) for track in root.all("trk")
    ]
    notes = []
    lines = routes or tracks
    if routes and tracks:
        notes.append("a track beside the route ignored")
    shapes = []
    for _, points, owner in lines:
        at = tuple(_gpx_position(point, source) for point in points)
        if at:
            shapes.append(Shape("line" if len(at) > 1 else "point", (at,), {}, owner.line))
        else:
            notes.append("an empty route ignored")
    for point in root.all("wpt"):
        kind = point.value("type").lower()
        properties: dict[str, Any] = {"role": kind} if kind in ROLES else {}
        properties |= {"key" if kind == "log" else "name": point.value("name")}
        shapes.append(Shape("point", ((_gpx_position(point, source),),), properties, point.line))
    title = root.value("metadata", "name") or (lines[0][2].value("name") if lines else "")
    draft = assemble(shapes, source, "GPX", title)
    draft.notes += notes
    return draft


def _gpx_position(point: Element, source: Source) -> Position:
    values = []
    for key in ("lat", "lon"):
        if key not in point.attributes:
            raise source.error("gpx.missing-coordinate", point.line, f"this {point.name} has no {key}")
        try:
            values.append(decimal(point.attributes[key], key))
        except NumberError as error:
            raise source.error(error.code, point.line, str(error)) from None
    return Position(values[0], values[1], None, point.line)


def read_kml(data: bytes, name: str) -> Draft:
    """The mission in a KML file: lines, polygons and points of its placemarks."""
    root = tree(data, name, _KML, _KML_LIMITS)
    reader = _Kml(Source(name))
    for placemark in _placemarks(root):
        reader.placemark(placemark)
    title = root.value("Document", "name") or root.value("name")
    draft = assemble(reader.shapes, reader.source, "KML", title)
    draft.notes += reader.notes
    return draft


def _placemarks(element: Element) -> Iterator[Element]:
    for child in element.children:
        if child.name == "Placemark":
            yield child
        elif child.name in ("Document", "Folder"):
            yield from _placemarks(child)


class _Kml:
    """Collects the shapes of placemarks."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.shapes: list[Shape] = []
        self.notes: list[str] = []
        self.count = 0

    def placemark(self, placemark: Element) -> None:
        properties: dict[str, Any] = {"name": placemark.value("name")}
        for data in placemark.all("ExtendedData"):
            properties |= {entry.attributes.get("name", ""): entry.value("value") for entry in data.all("Data")}
            for schema in data.all("SchemaData"):
                properties |= {e.attributes.get("name", ""): e.text.strip() for e in schema.all("SimpleData")}
        if properties.get("role") == "log":
            properties.setdefault("key", properties["name"])
        self.geometries(placemark, properties)

    def geometries(self, owner: Element, properties: dict[str, Any]) -> None:
        for child in owner.children:
            if child.name == "MultiGeometry":
                self.geometries(child, properties)
            elif child.name == "Point":
                self.add("point", [self.positions(child)], properties, child.line)
            elif child.name in ("LineString", "LinearRing"):
                self.add("line", [self.positions(child)], properties, child.line)
            elif child.name == "Polygon":
                rings = [
                    self.positions(ring)
                    for side in ("outerBoundaryIs", "innerBoundaryIs")
                    for boundary in child.all(side)
                    for ring in boundary.all("LinearRing")
                ]
                self.add("polygon", rings, properties, child.line)

    def add(self, kind: Any, rings: list[tuple[Position, ...]], properties: dict[str, Any], place: Place) -> None:
        if rings and all(rings):
            self.shapes.append(Shape(kind, tuple(rings), properties, place))
        else:
            self.notes.append(f"an empty {kind} ignored")

    def positions(self, owner: Element) -> tuple[Position, ...]:
        element = owner.first("coordinates")
        if element is None:
            return ()
        text, line, at, found = element.text, element.line, 0, []
        for word in _WORD.finditer(text):
            self.count += 1
            if self.count > MAX_KML_POSITIONS:
                sentence = f"has more than {MAX_KML_POSITIONS} positions; thin it out"
                raise self.source.error("mission.too-many-positions", line, sentence)
            line += text.count("\n", at, word.start())
            at = word.start()
            parts = word[0].split(",")
            if not 2 <= len(parts) <= 3 or not parts[0]:
                sentence = f'"{word[0][:40]}" is not a position; write longitude,latitude[,height] without spaces'
                raise self.source.error("kml.position", line, sentence)
            try:
                longitude, latitude = decimal(parts[0], "longitude"), decimal(parts[1], "latitude")
            except NumberError as error:
                raise self.source.error(error.code, line, str(error)) from None
            found.append(Position(latitude, longitude, None, line))
        return tuple(found)
