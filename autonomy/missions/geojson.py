"""GeoJSON (RFC 7946), the mission's native format: positions are longitude, latitude, height.

A mission is a FeatureCollection whose member ``timberhand`` holds ``schema``, ``name`` and ``options``.  The property
``role`` of each feature says what it is (``autonomy.missions.features``).  GeoJSON of other programs is read as well.
"""

from __future__ import annotations

import json
from collections import Counter
from typing import Any, Final

import msgspec

from autonomy.missions.features import Draft, Position, Shape, assemble
from autonomy.missions.model import SCHEMA, Fence, ForwardingMission, KnownLog, Options, Point
from autonomy.missions.source import Place, Source

MEMBER: Final = "timberhand"
MAX_POSITIONS: Final = 200_000
_WGS84: Final = ("crs84", "epsg:4326", "epsg::4326", "wgs84", "wgs 84")
Path = tuple[str | int, ...]


def read(document: dict[str, Any], source: Source) -> Draft:
    """Read the mission in a GeoJSON document.

    Raises:
        MissionError: what is wrong, with its line.
    """
    _check_crs(document, source)
    name, options = _header(document, source)
    reader = _Reader(source)
    reader.anything(document, ())
    draft = assemble(reader.shapes, source, "GeoJSON", name, options)
    draft.notes += [f"{count} × {item} ignored" for item, count in reader.left_out.items()]
    return draft


def _check_crs(document: dict[str, Any], source: Source) -> None:
    """Check the coordinate system: GeoJSON is WGS84; the ``crs`` member of GeoJSON 2008 may only confirm that."""
    crs = document.get("crs")
    if crs is None:
        return
    crs_name = crs.get("properties", crs) if isinstance(crs, dict) else crs
    if isinstance(crs_name, dict):
        crs_name = crs_name.get("name", f"EPSG:{crs_name['code']}" if "code" in crs_name else crs_name)
    named = str(crs_name)
    if not any(word in named.lower() for word in _WGS84):
        raise source.error(
            "mission.datum",
            ("crs",),
            f'coordinates are in "{named[:60]}"; a mission is in WGS84, so export it as WGS84 (EPSG:4326)',
        )


def _header(document: dict[str, Any], source: Source) -> tuple[str, Options]:
    """Read name and options of a mission from the member ``timberhand``, or the name of another program's file."""
    own = document.get(MEMBER)
    if own is None:
        name = document.get("name")
        return (name if isinstance(name, str) else ""), Options()
    if not isinstance(own, dict):
        raise source.error("mission.header", (MEMBER,), f"{MEMBER} is not an object; it holds schema, name and options")
    if own.get("schema") != SCHEMA:
        raise source.error(
            "mission.schema",
            (MEMBER, "schema"),
            f"schema is {own.get('schema')!r}; this release reads schema {SCHEMA}, so convert the file with the "
            "release that wrote it",
        )
    name = own.get("name", "")
    if not isinstance(name, str):
        raise source.error("mission.header", (MEMBER, "name"), "the name of the mission is not a text")
    try:
        return name, msgspec.convert(own.get("options", {}), Options)
    except msgspec.ValidationError as error:
        sentence, _, where = str(error).partition(" - at ")
        key = where.strip("`").removeprefix("$.") or "options"
        path = (MEMBER, "options", key) if key != "options" else (MEMBER, "options")
        known = f"; options are {', '.join(Options.__struct_fields__)}" if "unknown field" in sentence else ""
        sentence = f"{key}: {sentence[0].lower()}{sentence[1:]}{known}"
        raise source.error("mission.option", path, sentence) from None


