"""Drives on the model, paper B's waypoints, how the navigator stops; paths, following them, and how fast."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.localizer import Localizer
from autonomy.localization.location import Location, Status
from autonomy.navigation.clothoid_path import HARDEST_SHARE, SPACING_M, Path, PathRefused, drivable_path, path_limits
from autonomy.navigation.navigator import EXECUTION_TIMEOUT_NS, LEASE_NS, MOTION_TIMEOUT_NS, Navigator, Phase
from autonomy.navigation.path_drive import (
    MIN_SPEED_SHARE,
    FollowerState,
    PathDrive,
    Rocking,
    follow_path,
    terrain_speed_share,
    tip_margin_m,
)
from autonomy.navigation.waypoint_drive import MIN_SWITCH_M, Waypoint, WaypointDrive
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.vehicle import DriveSetpoint, Driving, Steering, VehicleReport
from machine.geometry.carrier import turning_radius_m
from tests.autonomy.carrier_model import CARRIER, FIRM, MUD, SQUARE, Ground, Individual, Vehicle, at, individual
from tests.codes import coded, numbers_in
from tests.console.vehicle_reports import VEHICLE


# -- drives on the model
def drive(
    way: PathDrive | WaypointDrive, ground: Ground = FIRM, own: Individual | None = None
) -> tuple[Vehicle, Navigator]:
    """A drive on the model to its end, for two minutes at the most."""
    vehicle = Vehicle(CARRIER, ground=ground, own=own, seed=1)
    localizer, navigator = Localizer(CARRIER, vehicle.plane), Navigator(CARRIER, 7)
    for _ in range(120 * 200):
        report = vehicle.step()
        if report is None:
            continue
        location = localizer.step(report)
        if navigator.phase is Phase.IDLE and location.status is Status.TRACKING:
            navigator.drive(way)
        vehicle.order(navigator.step(vehicle.now_ns, report, location))
        if navigator.phase in (Phase.ARRIVED, Phase.STOPPED):
            break
    return vehicle, navigator


@pytest.mark.parametrize("ground", [FIRM, MUD], ids=["firm", "mud"])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_machine_stops_within_five_centimetres_of_its_stop(ground: Ground, seed: int) -> None:
    path = drivable_path([(0.0, 0.0), (12.0, 0.0), (20.0, 6.0)], CARRIER)
    own = replace(individual(seed), main_off_m=(0.0, 0.0))
    vehicle, navigator = drive(PathDrive(CARRIER, path, 9.0), ground, own)
    assert navigator.phase is Phase.ARRIVED
    assert vehicle.x == pytest.approx(9.0, abs=0.05) and abs(vehicle.y) < 0.08


def test_the_last_setpoints_have_zero_speed() -> None:
    """A lease may only expire while stop setpoints are sent."""
    navigator, way, here = begun()
    navigator.step(10**9, report(), here)
    way.stop_at(1.0)
    asked, now_ns = [], 10**9
    while navigator.phase is Phase.DRIVING and now_ns < 9 * 10**9:
        now_ns += 50_000_000
        still = replace(here, stamp_ns=now_ns, speed_m_s=0.0)
        asked.append(navigator.step(now_ns, report(speed_m_s=0.0, stamp_ns=now_ns), still))
    assert navigator.phase is Phase.ARRIVED and asked[-1] is None
    assert [a.speed_m_s for a in asked[:-1] if a] == [0.0] * 9


def test_a_pause_right_after_the_start_sends_stop_setpoints() -> None:
    navigator, _, here = begun()
    asked = navigator.step(10**9, report(speed_m_s=0.0), here)
    assert asked is not None and asked.speed_m_s > 0.0
    navigator.pause()
    asked = navigator.step(10**9 + 50_000_000, report(speed_m_s=0.0), here)
    assert asked is not None and asked.speed_m_s == 0.0


def test_the_stop_can_be_moved() -> None:
    way = PathDrive(CARRIER, drivable_path([(0.0, 0.0), (30.0, 0.0)], CARRIER))
    assert way.left_m == 30.0
    way.stop_at(4.0)
    vehicle, navigator = drive(way)
    assert navigator.phase is Phase.ARRIVED and vehicle.x == pytest.approx(4.0, abs=0.05)
    way.stop_at(1e9)
    assert way.left_m == pytest.approx(26.0, abs=0.05)


def test_paper_b_drives_from_waypoint_to_waypoint() -> None:
    plane = LocalPlane(CARRIER.site_lat_deg, CARRIER.site_lon_deg, 260.0)
    places = [Waypoint(*plane.geodetic(*p)[:2]) for p in ((14.0, 0.0), (14.0, 22.0))]
    way = WaypointDrive(CARRIER, places)
    vehicle, navigator = drive(way)
    assert navigator.phase is Phase.ARRIVED and way.number == 1
    assert math.dist((vehicle.x, vehicle.y), (14.0, 22.0)) < MIN_SWITCH_M + 0.5
    assert way.switch_m(0) == pytest.approx(turning_radius_m(CARRIER, CARRIER.articulation_limit_rad), rel=0.05)
    assert way.switch_m(1) == MIN_SWITCH_M


def report(**values: float) -> VehicleReport:
    """A machine at the origin of the site that stands and is fine."""
    site = {"latitude_deg": CARRIER.site_lat_deg, "longitude_deg": CARRIER.site_lon_deg, "altitude_m": 260.0}
    level = {
        "heading_rad": 0.0,
        "speed_m_s": 0.6,
        "articulation_rad": 0.1,
        "roll_rad": 0.0,
        "pitch_rad": 0.0,
        "heights_m": (0.35,) * 4,
    }
    return replace(VEHICLE, **site | level | values)


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ({"latitude_deg": math.nan}, "no position"),
        ({"position_ns": 1}, "no position"),
        ({"heading_rad": math.nan}, "no heading"),
        ({"heading_ns": 1}, "no heading"),
    ],
)
def test_paper_b_stops_without_a_receiver(what: dict[str, float], reason: str) -> None:
    plane = LocalPlane(CARRIER.site_lat_deg, CARRIER.site_lon_deg)
    way = WaypointDrive(CARRIER, [Waypoint(*plane.geodetic(0.0, 40.0)[:2])])
    assert way.step(report()).speed_m_s == CARRIER.cruise_speed_m_s
    order = way.step(report(**what))
    assert order.speed_m_s == 0.0 and reason in order.stop_reason
    with pytest.raises(ValueError, check=coded("path.no-waypoints")):
        WaypointDrive(CARRIER, [])


def test_a_last_waypoint_that_was_passed_is_reached() -> None:
    plane = LocalPlane(CARRIER.site_lat_deg, CARRIER.site_lon_deg)
    way = WaypointDrive(CARRIER, [Waypoint(*plane.geodetic(4.0, 10.0)[:2])])
    assert not way.step(report()).arrived
    lat, lon, _ = plane.geodetic(0.0, 12.0)
    assert way.step(report(latitude_deg=lat, longitude_deg=lon)).arrived


# -- navigator
def begun() -> tuple[Navigator, PathDrive, Location]:
    """A navigator that drives along x from the origin."""
    navigator = Navigator(CARRIER, 7, (0.3, 0.3, 0.35, 0.35))
    way = PathDrive(CARRIER, drivable_path([(0.0, 0.0), (30.0, 0.0)], CARRIER))
    navigator.drive(way)
    return navigator, way, at(1.0, 0.0, 0.0)


def test_every_setpoint_has_a_lease_and_survives_encoding() -> None:
    navigator, _, here = begun()
    first = navigator.step(10**9, report(), here)
    second = navigator.step(10**9 + 50_000_000, report(stamp_ns=10**9 + 50_000_000), here)
    assert isinstance(first, DriveSetpoint) and isinstance(second, DriveSetpoint)
    assert first.lease_ns == LEASE_NS <= 200_000_000 and second.sequence == first.sequence + 1
    assert first.steering is Steering.ARTICULATION and first.speed_m_s > 0.0
    assert first.heights_m == (0.3, 0.3, 0.35, 0.35)
    assert decode(encode(first)) == first


def test_the_front_axle_only_floats_while_driving() -> None:
    navigator, _, here = begun()
    driven = navigator.step(10**9, report(), here)
    assert driven is not None and (driven.float_front, driven.float_rear) == (True, False)
    navigator.pause()
    braked = navigator.step(2 * 10**9, report(), here)
    assert braked is not None and not (braked.float_front or braked.float_rear)
    navigator.holds_heights = True
    held = navigator.step(9 * 10**9, report(speed_m_s=0.0), here)
    assert held is not None and not (held.float_front or held.float_rear), "while the crane works it stands firm"


def test_pause_stops_and_resume_drives_on() -> None:
    navigator, way, here = begun()
    navigator.step(10**9, report(), here)
    navigator.pause()
    asked = navigator.step(2 * 10**9, report(), here)
    assert navigator.phase is Phase.PAUSED and asked is not None and asked.speed_m_s == 0.0
    assert asked.articulation_rad == pytest.approx(0.1)
    asked = navigator.step(2_200_000_000, report(speed_m_s=0.0), here)
    assert asked is not None and asked.speed_m_s == 0.0 and not navigator.is_standing  # until the brake is on
    assert navigator.step(3 * 10**9, report(speed_m_s=0.0), here) is None  # it stands: the lease runs out
    assert navigator.is_standing
    navigator.resume()
    asked = navigator.step(4 * 10**9, report(speed_m_s=0.0), replace(here, stamp_ns=4 * 10**9))
    assert navigator.phase is Phase.DRIVING and asked is not None and asked.speed_m_s > 0.0
    assert way.steer is not None and way.steer.s_m == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("here", "reason"),
    [
        (Location(10**9, Status.LOST, "no position from the receiver"), "not located: no position"),
        (Location(10**9, Status.STARTING, "not enough positions that fit yet"), "not located"),
        (at(1.0, 0.0, 0.0, covariance=np.eye(3)), "1.00 m"),
    ],
)
def test_an_unlocated_machine_stops_until_resumed(here: Location, reason: str) -> None:
    navigator, _, good = begun()
    navigator.step(10**9, report(), good)
    asked = navigator.step(2 * 10**9, report(), here)
    assert navigator.phase is Phase.STOPPED and reason in navigator.reason
    assert asked is not None and asked.speed_m_s == 0.0
    navigator.step(3 * 10**9, report(), good)
    assert navigator.phase is Phase.STOPPED  # the machine does not resume by itself when it is located again
    navigator.resume()
    assert navigator.step(4 * 10**9, report(), good) is not None and navigator.phase is Phase.DRIVING


def test_dead_reckoning_drives_slowly() -> None:
    _, way, here = begun()
    fast = way.step(here).speed_m_s
    _, way, here = begun()
    slow = way.step(replace(here, status=Status.DEAD_RECKONING)).speed_m_s
    assert 0.0 < slow < 0.7 * fast


def test_a_machine_off_its_path_stops() -> None:
    navigator, _, here = begun()
    navigator.step(10**9, report(), here)
    navigator.step(2 * 10**9, report(), replace(here, y_m=2.2))
    assert navigator.phase is Phase.STOPPED and 2.2 in numbers_in(navigator.reason)


def test_a_controller_that_does_not_drive_stops_the_drive() -> None:
    navigator, _, here = begun()
    for k in range(2):
        navigator.step(
            10**9 + k * (EXECUTION_TIMEOUT_NS + 1), report(driving=Driving.STANDING, refusal=512, speed_m_s=0.0), here
        )
    assert navigator.phase is Phase.STOPPED and "512" in navigator.reason


def test_wheels_that_do_not_turn_stop_the_drive() -> None:
    navigator, _, here = begun()
    for k in range(2):
        navigator.step(10**9 + k * (MOTION_TIMEOUT_NS + 1), report(speed_m_s=0.0), here)
    assert navigator.phase is Phase.STOPPED and navigator.reason


@pytest.mark.parametrize(("measured_rad", "sent_rad"), [(math.nan, None), (0.7, CARRIER.articulation_limit_rad)])
def test_a_stop_keeps_the_articulation_within_its_limit_and_sends_none_unknown(measured_rad, sent_rad) -> None:
    navigator, _, here = begun()
    navigator.stop("because")
    asked = navigator.step(10**9, report(articulation_rad=measured_rad), here)
    assert (asked and asked.articulation_rad) == sent_rad and navigator.reason == "because"


# -- paths that the machine can drive
POINT = st.tuples(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0))


@settings(max_examples=40, deadline=None)
@given(st.lists(POINT, min_size=2, max_size=7))
def test_every_path_is_drivable_or_refused(points: list[tuple[float, float]]) -> None:
    try:
        path = drivable_path(points, CARRIER)
    except PathRefused as error:
        assert len(str(error)) > 20
        return
    hard = path_limits(CARRIER, HARDEST_SHARE, HARDEST_SHARE)
    assert np.abs(path.curve_1_m).max() <= hard.curve_1_m * (1 + 1e-9)
    step = np.diff(path.s_m)
    assert step.min() > 0.0 and step.max() <= SPACING_M * (1 + 1e-9)
    assert np.abs(np.diff(path.curve_1_m) / step).max() <= hard.change_1_m2 * (1 + 1e-6)
    # A corner ends up to 0.04 mm beside its leg, however short the step is that takes it there.
    assert np.abs(np.hypot(*np.diff(path.xy_m, axis=0).T) - step).max() < 1e-3 * SPACING_M
    turned = 0.5 * (path.curve_1_m[1:] + path.curve_1_m[:-1]) * step
    assert np.abs(np.diff(path.heading_rad) - turned).max() < 2e-4
    assert path.xy_m[0] == pytest.approx(points[0]) and path.xy_m[-1] == pytest.approx(points[-1], abs=1e-3)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 2.6), st.sampled_from((-1.0, 1.0)))
def test_a_corner_is_cut_alike_on_both_legs(size: float, way: float) -> None:
    turn = size * way
    end = (40.0 + 40.0 * math.cos(turn), 40.0 * math.sin(turn))
    try:
        path = drivable_path([(0.0, 0.0), (40.0, 0.0), end], CARRIER)
    except PathRefused:
        assert abs(turn) > 2.3
        return
    assert path.heading_rad[-1] == pytest.approx(turn, abs=1e-6)
    s = path.length_m / 2
    x, y, heading, _ = path.at(s)
    assert heading == pytest.approx(turn / 2, abs=1e-3)
    # The middle of the corner lies on the line that halves it.
    along = (x - 40.0) * math.cos(turn / 2) + y * math.sin(turn / 2)
    assert along == pytest.approx(0.0, abs=0.01)


def test_paths_turn_at_most_nine_degrees_per_metre() -> None:
    path = drivable_path(SQUARE, CARRIER)
    sharpest = 1.0 / turning_radius_m(CARRIER, CARRIER.articulation_limit_rad)
    assert math.degrees(sharpest) == pytest.approx(9.03, abs=0.01)
    assert np.abs(path.curve_1_m).max() < 0.81 * sharpest


def test_a_thousand_points_on_a_line_make_a_straight_path() -> None:
    points = [(0.02 * i, 0.03 * math.sin(i)) for i in range(1000)]
    path = drivable_path(points, CARRIER)
    assert np.abs(path.curve_1_m).max() == 0.0


def test_short_legs_are_driven_with_sharper_bends_or_refused() -> None:
    easy = drivable_path([(0, 0), (30, 0), (30, 30)], CARRIER)
    hard = drivable_path([(0, 0), (8.2, 0), (8.2, 30)], CARRIER)
    assert np.abs(hard.curve_1_m).max() > np.abs(easy.curve_1_m).max()
    with pytest.raises(PathRefused, check=coded("path.short-leg")):
        drivable_path([(0, 0), (5, 0), (5, 30)], CARRIER)
    with pytest.raises(PathRefused, check=coded("path.reverses")):  # its points lie on one line
        drivable_path([(0.0, 0.0), (30.0, 0.0), (10.0, 0.0), (50.0, 0.0)], CARRIER)
    with pytest.raises(PathRefused, check=coded("path.reverses")):
        drivable_path([(0, 0), (30, 0), (1, 0.1)], CARRIER)


@pytest.mark.parametrize("points", [[], [(1.0, 2.0)], [(1.0, 2.0)] * 3])
def test_a_path_needs_two_points(points: list[tuple[float, float]]) -> None:
    with pytest.raises(PathRefused, check=coded("path.too-short")):
        drivable_path(points, CARRIER)
    with pytest.raises(PathRefused, check=coded("path.not-finite")):
        drivable_path([(0.0, 0.0), (math.nan, 1.0)], CARRIER)


@settings(max_examples=40, deadline=None)
@given(st.floats(2.0, 40.0), st.floats(-3.0, 3.0))
def test_the_nearest_point_is_found(s: float, off: float) -> None:
    path = drivable_path(SQUARE, CARRIER)
    x, y, heading, _ = path.at(s)
    x, y = x - off * math.sin(heading), y + off * math.cos(heading)
    assert path.nearest(x, y, s - 1.0, s + 1.0) == pytest.approx(s, abs=0.03)


def test_a_path_continues_straight_past_its_ends() -> None:
    path = drivable_path(SQUARE, CARRIER)
    assert path.nearest(25.0, 22.0) == pytest.approx(path.length_m + 2.0, abs=1e-6)
    assert path.at(path.length_m + 2.0)[:2] == pytest.approx((25.0, 22.0))
    assert path.nearest(-3.0, 1.0) == pytest.approx(-3.0, abs=1e-6)


# -- follower
def glide(path: Path, x: float, y: float, yaw: float, metres: float, slip: float = 0.0) -> list[float]:
    """Lateral errors of a perfect machine that executes the follower's output, 50 ms per step."""
    lf, lr = CARRIER.front_axle_m, CARRIER.rear_axle_m
    bend, v, dt, stamp = 0.0, 0.6, 0.05, 10**9
    state, errors = FollowerState(), []
    for _ in range(round(metres / v / dt)):
        location = at(x, y, yaw, articulation_rad=bend, course_rad=yaw + slip, stamp_ns=stamp)
        state, steer = follow_path(CARRIER, path, state, location, v)
        errors.append(steer.off_m)
        after = steer.articulation_rad + steer.articulation_rate_rad_s * dt
        assert abs(steer.articulation_rate_rad_s) <= CARRIER.articulation_rate_limit_rad_s
        assert abs(steer.articulation_rad) <= CARRIER.articulation_limit_rad
        middle = 0.5 * (bend + after)
        turn = (v * dt * math.sin(middle) + lr * (after - bend)) / (lf * math.cos(middle) + lr)
        x += v * dt * math.cos(yaw + 0.5 * turn + slip)
        y += v * dt * math.sin(yaw + 0.5 * turn + slip)
        yaw, bend, stamp = yaw + turn, after, stamp + 50_000_000
    return errors


