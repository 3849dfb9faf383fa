"""The laws that steer, drive and level the carrier, alone and in closed loop on rigid geometry."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.laws.drive import (
    ANGLE_BAND_RAD,
    MIN_BEARING_M,
    RATE_RISE_S,
    SETTLE_S,
    STANDING_M_S,
    STOP_M_S2,
    AngleLaw,
    DriveLaw,
    SteeringLimits,
    WaypointLaw,
    east_north_m,
)
from controller.laws.suspension import MAX_LEVEL_M_S, Suspension, spool_pct
from machine.geometry.carrier import heading_rate_rad_s
from machine.status.modes import Mode
from sim.geometry import LocalFrame
from sim.nodes.mach0 import spool_for
from tests.controller.drive_bench import CARRIER, DriveBench, T

DT = T * 1e-9
KP = CARRIER.heading_kp_1_s
LIMIT, RATE = CARRIER.articulation_limit_rad, CARRIER.articulation_rate_limit_rad_s
angles = st.floats(-math.pi, math.pi)
metres = st.floats(-400.0, 400.0)


# -- place


@given(metres, metres, st.floats(-80.0, 80.0), st.floats(-180.0, 180.0))
def test_local_metres_agree_with_the_ellipsoid(east, north, lat, lon):
    latitude, longitude, _ = LocalFrame(lat, lon, 0.0).geodetic(east, north, 0.0)
    found = east_north_m(lat, lon, latitude, longitude)
    assert math.dist(found, (east, north)) < 0.02 + 3e-4 * math.hypot(east, north)


def test_metres_across_the_date_line():
    east, north = east_north_m(0.0, 179.9999, 0.0, -179.9999)
    assert east == pytest.approx(22.26, abs=0.01) and north == 0.0


# -- waypoint


@given(metres, metres, angles)
def test_rate_is_kp_times_the_wrapped_error(east, north, yaw):
    rate = WaypointLaw(CARRIER).step(east, north, yaw)
    error = rate / KP
    assert abs(error) <= math.pi + 1e-9
    bearing = math.atan2(north, east)
    assert math.cos(yaw + error) == pytest.approx(math.cos(bearing), abs=1e-6)
    assert math.sin(yaw + error) == pytest.approx(math.sin(bearing), abs=1e-6)


def test_last_bearing_is_kept_near_the_waypoint():
    law = WaypointLaw(CARRIER)
    law.step(MIN_BEARING_M + 0.1, 0.0, 0.0)
    assert law.step(0.0, MIN_BEARING_M - 0.1, 0.0) == 0.0
    assert law.step(0.0, MIN_BEARING_M + 0.1, 0.0) == pytest.approx(KP * math.pi / 2)
    law.reset()
    assert law.step(0.0, MIN_BEARING_M - 0.1, 0.0) == pytest.approx(KP * math.pi / 2), "the first bearing is used"


@pytest.mark.parametrize("unknown", [(math.nan, 1.0, 0.0), (1.0, math.nan, 0.0), (1.0, 1.0, math.nan)])
def test_unknown_inputs_give_no_rate(unknown):
    assert WaypointLaw(CARRIER).step(*unknown) == 0.0


# -- limits


@given(st.lists(st.tuples(st.floats(-50.0, 50.0) | st.just(math.nan), st.floats(-1.0, 1.0) | st.just(math.nan))))
def test_rate_keeps_its_limits(script):
    limits, before = SteeringLimits(CARRIER), 0.0
    for wanted, angle in script:
        rate = limits.step(wanted if wanted == wanted else 0.0, angle, DT)
        assert abs(rate) <= RATE + 1e-12
        if angle >= LIMIT:
            assert rate <= 0.0
        if angle <= -LIMIT:
            assert rate >= 0.0
        faster = abs(rate) > abs(before) and rate * before >= 0.0
        assert not faster or abs(rate - before) <= RATE / RATE_RISE_S * DT + 1e-12
        before = rate


# -- angle


def test_wanted_angle_is_reached_without_hunting():
    bench = DriveBench().armed()
    bench.run(40)
    for k in range(800):
        bench.tick([bench.bend(0.3, speed_m_s=0.0)] if k % 10 == 0 else ())
        assert bench.bend_rad < 0.3 + 0.015
    assert bench.bend_rad == pytest.approx(0.3, abs=2.0 * ANGLE_BAND_RAD)
    rates = set()
    for k in range(100):
        bench.tick([bench.bend(0.3, speed_m_s=0.0)] if k % 10 == 0 else ())
        rates.add(bench.drive_command["ArticRate"])
    assert rates == {0.0}


def test_moving_angle_is_followed_by_feed_forward():
    bench = DriveBench().armed()
    bench.run(40)
    begin, errors = bench.now_ns, []
    for k in range(800):
        t = (bench.now_ns - begin) * 1e-9
        angle, rate = 0.25 * math.sin(0.6 * t), 0.15 * math.cos(0.6 * t)
        bench.tick([bench.bend(angle, rate)] if k % 10 == 0 else ())
        errors.append(abs(angle - bench.bend_rad))
    assert max(errors[300:]) < 0.04  # valve and oil are 0.18 s behind, at 0.15 rad/s


def test_unknown_angle_gives_no_rate():
    assert AngleLaw(CARRIER, DT).step(0.3, 0.1, math.nan) == 0.0
    limits = SteeringLimits(CARRIER)
    assert limits.step(0.2, math.nan, DT) == 0.0


# -- speed


@given(st.lists(st.floats(-2.0, 2.0), max_size=60), st.sampled_from([0.5, 1.0]))
def test_speed_keeps_limit_and_acceleration(wanted, cap):
    law, before = DriveLaw(CARRIER), 0.0
    for speed in wanted:
        law.step(speed, before, cap, DT)
        assert abs(law.speed_m_s) <= cap * CARRIER.speed_limit_m_s
        if law.brake:  # at once, but only on a machine that stands
            assert law.speed_m_s == 0.0 and abs(before) < STANDING_M_S
        else:
            assert abs(law.speed_m_s - before) <= CARRIER.drive_acceleration_m_s2 * DT + 1e-12
        before = law.speed_m_s


def run(law: DriveLaw, wanted: float, measured: float, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        law.step(wanted, measured, 1.0, DT)


def test_brake_waits_for_standstill_or_a_time_limit():
    law = DriveLaw(CARRIER)
    run(law, 0.4, 0.4, 2.0)
    assert law.speed_m_s == pytest.approx(0.4) and not law.brake
    run(law, 0.0, 0.4, 1.1)
    assert law.speed_m_s == 0.0 and not law.brake
    run(law, 0.0, STANDING_M_S / 2, 0.1)
    assert law.brake
    run(law, 0.0, 0.2, 0.1)
    assert law.brake, "the brake stays on while the machine slides"
    run(law, 0.4, 0.4, 2.0)
    run(law, 0.0, 0.2, 1.0 + SETTLE_S + 0.1)
    assert law.brake


def test_stop_has_its_deceleration():
    law = DriveLaw(CARRIER)
    run(law, 0.6, 0.6, 2.0)
    seconds = law.stop_s
    assert seconds == pytest.approx(0.6 / STOP_M_S2 + SETTLE_S)
    for _ in range(round(seconds / DT) + 1):
        law.stop(0.2, DT)
    assert law.brake and law.stop_s == 0.0


# -- arms


@given(st.floats(-0.2, 0.2))
def test_spool_is_the_inverse_of_the_dead_band(speed):
    percent = spool_pct(CARRIER.arm_valve, speed)
    assert percent == pytest.approx(100.0 * spool_for(CARRIER.arm_valve, speed), abs=1e-9)
    assert -100.0 <= percent <= 100.0 and percent * speed >= 0.0


heights = st.tuples(*[st.floats(0.0, CARRIER.arm_travel_m)] * 4)
tilts = st.floats(-0.4, 0.4) | st.just(math.nan)


@settings(max_examples=40)
@given(heights, heights, st.lists(st.tuples(st.booleans(), tilts, tilts), max_size=30))
def test_arms_keep_travel_and_speed_limits(wanted, measured, script):
    arms = Suspension(CARRIER)
    for level, roll, pitch in script:
        for _ in range(100):
            arms.step(wanted, measured, level, (roll, pitch), (False, False), 1.0, DT)
        assert all(0.0 <= h <= CARRIER.arm_travel_m for h in arms.wanted_m)
        assert all(abs(s) <= CARRIER.arm_rate_limit_m_s for s in arms.speeds_m_s)
        assert max(abs(arms.levelling.roll_m), abs(arms.levelling.pitch_m)) <= CARRIER.arm_travel_m


def test_arm_within_its_band_is_not_controlled():
    arms, band = Suspension(CARRIER), CARRIER.arm_in_band_m
    wanted = (0.3,) * 4

    def speed(height):
        arms.step(wanted, (height, 0.3, 0.3, 0.3), False, (0.0, 0.0), (False, False), 1.0, DT)
        return arms.speeds_m_s[0]

    assert speed(0.3 - 0.9 * band) == 0.0
    assert speed(0.3 - 1.1 * band) > 0.0
    assert speed(0.3 - 0.9 * band) > 0.0, "once it moves it continues until it is near"
    assert speed(0.3 - 0.3 * band) == 0.0
    assert speed(0.3 + 0.9 * band) == 0.0
    assert speed(math.nan) == 0.0


def test_arms_of_a_floating_axle_are_not_controlled():
    arms = Suspension(CARRIER)
    arms.step((0.5,) * 4, (0.3,) * 4, False, (0.0, 0.0), (False, True), 1.0, DT)
    assert arms.spools_pct[0] == arms.spools_pct[1] > 0.0 and arms.spools_pct[2:] == [0.0, 0.0]


@pytest.mark.parametrize(("roll", "pitch"), [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.05), (0.06, -0.05)])
def test_levelling_raises_the_low_side_until_the_frame_is_level(roll, pitch):
    arms, heights = Suspension(CARRIER), [0.3] * 4
    base, track = CARRIER.front_axle_m + CARRIER.rear_axle_m, CARRIER.track_width_m
    fastest, before = 0.0, tuple(heights)

    def lean():
        left, front = (heights[0] + heights[2]) / 2, (heights[0] + heights[1]) / 2
        right, rear = (heights[1] + heights[3]) / 2, (heights[2] + heights[3]) / 2
        return roll + (left - right) / track, pitch + (front - rear) / base

    for k in range(6000):
        arms.step((0.3,) * 4, heights, True, lean(), (False, False), 1.0, DT)
        heights = [h + s * DT for h, s in zip(heights, arms.speeds_m_s, strict=True)]
        if k % 200 == 0:
            fastest = max(fastest, *(abs(a - b) for a, b in zip(heights, before, strict=True)))
            before = tuple(heights)
    assert max(map(abs, lean())) < 0.02
    assert fastest <= 2.0 * (MAX_LEVEL_M_S + 0.002) + CARRIER.arm_in_band_m, "slowly"
    assert sum(heights) / 4 == pytest.approx(0.3, abs=0.01), "without rising"
    for _ in range(4000):
        arms.step((0.3,) * 4, heights, False, lean(), (False, False), 1.0, DT)
        heights = [h + s * DT for h, s in zip(heights, arms.speeds_m_s, strict=True)]
    assert heights == pytest.approx([0.3] * 4, abs=CARRIER.arm_in_band_m), "returns when levelling ends"


# -- closed on a carrier


@pytest.mark.parametrize(
    ("yaw", "place"),
    [
        (0.0, (6.0, 1.5)),
        *(pytest.param(yaw, (20.0, 6.0), marks=pytest.mark.long) for yaw in (1.6, 3.1, -2.0)),
    ],
)
def test_waypoint_is_reached_from_any_heading(yaw, place):
    """Waypoints within the turning circle are left out: no forward motion reaches them."""
    bench = DriveBench()
    bench.yaw_rad = yaw
    bench.armed().run(40)
    least = math.inf
    for k in range(16000):
        bench.tick([bench.to(*place)] if k % 10 == 0 else ())
        away = math.hypot(place[0] - bench.east_m, place[1] - bench.north_m)
        least = min(least, away)
        if away < 0.3:
            break
    assert bench.mode is Mode.ACTIVE and least < 0.3


def test_leaning_mast_is_corrected():
    bench = DriveBench()
    bench.roll_rad, bench.pitch_rad = math.radians(10.0), math.radians(5.0)
    bench.under_way(300, 40.0, 0.0)
    latitude, longitude, _ = bench.site.geodetic(bench.east_m, bench.north_m, 0.0)
    ahead, left = bench.vehicle.reckoning.offset_m(latitude, longitude)
    assert abs(left) < 0.03 and abs(ahead) < 0.1, "the mast is 0.4 m aside"


def test_odometry_propagates_the_heading_between_samples():
    bench = DriveBench().under_way(500, 3.0, 30.0)
    yaw_rate = heading_rate_rad_s(CARRIER, bench.speed_m_s, bench.bend_rad, bench.bend_rate)
    steps = []
    for k in range(40):
        before = bench.vehicle.reckoning.yaw_rad
        bench.tick([bench.to(3.0, 30.0)] if k % 10 == 0 else ())
        steps.append(bench.vehicle.reckoning.yaw_rad - before)
    assert sum(s != 0.0 for s in steps) == 40, "every tick, not every sample"
    assert sum(steps) / (40 * DT) == pytest.approx(yaw_rate, rel=0.25)