class _Reader:
    """Collects the shapes of a document."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.shapes: list[Shape] = []
        self.left_out: Counter[str] = Counter()
        self.count = 0

    def anything(self, value: Any, path: Path) -> None:
        """Read a FeatureCollection, a Feature or a geometry."""
        kind = value.get("type") if isinstance(value, dict) else None
        if kind == "FeatureCollection":
            features = self.listed(value.get("features"), (*path, "features"), "features")
            for i, feature in enumerate(features):
                self.feature(feature, (*path, "features", i))
        elif kind == "Feature":
            self.feature(value, path)
        else:
            self.geometry(value, {}, path, path)

    def feature(self, feature: Any, path: Path) -> None:
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            sentence = 'this is not a feature; it needs "type": "Feature"'
            raise self.source.error("mission.geojson-feature", path, sentence)
        properties = feature.get("properties")
        if not isinstance(properties, dict | None):
            raise self.source.error("mission.geojson-properties", (*path, "properties"), "properties is not an object")
        if feature.get("geometry") is None:
            self.left_out["a feature without a geometry"] += 1
            return
        self.geometry(feature["geometry"], properties or {}, (*path, "geometry"), path)

    def geometry(self, geometry: Any, properties: dict[str, Any], path: Path, owner: Path) -> None:
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        at = (*path, "coordinates")
        given = geometry.get("coordinates") if isinstance(geometry, dict) else None
        if kind == "Point":
            self.add("point", (self.positions([given], path, "coordinates", True),), properties, owner)
        elif kind == "MultiPoint":
            for position in self.positions(given, path, "coordinates"):
                self.add("point", ((position,),), properties, owner)
        elif kind == "LineString":
            self.add("line", (self.positions(given, path, "coordinates"),), properties, owner)
        elif kind in ("Polygon", "MultiPolygon"):
            many = self.listed(given, at, "coordinates") if kind == "MultiPolygon" else [given]
            for i, rings in enumerate(many):
                polygon_path = (*at, i) if kind == "MultiPolygon" else at
                listed = self.listed(rings, polygon_path, "a polygon")
                self.add(
                    "polygon",
                    tuple(self.positions(r, polygon_path, j) for j, r in enumerate(listed)),
                    properties,
                    owner,
                )
        elif kind in ("MultiLineString", "GeometryCollection"):
            sentence = f"a {kind} cannot be part of a mission; make the route one LineString"
            raise self.source.error("mission.geojson-geometry", path, sentence)
        else:
            sentence = f"type {kind!r} is not a GeoJSON geometry; a route is a LineString"
            raise self.source.error("mission.geojson-geometry", path, sentence)

    def add(self, kind: Any, rings: tuple[tuple[Position, ...], ...], properties: dict[str, Any], at: Place) -> None:
        if rings and rings[0]:
            self.shapes.append(Shape(kind, tuple(filter(None, rings)), properties, at))
        else:
            self.left_out[f"an empty {kind}"] += 1

    def listed(self, value: Any, path: Path, what: str) -> list[Any]:
        if not isinstance(value, list):
            raise self.source.error("mission.geojson-list", path, f"{what} is not a list")
        return value

    def positions(self, given: Any, path: Path, step: str | int, single: bool = False) -> tuple[Position, ...]:
        """Read positions, only checked to be numbers; their count is limited before any is read."""
        at = (*path, step)
        listed = self.listed(given, at, "coordinates")
        self.count += len(listed)
        if self.count > MAX_POSITIONS:
            sentence = f"has more than {MAX_POSITIONS} positions; thin the route or fence out"
            raise self.source.error("mission.too-many-positions", at, sentence)
        return tuple(self.position(p, at if single else (*at, i)) for i, p in enumerate(listed))

    def position(self, value: Any, path: Path) -> Position:
        if not isinstance(value, list) or not 2 <= len(value) <= 4:
            sentence = "a position is [longitude, latitude] or [longitude, latitude, height]"
            raise self.source.error("mission.geojson-position", path, sentence)
        if any(isinstance(x, bool) or not isinstance(x, int | float | None) for x in value) or None in value[:2]:
            sentence = "a position is made of numbers: [longitude, latitude, height]"
            raise self.source.error("mission.geojson-position", path, sentence)
        height = value[2] if len(value) > 2 else None
        return Position(float(value[1]), float(value[0]), None if height is None else float(height), path)


def write(mission: ForwardingMission) -> bytes:
    """Write the mission as GeoJSON, one feature per line, with all digits."""
    header = {"schema": mission.schema, "name": mission.name, "options": _without_defaults(mission.options)}
    features: list[dict[str, Any]] = []
    if len(mission.waypoints) == 1:
        features.append(_feature("Point", _position(mission.waypoints[0]), {"role": "waypoint"}))
    elif mission.waypoints:
        features.append(_feature("LineString", [_position(p) for p in mission.waypoints], {"role": "route"}))
    features += [_fence(fence) for fence in mission.fences]
    for landing in mission.landings:
        properties = {
            "name": landing.name,
            "bearing_deg": landing.bearing_deg,
            "assortments": list(landing.assortments),
        }
        features.append(_feature("Point", _position(landing.position), {"role": "landing"} | _with_values(properties)))
    features += [_log(log) for log in mission.logs]
    lines = ",\n".join("    " + _text(feature) for feature in features)
    body = f"[\n{lines}\n  ]" if lines else "[]"
    return (f'{{\n  "type": "FeatureCollection",\n  "{MEMBER}": {_text(header)},\n  "features": {body}\n}}\n').encode()


def _fence(fence: Fence) -> dict[str, Any]:
    ring = [_position(p) for p in (*fence.corners, *fence.corners[:1])]
    return _feature(
        "Polygon", [ring], {"role": "keep-out" if fence.keep_out else "fence"} | _with_values({"name": fence.name})
    )


def _log(log: KnownLog) -> dict[str, Any]:
    properties = {name: getattr(log, name) for name in log.__struct_fields__ if name != "position"}
    return _feature("Point", _position(log.position), {"role": "log"} | _with_values(properties))


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def _position(point: Point) -> list[float]:
    height = [] if point.altitude_m is None else [point.altitude_m]
    return [point.longitude_deg, point.latitude_deg, *height]


def _with_values(properties: dict[str, Any]) -> dict[str, Any]:
    """Return the properties that have a value."""
    return {key: value for key, value in properties.items() if value not in (None, "", [])}


def _without_defaults(options: Options) -> dict[str, Any]:
    usual = Options()
    named: dict[str, Any] = msgspec.to_builtins(options)
    return {key: value for key, value in named.items() if getattr(options, key) != getattr(usual, key)}


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