def test_the_follower_stays_on_a_path_with_corners() -> None:
    path = drivable_path(SQUARE, CARRIER)
    assert max(map(abs, glide(path, 0.0, 0.0, 0.0, path.length_m - 1.0))) < 0.03


@settings(max_examples=12, deadline=None)
@given(st.floats(-4.0, 4.0), st.floats(-2.0, 2.0), st.floats(-0.08, 0.08))
def test_the_follower_returns_from_anywhere_and_compensates_side_slip(off: float, yaw: float, slip: float) -> None:
    path = drivable_path([(-5.0, 0.0), (80.0, 0.0)], CARRIER)
    errors = glide(path, 0.0, off, yaw, 45.0, slip)
    assert max(map(abs, errors[-50:])) < 0.02
    assert max(map(abs, errors)) < abs(off) + 13.0  # no wider than its turning circle


def test_the_follower_stays_on_its_lap_where_the_path_crosses_itself() -> None:
    path = drivable_path([(0, 0), (40, 0), (40, 20), (20, 20), (20, -30)], CARRIER)
    _, steer = follow_path(CARRIER, path, FollowerState(s_m=20.0), at(20.0, 0.4, 0.0), 0.6)
    assert steer.s_m == pytest.approx(20.0, abs=0.2) and steer.off_m == pytest.approx(0.4, abs=0.05)
    late = path.length_m - 30.0
    _, steer = follow_path(CARRIER, path, FollowerState(s_m=late), at(20.0, 0.0, -math.pi / 2), 0.6)
    assert steer.s_m == pytest.approx(late, abs=0.2) and abs(steer.off_rad) < 0.01


