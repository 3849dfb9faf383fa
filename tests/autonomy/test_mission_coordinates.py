"""Mission files with wrong coordinates."""

from __future__ import annotations

import math

import pytest

from autonomy.missions.model import Point
from autonomy.missions.validation import SWAPPED_HINT
from tests.autonomy.mission_checks import codes, good, refused
from tests.autonomy.mission_texts import (
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
from tests.codes import numbers_in

# -- swapped axes -----------------------------------------------------------------------------------------------


SWAPPED_ROUTE = [Point(p.longitude_deg, p.latitude_deg) for p in ROUTE]


def test_swapped_axes_beyond_the_pole() -> None:
    far_east = [Point(144.0, -37.0), Point(144.001, -37.0)]
    assert codes(collection(line(far_east))) == ["swapped-axes", "swapped-axes"]


def test_swapped_route_beside_a_right_fence() -> None:
    assert codes(collection(line(SWAPPED_ROUTE), polygon())) == ["swapped-axes"] * 3


def test_one_swapped_waypoint() -> None:
    (problem,) = refused(collection(line([ROUTE[0], SWAPPED_ROUTE[1], ROUTE[2]]))).problems
    assert problem.code == "mission.swapped-axes" and 2 in numbers_in(problem.sentence)


def test_swapped_near_the_diagonal_shows_at_the_fence() -> None:
    """Where latitude and longitude are nearly equal, swapping moves a place by metres only."""
    from autonomy.missions.local_frame import LocalFrame

    near = LocalFrame(45.001, 45.0)
    corners = [near.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [near.point(-10, 0), near.point(10, 0)]
    swapped = [Point(p.longitude_deg, p.latitude_deg) for p in way]
    error = refused(collection(line(swapped), polygon(corners)))
    assert error.code == "mission.waypoint-outside-fence" and SWAPPED_HINT in str(error)
    assert good(collection(line(way), polygon(corners)))


def test_a_mission_swapped_as_a_whole_shows_at_the_machines_site() -> None:
    data = collection(line(SWAPPED_ROUTE), polygon([Point(p.longitude_deg, p.latitude_deg) for p in FENCE]))
    assert codes(data, site=(63.657853, 19.895562)) == ["swapped-axes"]
    good(data)  # the file alone is consistent


# -- the fence --------------------------------------------------------------------------------------------------


def test_waypoint_outside_of_the_fence() -> None:
    (problem,) = refused(collection(line([*ROUTE, at(36, 12)]), polygon())).problems
    assert problem.code == "mission.waypoint-outside-fence"
    assert {4, 6.0} <= set(numbers_in(problem.sentence))


def test_leg_outside_of_the_fence() -> None:
    notch = [at(-30, -25), at(30, -25), at(30, 25), at(5, 25), at(0, -20), at(-5, 25), at(-30, 25)]
    assert codes(collection(line([at(-20, 10), at(20, 10)]), polygon(notch))) == ["leg-leaves-fence"]


def test_leg_through_a_keep_out() -> None:
    keep_out = polygon([at(-2, -14), at(2, -14), at(2, -10), at(-2, -10)], role="keep-out")
    error = refused(collection(line(), polygon(), keep_out))
    assert error.code == "mission.leg-leaves-fence" and 2.0 in numbers_in(str(error))


def test_the_closing_leg_of_laps_counts() -> None:
    keep_out = polygon([at(-2, -2), at(2, -2), at(2, 2), at(-2, 2)], role="keep-out")
    laps = {"timberhand": {"schema": 1, "options": {"laps": 2}}}
    error = refused(collection(line(), polygon(), keep_out, **laps))
    assert error.code == "mission.leg-leaves-fence" and {3, 1} <= set(numbers_in(str(error)))
    good(collection(line(), polygon(), keep_out))


def test_landing_outside_of_the_fence() -> None:
    landing = feature("Point", lon_lat([at(0, 31)])[0], role="landing")
    error = refused(collection(line(), polygon(), landing))
    assert error.code == "mission.landing-outside-fence" and 6.0 in numbers_in(str(error))


def test_self_crossing_fence() -> None:
    bow = [FENCE[0], FENCE[2], FENCE[1], FENCE[3]]
    assert codes(collection(line(), polygon(bow))) == ["fence-crosses-itself"]


def test_fence_with_a_spike_and_fence_without_area() -> None:
    spike = [*FENCE[:2], at(60, -25), FENCE[1], *FENCE[2:]]
    assert codes(collection(line(), polygon(spike))) == ["fence-crosses-itself"]
    assert codes(collection(line(), polygon([at(0, 0), at(30, 0), at(10, 0)]))) == ["fence-crosses-itself"]
    assert codes(collection(line(), polygon([at(0, 0), at(1, 0), at(1, 1)]))) == ["fence-area"]
    assert codes(collection(line(), polygon([at(0, 0), at(1, 0)]))) == ["fence-corners"]
    assert codes(collection(line(), polygon([FENCE[0], FENCE[1], FENCE[1], FENCE[2]]))) == ["duplicate-corner"]


# -- other systems ----------------------------------------------------------------------------------------------


def test_wrong_datum() -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3006"}}
    (problem,) = refused(collection(line(), crs=crs)).problems
    assert (problem.code, problem.place) == ("mission.datum", "m:3")
    for name in ("urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "urn:ogc:def:crs:EPSG::4326"):
        good(collection(line(), crs={"type": "name", "properties": {"name": name}}))


def test_metres_of_a_projection() -> None:
    sweref = [[743000.0, 7065000.0], [743040.0, 7065000.0]]
    assert codes(collection(feature("LineString", sweref))) == ["projected-coordinates"] * 2


def test_places_too_far_apart() -> None:
    assert codes(collection(line([at(0, 0), at(0, 21_000)]))) == ["too-far-apart"]


def test_latitude_and_longitude_out_of_range() -> None:
    assert codes(collection(feature("Point", [100.0, 95.0]))) == ["latitude-range"]
    assert codes(collection(feature("Point", [200.0, 45.0]))) == ["longitude-range"]


@pytest.mark.parametrize("longitude", [180.0, -180.0, 179.9999, -179.9999])
def test_antimeridian(longitude: float) -> None:
    """A site on the 180th meridian is a site like any other."""
    from autonomy.missions.local_frame import LocalFrame

    site = LocalFrame(65.0, longitude)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, 0), site.point(20, 0), site.point(20, 30)]
    draft = good(collection(line(way), polygon(ring)))
    assert len({math.copysign(1, p.longitude_deg) for p in draft.mission.waypoints}) == 2  # it lies on both sides
    assert codes(collection(line([*way, site.point(45, 0)]), polygon(ring)))[0] == "waypoint-outside-fence"


@pytest.mark.parametrize("latitude", [90.0, -90.0, 89.9999])
def test_poles(latitude: float) -> None:
    from autonomy.missions.local_frame import LocalFrame

    site = LocalFrame(latitude, 0.0)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, -5), site.point(20, -5), site.point(20, 30)]
    good(collection(line(way), polygon(ring)))
    assert codes(collection(line([*way, site.point(45, 0)]), polygon(ring)))[0] == "waypoint-outside-fence"


