"""GPX and KML, as written by hand-held receivers and map programs.

Both are WGS84.  Their heights are above sea level, not above the ellipsoid, so they are ignored.  GPX names latitude
and longitude; KML has longitude, latitude, height.  In KML the extended data of a placemark are its properties,
including ``role``; in GPX a waypoint's ``type`` is its role if it is one.  A track in several segments is one route,
and a gap between them a warning.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, Final

import numpy as np

from autonomy.missions.features import ROLES, Draft, Position, Shape, assemble, same_place
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.model import MAX_LOGS, MAX_WAYPOINTS, Point
from autonomy.missions.source import Place, Source
from autonomy.missions.xml_tree import ANY, Element, tree
from runtime.errors import InputRefused

MAX_ELEMENTS: Final = 300_000
MAX_KML_POSITIONS: Final = 100_000
_GPX: Final = frozenset(
    {
        "metadata",
        "name",
        "rte",
        "rtept",
        "extensions",
        "RoutePointExtension",
        "rpt",
        "trk",
        "trkseg",
        "trkpt",
        "wpt",
        "type",
    }
)
_GPX_LIMITS: Final = {
    "rtept": (MAX_WAYPOINTS, "points in a route"),
    "trkpt": (MAX_WAYPOINTS, "points in a track"),
    "wpt": (MAX_LOGS, "waypoints"),
    ANY: (MAX_ELEMENTS, "elements"),
}
_KML_UNUSED: Final = {
    "GroundOverlay": "image on the ground",
    "PhotoOverlay": "photo",
    "ScreenOverlay": "image on the screen",
    "Model": "model",
    "Tour": "tour",
}
_LINK: Final = "a link to another file, which is not followed; save what it shows as a file of its own"
MAX_GAP_M: Final = 5.0
"""Segments of a track that begin no farther than this from the end of the one before are one drive [est]."""
LANDING_ASSORTMENT: Final = "landing_assortment"
"""Name of the data with one assortment of a landing; ``assortments`` has several with commas between them."""
_KML: Final = frozenset(
    {
        "Document",
        "Folder",
        "Placemark",
        "name",
        "ExtendedData",
        "Data",
        "value",
        "SchemaData",
        "SimpleData",
        "MultiGeometry",
        "Point",
        "LineString",
        "LinearRing",
        "Polygon",
        "outerBoundaryIs",
        "innerBoundaryIs",
        "coordinates",
        "Track",
        "MultiTrack",
        "coord",
        "NetworkLink",
        *_KML_UNUSED,
    }
)
_KML_LIMITS: Final = {"Placemark": (MAX_LOGS, "placemarks"), ANY: (MAX_ELEMENTS, "elements")}
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_WORD: Final = re.compile(r"\S+")


def decimal(text: str, what: str) -> float:
    """Read the number in a text.

    Raises:
        InputRefused: it is not a number.
    """
    word = text.strip()
    if _NUMBER.fullmatch(word):
        return float(word)
    if re.fullmatch(r"[+-]?\d+,\d+", word):
        raise InputRefused("mission.decimal-comma", f'{what} "{word[:40]}" has a decimal comma; write a decimal point')
    raise InputRefused("mission.number", f'{what} "{word[:40]}" is not a number')


def read_gpx(data: bytes, name: str) -> Draft:
    """Read the mission in a GPX file: its route, else its track, else its waypoints."""
    root = tree(data, name, _GPX, _GPX_LIMITS)
    source = Source(name)
    routes = [([list(route.all("rtept"))], route) for route in root.all("rte")]
    tracks = [([list(seg.all("trkpt")) for seg in track.all("trkseg")], track) for track in root.all("trk")]
    empty = sum(not any(segments) for segments, _ in (*routes, *tracks))
    notes = [f"{empty} × an empty route or track ignored"] if empty else []
    routes, tracks = ([line for line in lines if any(line[0])] for lines in (routes, tracks))
    lines = routes or tracks
    if routes and tracks:
        one_point = sum(map(len, routes[0][0])) == 1 < sum(map(len, tracks[0][0]))
        lines = tracks if len(routes) == 1 and one_point else routes
        notes.append(
            f"a {'route of one point beside the track' if lines is tracks else 'track beside the route'} ignored"
        )
    shapes, gaps = [], Gaps()
    for segments, owner in lines:
        read = [tuple(_gpx_position(point, source) for point in points) for points in segments]
        at = gaps.joined(read)
        shapes.append(Shape("line", (at,), {}, owner.line))
    for point in root.all("wpt"):
        kind = point.value("type").lower()
        properties: dict[str, Any] = {"role": kind} if kind in ROLES else {}
        properties |= {"key" if kind == "log" else "name": point.value("name")}
        shapes.append(Shape("point", ((_gpx_position(point, source),),), properties, point.line))
    title = root.value("metadata", "name") or (lines[0][1].value("name") if lines else "")
    draft = assemble(shapes, source, "GPX", title)
    draft.notes += notes
    gaps.tell(draft)
    between = [e for _, owner in lines for e in _inside(owner) if e.name == "rpt"]
    if between:
        sentence = f"{len(between)} points between those of the route are not used; the machine drives straight"
        draft.warn("gpx.points-between", between[0].line, sentence)
    return draft


class Gaps:
    """The gaps between segments that are joined to one line."""

    def __init__(self) -> None:
        self.found: list[tuple[float, Place]] = []

    def joined(self, segments: Iterable[tuple[Position, ...]]) -> tuple[Position, ...]:
        """Join all segments to one line; the place where one ends and the next begins is one waypoint."""
        line: list[Position] = []
        for segment in segments:
            if line and segment:
                gap_m = _distance_m(line[-1], segment[0])
                if gap_m > MAX_GAP_M:
                    self.found.append((gap_m, segment[0].place))
            met = bool(line and segment) and same_place(line[-1], segment[0])
            line += segment[1:] if met else segment
        return tuple(line)

    def tell(self, draft: Draft) -> None:
        """Warn of the gaps, at the widest one."""
        if not self.found:
            return
        widest_m, location = max(self.found, key=lambda gap: gap[0])
        draft.warn(
            "mission.track-gap",
            location,
            f"the track has {len(self.found) + 1} pieces with up to {widest_m:.0f} m between them, which the machine "
            "drives straight; draw the way across, or delete what does not belong to the route",
        )


def _distance_m(a: Position, b: Position) -> float:
    """Compute the distance of two positions; 0 where one is no place, which validation refuses."""
    if not all(abs(p.latitude_deg) <= 90.0 and abs(p.longitude_deg) <= 180.0 for p in (a, b)):
        return 0.0
    frame = LocalFrame(a.latitude_deg, a.longitude_deg)
    return float(np.hypot(*frame.points_enu([Point(b.latitude_deg, b.longitude_deg)])[0, :2]))


def _gpx_position(point: Element, source: Source) -> Position:
    values = []
    for key in ("lat", "lon"):
        if key not in point.attributes:
            raise source.error("gpx.missing-coordinate", point.line, f"this {point.name} has no {key}")
        try:
            values.append(decimal(point.attributes[key], key))
        except InputRefused as error:
            raise source.error(error.code, point.line, str(error)) from None
    return Position(values[0], values[1], None, point.line)


def read_kml(data: bytes, name: str) -> Draft:
    """Read the mission in a KML file: lines, polygons and points of its placemarks."""
    root = tree(data, name, _KML, _KML_LIMITS)
    reader = _Kml(Source(name))
    for placemark in _placemarks(root):
        reader.placemark(placemark)
    title = root.value("Document", "name") or root.value("name")
    for element in _inside(root):
        if element.name in _KML_UNUSED:
            reader.left_out[_KML_UNUSED[element.name]] += 1
    link = next((element for element in _inside(root) if element.name == "NetworkLink"), None)
    if link is not None and not reader.shapes:
        raise reader.source.error("kml.network-link", link.line, f"holds no place, only {_LINK}")
    draft = assemble(reader.shapes, reader.source, "KML", title)
    draft.notes += [f"{count} × {item} ignored" for item, count in reader.left_out.items()]
    reader.gaps.tell(draft)
    if link is not None:
        draft.warn("kml.network-link", link.line, _LINK)
    return draft


def _inside(element: Element) -> Iterator[Element]:
    """Yield every kept element below one."""
    for child in element.children:
        yield child
        yield from _inside(child)


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
        self.left_out: Counter[str] = Counter()
        self.gaps = Gaps()
        self.count = 0

    def placemark(self, placemark: Element) -> None:
        properties: dict[str, Any] = {"name": placemark.value("name")}
        for data in placemark.all("ExtendedData"):
            entries = [(entry.attributes.get("name", ""), entry.value("value")) for entry in data.all("Data")]
            properties |= dict(entries)
            if single := [value for name, value in entries if name == LANDING_ASSORTMENT]:
                properties["assortments"] = single
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
            elif child.name == "Track":
                self.add("line", [self.track(child)], properties, child.line)
            elif child.name == "MultiTrack":
                line = self.gaps.joined(self.track(track) for track in child.all("Track"))
                self.add("line", [line], properties, child.line)
            elif child.name == "Polygon":
                outer = child.first("outerBoundaryIs", "LinearRing")
                holes = [ring for hole in child.all("innerBoundaryIs") for ring in hole.all("LinearRing")]
                rings = [() if ring is None else self.positions(ring) for ring in (outer, *holes)]
                self.add("polygon", rings, properties, child.line)

    def add(self, kind: Any, rings: list[tuple[Position, ...]], properties: dict[str, Any], place: Place) -> None:
        if rings and rings[0]:
            self.shapes.append(Shape(kind, tuple(filter(None, rings)), properties, place))
        else:
            self.left_out[f"an empty {kind}"] += 1

    def track(self, owner: Element) -> tuple[Position, ...]:
        """Read the places of a gx:Track; its times are not used."""
        track_positions = []
        for element in owner.all("coord"):
            self.counted(element.line)
            parts = element.text.split()
            if not parts:
                continue  # the receiver had no fix
            if not 2 <= len(parts) <= 3:
                sentence = f'"{element.text.strip()[:40]}" is not a position; write longitude latitude [height]'
                raise self.source.error("kml.position", element.line, sentence)
            track_positions.append(self.position(parts, element.line))
        return tuple(track_positions)

    def counted(self, line: int) -> None:
        self.count += 1
        if self.count > MAX_KML_POSITIONS:
            sentence = f"has more than {MAX_KML_POSITIONS} positions; thin it out"
            raise self.source.error("mission.too-many-positions", line, sentence)

    def position(self, parts: list[str], line: int) -> Position:
        try:
            longitude, latitude = decimal(parts[0], "longitude"), decimal(parts[1], "latitude")
        except InputRefused as error:
            raise self.source.error(error.code, line, str(error)) from None
        return Position(latitude, longitude, None, line)

    def positions(self, owner: Element) -> tuple[Position, ...]:
        element = owner.first("coordinates")
        if element is None:
            return ()
        text, line, at, line_positions = element.text, element.line, 0, []
        for word in _WORD.finditer(text):
            self.counted(line)
            line += text.count("\n", at, word.start())
            at = word.start()
            parts = word[0].split(",")
            if not 2 <= len(parts) <= 3 or not all(parts[:2]):
                sentence = f'"{word[0][:40]}" is not a position; write longitude,latitude[,height] without spaces'
                raise self.source.error("kml.position", line, sentence)
            line_positions.append(self.position(parts, line))
        return tuple(line_positions)
