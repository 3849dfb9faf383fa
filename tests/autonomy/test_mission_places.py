"""What a mission file is told whose places cannot be right, by name of the trap."""

from __future__ import annotations

import math

import pytest
from mission_texts import (
    FENCE,
    ROUTE,
    at,
    collection,
    feature,
    gpx,
    line,
    lon_lat,
    polygon,
)
from told_missions import good, told

from autonomy.missions.model import Point

# -- swapped axes -----------------------------------------------------------------------------------------------


SWAPPED_ROUTE = [Point(p.longitude_deg, p.latitude_deg) for p in ROUTE]


def test_swapped_axes_beyond_the_pole() -> None:
    far_east = [Point(144.0, -37.0), Point(144.001, -37.0)]
    said = told(collection(line(far_east)))
    assert "latitude 144.000000, which is beyond the poles; longitude and latitude look swapped" in said


def test_swapped_route_beside_a_right_fence() -> None:
    said = told(collection(line(SWAPPED_ROUTE), polygon()))
    assert said.count("longitude and latitude look swapped") == 3
    assert "waypoint 1 is 5" in said and "km away from the fence" in said


def test_one_swapped_waypoint() -> None:
    said = told(collection(line([ROUTE[0], SWAPPED_ROUTE[1], ROUTE[2]])))
    assert said.count("\n") == 0
    assert "waypoint 2" in said and "look swapped" in said


def test_swapped_near_the_diagonal_shows_at_the_fence() -> None:
    """Where latitude and longitude are nearly equal, swapping moves a place by metres only."""
    from autonomy.missions.local_frame import LocalFrame

    near = LocalFrame(45.001, 45.0)
    corners = [near.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [near.point(-10, 0), near.point(10, 0)]
    swapped = [Point(p.longitude_deg, p.latitude_deg) for p in way]
    assert "look swapped" in told(collection(line(swapped), polygon(corners)))
    assert good(collection(line(way), polygon(corners)))


def test_a_mission_swapped_as_a_whole_shows_at_the_machines_site() -> None:
    data = collection(line(SWAPPED_ROUTE), polygon([Point(p.longitude_deg, p.latitude_deg) for p in FENCE]))
    assert "look swapped" in told(data, site=(63.657853, 19.895562))
    good(data)  # nothing in the file alone gives it away


# -- the fence --------------------------------------------------------------------------------------------------


def test_waypoint_outside_of_the_fence() -> None:
    said = told(collection(line([*ROUTE, at(36, 12)]), polygon()))
    assert said.endswith("waypoint 4 is 6.0 m outside of the fence; move it or widen the fence")


def test_leg_outside_of_the_fence() -> None:
    notch = [at(-30, -25), at(30, -25), at(30, 25), at(5, 25), at(0, -20), at(-5, 25), at(-30, 25)]
    said = told(collection(line([at(-20, 10), at(20, 10)]), polygon(notch)))
    assert "the leg from waypoint 1 to waypoint 2 leaves the fence" in said


def test_leg_through_a_keep_out() -> None:
    said = told(
        collection(line(), polygon(), polygon([at(-2, -14), at(2, -14), at(2, -10), at(-2, -10)], role="keep-out"))
    )
    assert "the leg from waypoint 1 to waypoint 2 leaves the fence by 2.0 m or more" in said


def test_the_closing_leg_of_laps_counts() -> None:
    keep_out = polygon([at(-2, -2), at(2, -2), at(2, 2), at(-2, 2)], role="keep-out")
    laps = {"timberhand": {"schema": 1, "options": {"laps": 2}}}
    assert "from waypoint 3 to waypoint 1" in told(collection(line(), polygon(), keep_out, **laps))
    good(collection(line(), polygon(), keep_out))


def test_landing_outside_of_the_fence() -> None:
    landing = feature("Point", lon_lat([at(0, 31)])[0], role="landing")
    assert "landing 1 is 6.0 m outside" in told(collection(line(), polygon(), landing))


def test_self_crossing_fence() -> None:
    bow = [FENCE[0], FENCE[2], FENCE[1], FENCE[3]]
    said = told(collection(line(), polygon(bow)))
    assert "fence 1 crosses itself: its edges from corner" in said and "wrong order" in said


def test_fence_with_a_spike_and_fence_without_area() -> None:
    spike = [*FENCE[:2], at(60, -25), FENCE[1], *FENCE[2:]]
    assert "crosses itself" in told(collection(line(), polygon(spike)))
    assert "crosses itself" in told(collection(line(), polygon([at(0, 0), at(30, 0), at(10, 0)])))
    assert "encloses less than 1 m2" in told(collection(line(), polygon([at(0, 0), at(1, 0), at(1, 1)])))
    assert "has 2 corners" in told(collection(line(), polygon([at(0, 0), at(1, 0)])))
    assert "corner 3 of fence 1 is the same place as corner 2" in told(
        collection(line(), polygon([FENCE[0], FENCE[1], FENCE[1], FENCE[2]]))
    )


# -- other systems ----------------------------------------------------------------------------------------------


def test_wrong_datum() -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3006"}}
    said = told(collection(line(), crs=crs))
    assert said.startswith("m:3: coordinates are in") and "export it as WGS84 (EPSG:4326)" in said
    for name in ("urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "urn:ogc:def:crs:EPSG::4326"):
        good(collection(line(), crs={"type": "name", "properties": {"name": name}}))


def test_metres_of_a_projection() -> None:
    sweref = [[743000.0, 7065000.0], [743040.0, 7065000.0]]
    assert "this looks like metres of a map projection" in told(collection(feature("LineString", sweref)))


def test_places_too_far_apart() -> None:
    assert "waypoint 2 is 21 km away from waypoint 1; a mission spans at most 20 km" in told(
        collection(line([at(0, 0), at(0, 21_000)]))
    )


def test_latitude_and_longitude_out_of_range() -> None:
    assert "it goes from -90 to 90" in told(collection(feature("Point", [100.0, 95.0])))
    assert "it goes from -180 to 180" in told(collection(feature("Point", [200.0, 45.0])))


@pytest.mark.parametrize("longitude", [180.0, -180.0, 179.9999, -179.9999])
def test_antimeridian(longitude: float) -> None:
    """A site on the 180th meridian is a site like any other."""
    from autonomy.missions.local_frame import LocalFrame

    site = LocalFrame(65.0, longitude)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, 0), site.point(20, 0), site.point(20, 30)]
    draft = good(collection(line(way), polygon(ring)))
    assert len({math.copysign(1, p.longitude_deg) for p in draft.mission.waypoints}) == 2  # it lies on both sides
    assert "5.0 m outside" in told(collection(line([*way, site.point(45, 0)]), polygon(ring)))