# -- waypoints --------------------------------------------------------------------------------------------------


def test_empty_files_and_empty_missions() -> None:
    assert codes(b"") == codes(b"\xef\xbb\xbf \n") == ["empty-file"]
    assert codes(collection()) == ["no-waypoints"]
    assert codes(collection(feature("LineString", []))) == ["no-waypoints"]
    assert codes(gpx("<rte/>")) == ["no-waypoints"]
    assert codes(b'{"fileType": "Plan"}') == ["plan.items"]


def test_duplicated_waypoints() -> None:
    (problem,) = refused(collection(line([ROUTE[0], ROUTE[1], ROUTE[1], ROUTE[2]]))).problems
    assert problem.code == "mission.duplicate-waypoint" and 3 in numbers_in(problem.sentence)
    good(collection(line([*ROUTE, ROUTE[0]])))  # a closed lap has none


def test_two_routes_and_a_route_beside_waypoints() -> None:
    assert codes(collection(line(), line())) == ["second-route"]
    beside = feature("Point", lon_lat(ROUTE)[0], role="waypoint")
    assert codes(collection(line(), beside)) == ["waypoint-beside-route"]
    draft = good(collection(line(), feature("Point", lon_lat(ROUTE)[0])))
    assert [numbers_in(note) for note in draft.notes] == [[1]]
