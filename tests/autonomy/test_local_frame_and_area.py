"""The local frame of a mission against PROJ, and the geometry of fences against plain arguments."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.missions.area import Area, crossing, path_distance_m, signed_area_m2
from autonomy.missions.local_frame import LocalFrame, bearing_from_yaw, site_frame, yaw_from_bearing
from autonomy.missions.model import Fence, ForwardingMission, KnownLog, MissionError, Point
from tests.codes import coded

LATITUDES = st.floats(-89.99, 89.99)
LONGITUDES = st.floats(-180.0, 180.0)
HEIGHTS = st.floats(-400.0, 4000.0)
NEAR = st.floats(-5000.0, 5000.0)


def proj(frame: LocalFrame) -> pyproj.Transformer:
    """PROJ's conversion from degrees to the topocentric frame, which shares no code with ours."""
    return pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={frame.longitude_deg!r} +lat_0={frame.latitude_deg!r} "
        f"+h_0={frame.altitude_m!r}"
    )


@given(LATITUDES, LONGITUDES, HEIGHTS, NEAR, NEAR, st.floats(-200.0, 200.0))
def test_local_metres_are_projs_to_a_micrometre(latitude, longitude, height, east, north, up) -> None:
    frame = LocalFrame(latitude, longitude, height)
    place = frame.point(east, north, up)
    theirs = proj(frame).transform(place.longitude_deg, place.latitude_deg, place.altitude_m)
    assert theirs == pytest.approx((east, north, up), abs=1e-6)
    assert frame.points_enu([place])[0] == pytest.approx(np.array([east, north, up]), abs=1e-6)


@given(st.sampled_from([90.0, -90.0]), LONGITUDES, NEAR, NEAR)
def test_there_and_back_at_the_poles(latitude: float, longitude: float, east: float, north: float) -> None:
    frame = LocalFrame(latitude, longitude, 50.0)
    back = frame.points_enu([frame.point(east, north)])[0]
    assert back == pytest.approx(np.array([east, north, 0.0]), abs=1e-6)


@given(st.sampled_from([180.0, -180.0]), NEAR)
def test_the_antimeridian_is_no_border(longitude: float, east: float) -> None:
    place = LocalFrame(60.0, longitude).point(east, 0.0)
    assert abs(place.longitude_deg) <= 180.0
    assert LocalFrame(60.0, -longitude).points_enu([place])[0][0] == pytest.approx(east, abs=1e-6)


def test_a_point_without_a_height_is_at_the_origins() -> None:
    frame = LocalFrame(63.0, 19.0, 200.0)
    flat = frame.points_enu([Point(63.02, 19.0), Point(63.02, 19.0, 200.0)])
    assert flat[0] == pytest.approx(flat[1])
    low = frame.points_enu([Point(63.02, 19.0, 0.0)])[0]
    assert flat[0][1] - low[1] > 0.05  # a height left out is centimetres at two kilometres
    assert frame.points_enu([]).shape == (0, 3)


def test_the_frame_of_a_mission() -> None:
    way = (Point(63.0, 19.0), Point(63.001, 19.0, 80.0))
    assert site_frame(ForwardingMission(waypoints=way)) == LocalFrame(63.0, 19.0, 80.0)
    assert site_frame(ForwardingMission(logs=(KnownLog(Point(1.0, 2.0)),))) == LocalFrame(1.0, 2.0, 0.0)
    with pytest.raises(MissionError, check=coded("mission.no-place")):
        site_frame(ForwardingMission(fences=(Fence(()),)))


@given(st.floats(-720.0, 720.0))
def test_bearings_and_yaws(bearing: float) -> None:
    assert yaw_from_bearing(0.0) == pytest.approx(math.pi / 2) and yaw_from_bearing(90.0) == 0.0
    back = bearing_from_yaw(yaw_from_bearing(bearing))
    assert 0.0 <= back < 360.0 or back == pytest.approx(360.0)
    assert math.sin(math.radians(back - bearing) / 2) == pytest.approx(0.0, abs=1e-9)


# -- fences
SQUARE = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)])


@given(st.floats(-20.0, 30.0), st.floats(-20.0, 30.0))
def test_inside_and_outside_of_a_square(x: float, y: float) -> None:
    dx, dy = max(-x, x - 10.0, 0.0), max(-y, y - 10.0, 0.0)
    wanted = math.hypot(dx, dy)
    found = float(Area((SQUARE,)).outside_m(np.array([[x, y]]))[0])
    assert found == pytest.approx(wanted if wanted > 1e-3 else 0.0, abs=2e-3)


