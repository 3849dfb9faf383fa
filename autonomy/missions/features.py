"""The common model of all formats: shapes with properties, and their assembly to a mission.

A shape's ``role`` is ``route``, ``waypoint``, ``fence``, ``keep-out``, ``log`` or ``landing``.  Without a role, a line
is the route, a polygon a fence to stay inside of, and points are waypoints in their order if there is no line; so files
of programs that do not know logs are understood, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from autonomy.missions.area import signed_area_m2
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.model import (
    Fence,
    ForwardingMission,
    KnownLog,
    Landing,
    MissionError,
    Options,
    Point,
    Problem,
    all_points,
    is_product_key,
)
from autonomy.missions.source import Place, Source

ROLES: Final = ("route", "waypoint", "fence", "keep-out", "log", "landing")
Key = tuple[str, int] | tuple[str, int, int]
"""("waypoint", i), ("fence", i), ("corner", fence, i), ("landing", i), ("log", i)."""

_LOG_NUMBERS: Final = ("bearing_deg", "length_m", "diameter_m", "sigma_m")


@dataclass(frozen=True, slots=True)
class Position:
    """One position of a shape as read, not yet validated, and its place in the file."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    place: Place


@dataclass(frozen=True, slots=True)
class Shape:
    """A point, a line or a polygon (outer ring, then holes) with its properties."""

    kind: Literal["point", "line", "polygon"]
    rings: tuple[tuple[Position, ...], ...]
    properties: dict[str, Any]
    place: Place


@dataclass(slots=True)
class Draft:
    """A mission as read, and the places of its parts in the file.

    ``notes`` say what was ignored, ``warnings`` where the mission will be driven otherwise than the file means.
    """

    mission: ForwardingMission
    source: Source
    format: str
    places: dict[Key, Place] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[Problem] = field(default_factory=list)

    def warn(self, code: str, place: Place, sentence: str) -> None:
        """Add a warning."""
        self.warnings.append(Problem(code, " ".join(sentence.split()), self.source.at(place)))


def assemble(
    shapes: Sequence[Shape], source: Source, kind: str, name: str = "", options: Options | None = None
) -> Draft:
    """Assemble the mission from shapes; coordinates are not validated yet (``autonomy.missions.validation``).

    Raises:
        MissionError: an unknown or unsuitable role, a property of the wrong type, or two routes.
    """
    draft = Draft(ForwardingMission(), source, kind)
    problems: list[tuple[Place, str, str]] = []
    roles = [_role(shape, problems) for shape in shapes]
    points, lines = ([s for s, role in zip(shapes, roles, strict=True) if role == r] for r in ("waypoint", "route"))
    without_role = [s for s, role in zip(shapes, roles, strict=True) if role == ""]
    if without_role and not lines and not points:
        points, without_role = without_role, []
    if without_role:
        draft.notes.append(f"{_counted(len(without_role), 'point')} without a role beside the route ignored")
    problems += [
        (
            line.place,
            "mission.second-route",
            'is a second route; a mission has one, so delete one of them (in GeoJSON or give it another "role")',
        )
        for line in lines[1:]
    ]
    if lines and points:
        sentence = "is a waypoint beside a route; keep the line or the points, not both"
        problems.append((points[0].place, "mission.waypoint-beside-route", sentence))
    reader = _Reader(draft, problems)
    route = [p for shape in (lines[:1] or points) for p in shape.rings[0]]
    waypoints = tuple(reader.point(("waypoint", i), position) for i, position in enumerate(route))
    fences: list[Fence] = []
    landings: list[Landing] = []
    logs: list[KnownLog] = []
    for shape, role in zip(shapes, roles, strict=True):
        if role in ("fence", "keep-out"):
            fences += reader.fences(shape, role == "keep-out", len(fences))
        elif role == "landing":
            landings.append(reader.landing(shape, len(landings)))
        elif role == "log":
            logs.append(reader.log(shape, len(logs)))
    if problems:
        raise source.errors(problems)
    inside = sum(not fence.keep_out for fence in fences)
    if inside > 1:
        draft.notes.append(f"{inside} keep-in fences: the machine stays inside one of them, any of them")
    draft.mission = ForwardingMission(
        name, waypoints, tuple(fences), tuple(landings), tuple(logs), options or Options()
    )
    return draft


def merged(route: Draft, harvest: Draft) -> Draft:
    """Return the route's mission with the logs of another file added."""
    both = (*route.mission.logs, *harvest.mission.logs)
    fields = {name: getattr(route.mission, name) for name in ("name", "waypoints", "fences", "landings", "options")}
    draft = Draft(
        ForwardingMission(**fields, logs=both),
        route.source,
        route.format,
        dict(route.places),
        [*route.notes, *harvest.notes],
        [*route.warnings, *harvest.warnings],
    )
    if not harvest.mission.logs:
        sentence = 'no log is added from this file; in GeoJSON and KML a log is a point with the role "log"'
        draft.warnings.append(Problem("mission.no-logs-added", sentence, harvest.source.name))
    elif all_points(harvest.mission)[len(harvest.mission.logs) :]:
        draft.notes.append(f"{harvest.source.name}: only its logs are added, no route, fence or landing")
    return draft


def _role(shape: Shape, problems: list[tuple[Place, str, str]]) -> str:
    """Return the role of a shape; "" for a point without one."""
    role = shape.properties.get("role")
    if role is None or role == "":
        return {"point": "", "line": "route", "polygon": "fence"}[shape.kind]
    if role not in ROLES:
        sentence = f"role {_abbreviated(role)} is unknown; use one of {', '.join(ROLES)}"
        problems.append((shape.place, "mission.unknown-role", sentence))
        return "none"
    fits = {
        "route": ("line",),
        "waypoint": ("point",),
        "fence": ("polygon",),
        "keep-out": ("polygon",),
        "log": ("point", "line"),
        "landing": ("point",),
    }[role]
    if shape.kind not in fits:
        sentence = f"a {shape.kind} cannot be a {role}; draw a {' or a '.join(fits)}"
        problems.append((shape.place, "mission.role-shape", sentence))
        return "none"
    return str(role)