@pytest.mark.parametrize("latitude", [90.0, -90.0, 89.9999])
def test_poles(latitude: float) -> None:
    from autonomy.missions.local_frame import LocalFrame

    site = LocalFrame(latitude, 0.0)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, -5), site.point(20, -5), site.point(20, 30)]
    good(collection(line(way), polygon(ring)))
    assert "5.0 m outside" in told(collection(line([*way, site.point(45, 0)]), polygon(ring)))


# -- waypoints --------------------------------------------------------------------------------------------------


def test_empty_files_and_empty_missions() -> None:
    assert told(b"") == "m: is empty"
    assert told(b"\xef\xbb\xbf \n") == "m: is empty"
    assert "has no waypoints; draw a route as a line" in told(collection())
    assert "has no waypoints" in told(collection(feature("LineString", [])))
    assert "has no waypoints" in told(gpx("<rte/>"))
    assert "no list of mission items" in told(b'{"fileType": "Plan"}')


def test_duplicated_waypoints() -> None:
    said = told(collection(line([ROUTE[0], ROUTE[1], ROUTE[1], ROUTE[2]])))
    assert said.endswith("waypoint 3 is the same place as waypoint 2; delete one of them")
    good(collection(line([*ROUTE, ROUTE[0]])))  # a closed lap is none


def test_two_routes_and_a_route_beside_waypoints() -> None:
    assert "is a second route" in told(collection(line(), line()))
    assert "a waypoint beside a route" in told(collection(line(), feature("Point", lon_lat(ROUTE)[0], role="waypoint")))
    draft = good(collection(line(), feature("Point", lon_lat(ROUTE)[0])))
    assert draft.notes == ["1 point without a role beside the route left out"]
