"""Validation of a mission: plausible coordinates, places that belong together, a valid fence, the route inside it.

Each finding has a stable code, one sentence with a hint, and the key of the mission part it is about; the reader of the
file knows its line.  Everything is computed in local metres, so the antimeridian and the poles are no special cases.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from autonomy.missions.area import Area, crossing, signed_area_m2
from autonomy.missions.features import Key
from autonomy.missions.local_frame import LocalFrame, site_frame
from autonomy.missions.model import MAX_CORNERS, MAX_LOGS, MAX_WAYPOINTS, ForwardingMission, Options, Point

MAX_EXTENT_M: Final = 20_000.0
"""Greatest distance between two places of a mission; forwarders drive some hundred metres (docs/reference/machines.md
section 10).
"""
MAX_SITE_DISTANCE_M: Final = 100_000.0
MIN_WAYPOINT_DISTANCE_M: Final = 0.1
"""Waypoints closer together than this are the same place."""
MIN_FENCE_M2: Final = 1.0
HEIGHTS_M: Final = (-500.0, 9000.0)
SPEEDS_M_S: Final = (0.05, 3.0)
LENGTHS_M: Final = (0.3, 30.0)
DIAMETERS_M: Final = (0.02, 2.0)
MAX_LAPS: Final = 1000

SWAPPED_HINT: Final = "latitude and longitude look swapped"
METRES_HINT: Final = "this looks like metres of a map projection; export the file as WGS84 (EPSG:4326)"


class Finding(NamedTuple):
    """A problem of a mission, and the key of the part it is about (None: the whole mission)."""

    key: Key | None
    code: str
    sentence: str


def problems_of(
    mission: ForwardingMission, route_wanted: bool = True, site: tuple[float, float] | None = None
) -> list[Finding]:
    """List all problems of a mission; empty when it can be driven.

    ``route_wanted`` is False where logs alone are useful.  ``site`` is the latitude and longitude [deg] where the
    machine works: it reveals a mission that is consistent in itself but has all its axes swapped.
    """
    counts = list(_counts(mission, route_wanted))
    if counts:
        return counts
    findings = [*_coordinates(mission), *_options(mission.options), *_sizes(mission)]
    if findings:
        return findings
    findings = list(_together(mission)) or list(_at_site(mission, site))
    if findings or not _named(mission):
        return findings
    return [*_fences(mission), *_route(mission), *_assortments(mission)] or list(_within(mission))


def area_of(mission: ForwardingMission, frame: LocalFrame) -> Area:
    """Return the fences in local metres."""
    rings = [(frame.points_enu(fence.corners)[:, :2], fence.keep_out) for fence in mission.fences]
    return Area(tuple(r for r, out in rings if not out), tuple(r for r, out in rings if out))


def _named(mission: ForwardingMission) -> list[tuple[Key, Point]]:
    """List every place with its key."""
    return [
        *((("waypoint", i), p) for i, p in enumerate(mission.waypoints)),
        *((("corner", i, j), p) for i, f in enumerate(mission.fences) for j, p in enumerate(f.corners)),
        *((("landing", i), x.position) for i, x in enumerate(mission.landings)),
        *((("log", i), x.position) for i, x in enumerate(mission.logs)),
    ]


def key_text(key: Key) -> str:
    """Write a key as text, counted from 1."""
    name, *numbers = key
    if name == "corner":
        return f"corner {numbers[1] + 1} of fence {numbers[0] + 1}"
    return f"{name} {numbers[0] + 1}"


def _counts(mission: ForwardingMission, route_wanted: bool) -> Iterator[Finding]:
    if len(mission.waypoints) > MAX_WAYPOINTS:
        yield Finding(
            None,
            "mission.too-many-waypoints",
            f"has {len(mission.waypoints)} waypoints; the limit is {MAX_WAYPOINTS}, so thin the route out",
        )
    corners = sum(len(fence.corners) for fence in mission.fences)
    if corners > MAX_CORNERS:
        yield Finding(
            None,
            "mission.too-many-corners",
            f"has {corners} corners of fences; the limit is {MAX_CORNERS}, so simplify them",
        )
    if len(mission.logs) > MAX_LOGS:
        yield Finding(
            None,
            "mission.too-many-logs",
            f"has {len(mission.logs)} logs; the limit is {MAX_LOGS}, so split the mission",
        )
    if route_wanted and not mission.waypoints:
        yield Finding(None, "mission.no-waypoints", "has no waypoints; draw a route as a line")


def _coordinates(mission: ForwardingMission) -> Iterator[Finding]:
    """Check each place alone."""
    for key, at in _named(mission):
        latitude, longitude, height = at.latitude_deg, at.longitude_deg, at.altitude_m
        if not (math.isfinite(latitude) and math.isfinite(longitude) and math.isfinite(height or 0.0)):
            yield Finding(
                key,
                "mission.non-finite-coordinate",
                f"{key_text(key)} has a coordinate that is NaN or infinite; survey it again",
            )
        elif abs(latitude) > 90.0 and abs(latitude) <= 180.0 and abs(longitude) <= 90.0:
            yield Finding(
                key,
                "mission.swapped-axes",
                f"{key_text(key)} has latitude {latitude:.6f}, which is beyond the poles; {SWAPPED_HINT}",
            )
        elif abs(latitude) > 360.0 or abs(longitude) > 360.0:
            yield Finding(
                key,
                "mission.projected-coordinates",
                f"{key_text(key)} has latitude {latitude:.0f} and longitude {longitude:.0f}; {METRES_HINT}",
            )
        elif abs(latitude) > 90.0:
            yield Finding(
                key,
                "mission.latitude-range",
                f"{key_text(key)} has latitude {latitude:.6f}; the range is -90 to 90 degrees",
            )
        elif abs(longitude) > 180.0:
            yield Finding(
                key,
                "mission.longitude-range",
                f"{key_text(key)} has longitude {longitude:.6f}; the range is -180 to 180 degrees",
            )
        elif height is not None and not HEIGHTS_M[0] <= height <= HEIGHTS_M[1]:
            yield Finding(
                key,
                "mission.height-range",
                f"{key_text(key)} is {height:.0f} m high; heights are metres, {HEIGHTS_M[0]:.0f}..{HEIGHTS_M[1]:.0f}",
            )


def _options(options: Options) -> Iterator[Finding]:
    for name, value, (low, high), unit in (
        ("laps", options.laps, (1, MAX_LAPS), ""),
        ("speed_m_s", options.speed_m_s, SPEEDS_M_S, " m/s"),
        ("transport_height_m", options.transport_height_m, (0.0, 2.0), " m"),
        ("loading_height_m", options.loading_height_m, (0.0, 2.0), " m"),
        ("logs_wanted", options.logs_wanted, (1, MAX_LOGS), ""),
    ):
        if value is not None and not low <= value <= high:
            sentence = f"{name} is {value:g}; the range is {low:g} to {high:g}{unit}"
            yield Finding(None, "mission.option-range", sentence)


def _sizes(mission: ForwardingMission) -> Iterator[Finding]:
    """Check the properties of logs and landings other than their places."""
    for i, log in enumerate(mission.logs):
        key: Key = ("log", i)
        for name, value, limits in (("length_m", log.length_m, LENGTHS_M), ("diameter_m", log.diameter_m, DIAMETERS_M)):
            if value is not None and not limits[0] <= value <= limits[1]:
                hint = " (is it in another unit?)" if value > limits[1] else ""
                yield Finding(
                    key,
                    "mission.log-size",
                    f"{key_text(key)}: {name} is {value:g}; logs have {limits[0]:g} to {limits[1]:g} m{hint}",
                )
                break
        else:
            if log.length_m is not None and log.diameter_m is not None and log.diameter_m >= log.length_m:
                yield Finding(
                    key,
                    "mission.log-shape",
                    f"{key_text(key)} is {log.length_m:g} m long and {log.diameter_m:g} m thick; correct its size",
                )
        if log.sigma_m is not None and not 0.0 <= log.sigma_m <= 100.0:
            yield Finding(
                key, "mission.sigma-range", f"{key_text(key)}: sigma_m is {log.sigma_m:g}; the range is 0 to 100 m"
            )
    bearings: tuple[tuple[str, list[float | None]], ...] = (
        ("log", [log.bearing_deg for log in mission.logs]),
        ("landing", [landing.bearing_deg for landing in mission.landings]),
    )
    for name, bearings_deg in bearings:
        for i, bearing in enumerate(bearings_deg):
            if bearing is not None and not 0.0 <= bearing <= 360.0:
                key = (name, i)
                yield Finding(
                    key,
                    "mission.bearing-range",
                    f"{key_text(key)}: bearing_deg is {bearing:g}; the range is 0 to 360, clockwise",
                )


def _anchor(mission: ForwardingMission) -> tuple[str, Point] | None:
    """Choose the reference for the rest of the mission: the fence, else the route, else the first place."""
    for fence in mission.fences:
        if fence.corners:
            return "the fence", fence.corners[0]
    for key, at in _named(mission):
        return key_text(key), at
    return None


def _together(mission: ForwardingMission) -> Iterator[Finding]:
    """Find places too far from the others to be right."""
    anchor = _anchor(mission)
    if anchor is None:
        return
    named = _named(mission)
    origin = LocalFrame(anchor[1].latitude_deg, anchor[1].longitude_deg)
    flat = [Point(p.latitude_deg, p.longitude_deg) for _, p in named]
    away = np.linalg.norm(origin.points_enu(flat), axis=1)
    for (key, at), distance in zip(named, away, strict=True):
        if distance > MAX_EXTENT_M:
            far = f"{key_text(key)} is {distance / 1000:.0f} km away from {anchor[0]}"
            if swapped_m(origin, at) <= MAX_EXTENT_M:
                yield Finding(key, "mission.swapped-axes", f"{far}; {SWAPPED_HINT}")
            else:
                extent = f"a mission spans at most {MAX_EXTENT_M / 1000:.0f} km"
                yield Finding(key, "mission.too-far-apart", f"{far}; {extent}")


def swapped_m(origin: LocalFrame, at: Point) -> float:
    """Compute the distance of a place from the origin with its axes exchanged [m]."""
    if abs(at.longitude_deg) > 90.0:
        return math.inf
    other = origin.points_enu([Point(at.longitude_deg, at.latitude_deg)])
    return float(np.linalg.norm(other))


def _at_site(mission: ForwardingMission, site: tuple[float, float] | None) -> Iterator[Finding]:
    anchor = _anchor(mission)
    if site is None or anchor is None:
        return
    origin = LocalFrame(*site)
    away = float(np.linalg.norm(origin.points_enu([Point(anchor[1].latitude_deg, anchor[1].longitude_deg)])))
    if away > MAX_SITE_DISTANCE_M >= swapped_m(origin, anchor[1]):
        yield Finding(
            None,
            "mission.swapped-axes",
            f"the mission is {away / 1000:.0f} km away from the machine's site; {SWAPPED_HINT}",
        )


def _fences(mission: ForwardingMission) -> Iterator[Finding]:
    frame = site_frame(mission)
    for i, fence in enumerate(mission.fences):
        key: Key = ("fence", i)
        if len(fence.corners) < 3:
            yield Finding(
                key,
                "mission.fence-corners",
                f"{key_text(key)} has {len(fence.corners)} corners; a polygon has at least three",
            )
            continue
        ring = frame.points_enu(fence.corners)[:, :2]
        steps = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
        if (steps < 1e-3).any():
            at = int(np.argmin(steps))
            corner = ("corner", i, (at + 1) % len(ring))
            yield Finding(
                corner,
                "mission.duplicate-corner",
                f"{key_text(corner)} is the same place as corner {at + 1}; delete one of them",
            )
            continue
        crossed = crossing(ring)
        if crossed is not None:
            a, b = crossed
            yield Finding(
                ("corner", i, b),
                "mission.fence-crosses-itself",
                f"{key_text(key)} crosses itself: its edges from corner {a + 1} and from corner {b + 1} meet; "
                "are two corners in the wrong order?",
            )
        elif abs(signed_area_m2(ring)) < MIN_FENCE_M2:
            yield Finding(
                key,
                "mission.fence-area",
                f"{key_text(key)} encloses less than {MIN_FENCE_M2:g} m2; draw it round the site",
            )


def _route(mission: ForwardingMission) -> Iterator[Finding]:
    at = site_frame(mission).points_enu(mission.waypoints)[:, :2]
    steps = np.linalg.norm(np.diff(at, axis=0), axis=1) if len(at) > 1 else np.empty(0)
    for i in np.flatnonzero(steps < MIN_WAYPOINT_DISTANCE_M):
        key: Key = ("waypoint", int(i) + 1)
        yield Finding(
            key,
            "mission.duplicate-waypoint",
            f"{key_text(key)} is the same place as waypoint {i + 1}; delete one of them",
        )
    if mission.options.laps > 1 and len(at) < 2:
        yield Finding(
            None,
            "mission.lap-of-one-waypoint",
            f"laps is {mission.options.laps} but there is one waypoint; a round has at least two",
        )


def _assortments(mission: ForwardingMission) -> Iterator[Finding]:
    """Check selecting and sorting: cameras do not see assortments, so the mission must name them.

    A mission without logs may get them from a harvester's file.
    """
    options = mission.options
    name = "sort_by_assortment" if options.sort_by_assortment else "assortments" if options.assortments else ""
    if not name:
        return
    if options.logs != "listed":
        yield Finding(
            None,
            "mission.assortments-not-listed",
            f'{name} needs the assortment of each log; list the logs and set logs to "listed", or remove {name}',
        )
    elif mission.logs and not any(log.assortment for log in mission.logs):
        yield Finding(
            None,
            "mission.logs-without-assortment",
            f"{name} needs the assortment of each log, but no log has one; give the logs an assortment",
        )
    if not options.sort_by_assortment:
        return
    if not mission.landings:
        yield Finding(
            None,
            "mission.sorting-without-landing",
            "sort_by_assortment is on, but there is no landing to sort to; add landings",
        )
    elif all(landing.assortments for landing in mission.landings):
        takers = {kind for landing in mission.landings for kind in landing.assortments}
        for i, log in enumerate(mission.logs):
            is_collected = not options.assortments or log.assortment in options.assortments
            if log.assortment and is_collected and log.assortment not in takers:
                yield Finding(
                    ("log", i),
                    "mission.assortment-without-landing",
                    f'log {i + 1} is "{log.assortment}", which no landing accepts; name it at a landing',
                )


def _within(mission: ForwardingMission) -> Iterator[Finding]:
    """Check waypoints, legs and landings against the fence."""
    if not mission.fences:
        return
    frame = site_frame(mission)
    area = area_of(mission, frame)
    at = frame.points_enu(mission.waypoints)[:, :2]
    outside = area.outside_m(at)
    for i in np.flatnonzero(outside).tolist():
        key: Key = ("waypoint", i)
        swapped = SWAPPED_HINT + "; or " if _inside_swapped(mission.waypoints[i], frame, area) else ""
        yield Finding(
            key,
            "mission.waypoint-outside-fence",
            f"{key_text(key)} is {outside[i]:.1f} m outside of the fence; {swapped}move it or widen the fence",
        )
    for i, j in legs(mission):
        strayed = area.leaves_m(at[i], at[j]) if outside[i] == outside[j] == 0.0 else 0.0
        if strayed:
            yield Finding(
                ("waypoint", j),
                "mission.leg-leaves-fence",
                f"the leg from waypoint {i + 1} to waypoint {j + 1} leaves the fence by {strayed:.1f} m or more; "
                "put a waypoint where it has to bend",
            )
    places = frame.points_enu([landing.position for landing in mission.landings])[:, :2]
    for i, away in enumerate(area.outside_m(places)):
        if away > 0.0:
            key = ("landing", i)
            yield Finding(
                key,
                "mission.landing-outside-fence",
                f"{key_text(key)} is {away:.1f} m outside of the fence; move it or widen the fence",
            )


def _inside_swapped(at: Point, frame: LocalFrame, area: Area) -> bool:
    if abs(at.longitude_deg) > 90.0:
        return False
    other = frame.points_enu([Point(at.longitude_deg, at.latitude_deg)])[:, :2]
    return bool(area.keep_in) and float(area.outside_m(other)[0]) == 0.0


def legs(mission: ForwardingMission) -> list[tuple[int, int]]:
    """List the straight lines between waypoints, by their indices; with several laps also the one that closes the
    route.
    """
    count = len(mission.waypoints)
    index_pairs = [(i, i + 1) for i in range(count - 1)]
    if mission.options.laps > 1 and count > 1 and mission.waypoints[0] != mission.waypoints[-1]:
        index_pairs.append((count - 1, 0))
    return index_pairs