def test_half_a_millimetre_beyond_the_edge_is_on_it() -> None:
    """Corners come with eight or nine digits, so an edge is no sharper than that."""
    beside = np.array([(10.0005, 5.0), (10.0015, 5.0)])
    assert Area((SQUARE,)).outside_m(beside) == pytest.approx([0.0, 0.0015])


@given(st.integers(3, 12), st.floats(0.0, 6.3), st.integers(0, 2**32 - 1))
def test_a_convex_ring_holds_what_is_left_of_all_its_edges(count: int, turn: float, seed: int) -> None:
    angles = turn + np.linspace(0.0, math.tau, count, endpoint=False)
    ring = 5.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.random.default_rng(seed).uniform(-7.0, 7.0, (50, 2))
    along = np.roll(ring, -1, axis=0) - ring
    left = [np.all(along[:, 0] * (p[1] - ring[:, 1]) - along[:, 1] * (p[0] - ring[:, 0]) > 0.0) for p in points]
    clear = path_distance_m(np.vstack([ring, ring[:1]]), points) > 2e-3
    assert ((Area((ring,)).outside_m(points) == 0.0) == left)[clear].all()
    assert ((Area((), (ring,)).outside_m(points) > 0.0) == left)[clear].all()
    assert crossing(ring) is None and signed_area_m2(ring) > 0.0 > signed_area_m2(ring[::-1])


def test_two_adjoining_fences_are_one_area() -> None:
    """RFC 7946 cuts a fence at the antimeridian; a leg may cross the cut."""
    area = Area((SQUARE, SQUARE + np.array([10.0, 0.0])))
    assert area.leaves_m(np.array([5.0, 5.0]), np.array([15.0, 5.0])) == 0.0
    gap = Area((SQUARE, SQUARE + np.array([12.0, 0.0])))
    assert gap.leaves_m(np.array([5.0, 5.0]), np.array([17.0, 5.0])) == pytest.approx(1.0)


def test_a_leg_that_cuts_a_corner_or_runs_along_an_edge() -> None:
    hook = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (9.0, 10.0), (9.0, 1.0), (0.0, 1.0)])
    area = Area((hook,))
    assert area.leaves_m(np.array([0.5, 0.5]), np.array([9.5, 9.5])) > 1.0
    assert area.leaves_m(np.array([0.0, 0.0]), np.array([10.0, 0.0])) == 0.0
    keep_out = Area((), (SQUARE,))
    assert keep_out.leaves_m(np.array([-5.0, 5.0]), np.array([15.0, 5.0])) == pytest.approx(5.0)
    assert keep_out.leaves_m(np.array([-5.0, 5.0]), np.array([95.0, 5.0])) == pytest.approx(5.0)  # far from its middle
    assert keep_out.leaves_m(np.array([-5.0, 10.0]), np.array([15.0, 10.0])) == 0.0


@pytest.mark.parametrize(
    ("ring", "crossed"),
    [
        (SQUARE, False),
        (SQUARE[[0, 2, 1, 3]], True),
        (np.array([(0, 0), (10, 0), (10, 10), (5, 0), (0, 10)], dtype=float), True),  # touches its own edge
        (np.array([(0, 0), (10, 0), (15, 0), (10, 0), (0, 10)], dtype=float), True),  # a spike
        (np.array([(0, 0), (5, 0), (10, 0), (10, 10), (0, 10)], dtype=float), False),  # a corner on a straight edge
        (np.array([(0, 0), (10, 0), (10, 10), (5, 0.5), (0, 10)], dtype=float), False),
    ],
)
def test_rings_that_cross_themselves(ring: np.ndarray, crossed: bool) -> None:
    shaken = ring + np.random.default_rng(1).normal(0.0, 1e-9, ring.shape)  # as if from degrees
    assert (crossing(shaken) is not None) == crossed
    for turn in range(len(ring)):
        assert (crossing(np.roll(ring, turn, axis=0)) is not None) == crossed
        assert (crossing(np.roll(ring, turn, axis=0)[::-1]) is not None) == crossed


def test_distance_from_a_path() -> None:
    path = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 0.0), (10.0, 5.0)])
    assert path_distance_m(path, np.array([(5.0, 3.0), (13.0, 4.0), (10.0, 9.0)])) == pytest.approx([3.0, 3.0, 4.0])
    assert path_distance_m(path[:1], np.array([(3.0, 4.0)])) == pytest.approx([5.0])