class _Reader:
    """Converts shapes to parts of a mission, and collects their places and problems."""

    def __init__(self, draft: Draft, problems: list[tuple[Place, str, str]]) -> None:
        self.draft, self.problems = draft, problems

    def point(self, key: Key, position: Position) -> Point:
        self.draft.places[key] = position.place
        return Point(position.latitude_deg, position.longitude_deg, position.altitude_m)

    def fences(self, shape: Shape, keep_out: bool, first: int) -> list[Fence]:
        fences = []
        for number, ring in enumerate(shape.rings, first):
            open_ring = ring[:-1] if len(ring) > 1 and same_place(ring[0], ring[-1]) else ring
            ordered = _counter_clockwise(open_ring)
            corners = tuple(self.point(("corner", number, i), position) for i, position in enumerate(ordered))
            self.draft.places[("fence", number)] = shape.place
            fences.append(Fence(corners, keep_out or number > first, self.text(shape, "name")))
        return fences

    def landing(self, shape: Shape, number: int) -> Landing:
        return Landing(
            self.point(("landing", number), shape.rings[0][0]),
            self.text(shape, "name"),
            self.number(shape, "bearing_deg"),
            self.names(shape, "assortments"),
        )

    def log(self, shape: Shape, number: int) -> KnownLog:
        """Make a log from its centre or its two ends."""
        ring = shape.rings[0]
        known = {name: self.number(shape, name) for name in _LOG_NUMBERS}
        at = self.point(("log", number), ring[0])
        if shape.kind == "line":
            if len(ring) != 2:
                sentence = f"a log drawn as a line has two ends, not {len(ring)} points"
                self.problems.append((shape.place, "mission.log-line", sentence))
            elif not _far_from_sane(ring):
                at, known["bearing_deg"], known["length_m"] = _from_ends(*ring)
        key = self.number(shape, "product_key")
        if key is not None and not is_product_key(key):
            sentence = f"product_key is {key:g}; StanForD product keys are integers from 1"
            self.problems.append((shape.place, "mission.product-key", sentence))
            key = None
        return KnownLog(
            at,
            self.text(shape, "key"),
            **known,
            species=self.text(shape, "species"),
            assortment=self.text(shape, "assortment"),
            product_key=None if key is None else int(key),
        )

    def number(self, shape: Shape, name: str) -> float | None:
        value = shape.properties.get(name)
        if value is None or value == "":
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            self._not_a(shape, name, value, "number")
            return None
        try:
            return float(value)
        except (ValueError, OverflowError):
            self._not_a(shape, name, value, "number")
            return None

    def _not_a(self, shape: Shape, name: str, value: object, kind: str) -> None:
        self.problems.append((shape.place, "mission.property-type", f"{name} is {_abbreviated(value)}, not a {kind}"))

    def text(self, shape: Shape, name: str) -> str:
        value = shape.properties.get(name)
        if value is None:
            return ""
        if isinstance(value, bool) or not isinstance(value, (str, int)):
            self._not_a(shape, name, value, "text")
            return ""
        return str(value)

    def names(self, shape: Shape, name: str) -> tuple[str, ...]:
        value = shape.properties.get(name)
        if value is None:
            return ()
        if isinstance(value, str):
            return tuple(word.strip() for word in value.split(",") if word.strip())
        if isinstance(value, list) and all(isinstance(word, str) for word in value):
            return tuple(value)
        self._not_a(shape, name, value, "list of names")
        return ()


def _abbreviated(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def same_place(a: Position, b: Position) -> bool:
    """Tell whether two positions have the same latitude and longitude."""
    return (a.latitude_deg, a.longitude_deg) == (b.latitude_deg, b.longitude_deg)


def _far_from_sane(positions: Iterable[Position]) -> bool:
    """Tell whether any coordinate is outside its range, so that nothing may be computed from it."""
    return any(not (abs(p.latitude_deg) <= 90.0 and abs(p.longitude_deg) <= 180.0) for p in positions)


def _counter_clockwise(ring: tuple[Position, ...]) -> tuple[Position, ...]:
    """Return the ring, reversed if it runs clockwise; its first corner stays first."""
    if len(ring) < 3 or _far_from_sane(ring):
        return ring
    frame = LocalFrame(ring[0].latitude_deg, ring[0].longitude_deg)
    corners = frame.points_enu([Point(p.latitude_deg, p.longitude_deg) for p in ring])[:, :2]
    return ring if signed_area_m2(corners) >= 0.0 else (ring[0], *reversed(ring[1:]))


def _from_ends(a: Position, b: Position) -> tuple[Point, float, float]:
    """Compute centre, bearing [deg] and length [m] of a log between two ends."""
    frame = LocalFrame(a.latitude_deg, a.longitude_deg, a.altitude_m or 0.0)
    end = frame.points_enu([Point(b.latitude_deg, b.longitude_deg, b.altitude_m)])[0]
    middle = frame.point(*(0.5 * end))
    heights = None if a.altitude_m is None or b.altitude_m is None else middle.altitude_m
    bearing = float(np.degrees(np.arctan2(end[0], end[1])) % 360.0)
    return Point(middle.latitude_deg, middle.longitude_deg, heights), bearing, float(np.linalg.norm(end))


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


__all__ = ["ROLES", "Draft", "Key", "MissionError", "Position", "Shape", "assemble", "merged", "same_place"]