def test_the_follower_steers_by_course_not_by_heading() -> None:
    path = drivable_path([(-5.0, 0.0), (80.0, 0.0)], CARRIER)
    slides = at(10.0, 0.0, 0.05, course_rad=0.0)
    _, steer = follow_path(CARRIER, path, FollowerState(s_m=10.0), slides, 0.6)
    assert steer.off_rad == 0.0 and steer.articulation_rate_rad_s == pytest.approx(0.0, abs=1e-9)


def test_a_standing_machine_is_not_steered() -> None:
    path = drivable_path(SQUARE, CARRIER)
    _, steer = follow_path(CARRIER, path, FollowerState(), at(3.0, 1.0, 0.5, speed_m_s=0.0), 0.0)
    assert steer.articulation_rate_rad_s == 0.0 and steer.articulation_rad == 0.0


# -- speed
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.6, 0.6))
def test_leaning_reduces_the_margin_and_the_speed(roll: float, pitch: float, bend: float) -> None:
    level = tip_margin_m(CARRIER, at(0, 0, 0, articulation_rad=bend))
    leans = tip_margin_m(CARRIER, at(0, 0, 0, articulation_rad=bend, roll_rad=roll, pitch_rad=pitch))
    more = tip_margin_m(CARRIER, at(0, 0, 0, articulation_rad=bend, roll_rad=3 * roll, pitch_rad=pitch))
    if abs(roll) > 0.1 and abs(bend) < 0.1:
        assert more < leans
    assert 0.5 < level < 1.1
    assert 0.0 <= terrain_speed_share(leans, 0.0) <= 1.0
    assert terrain_speed_share(leans, 0.2) <= terrain_speed_share(leans, 0.0)


def test_the_margin_of_a_level_machine_is_half_its_track() -> None:
    assert tip_margin_m(CARRIER, at(0, 0, 0)) == pytest.approx(0.5 * CARRIER.track_width_m)
    right_down = tip_margin_m(CARRIER, at(0, 0, 0, roll_rad=0.2))
    assert tip_margin_m(CARRIER, at(0, 0, 0, roll_rad=0.2), -1.0) > right_down  # a bend to the right helps
    assert tip_margin_m(CARRIER, at(0, 0, 0, roll_rad=0.2), 1.0) < right_down


def test_rocking_reduces_the_speed_for_a_while() -> None:
    rocking = Rocking()
    for i in range(60):
        rate = rocking.step(at(0, 0, 0, roll_rad=0.02 * (i % 2), stamp_ns=10**9 + i * 50_000_000))
    assert terrain_speed_share(1.0, rate) == pytest.approx(MIN_SPEED_SHARE)
    for i in range(60, 400):
        rate = rocking.step(at(0, 0, 0, stamp_ns=10**9 + i * 50_000_000))
    assert terrain_speed_share(1.0, rate) == 1.0


def test_close_to_tipping_the_machine_does_not_drive() -> None:
    way = PathDrive(CARRIER, drivable_path(SQUARE, CARRIER))
    order = way.step(at(0.0, 0.0, 0.0, roll_rad=0.6))
    assert order.speed_m_s == 0.0 and order.stop_reason
