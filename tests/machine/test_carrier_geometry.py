"""Carrier geometry: swing arms in both directions, the turning circle, the frames of the two halves."""

from __future__ import annotations

from math import cos, degrees, dist, hypot, inf, pi, sin

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machine.geometry.carrier import (
    ARMS,
    arm_angle_from_height,
    arm_pivot_m,
    base_from_rear,
    heading_rate_rad_s,
    height_from_arm_angle,
    hub_m,
    pivot_height_m,
    rear_from_base,
    rear_from_front,
    turning_radius_m,
    wheel_gap_m,
)
from machine.loading.profile_file import load_profile

AORO = load_profile("aoro_fc8")
CARRIER = AORO.carrier
assert CARRIER is not None
heights = st.floats(0.0, CARRIER.arm_travel_m)
bends = st.floats(-CARRIER.articulation_limit_rad, CARRIER.articulation_limit_rad)
points = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


@given(heights)
def test_height_and_arm_angle_are_each_others_inverse(height):
    angle = arm_angle_from_height(CARRIER, height)
    assert height_from_arm_angle(CARRIER, angle) == pytest.approx(height, abs=1e-12)
    assert arm_angle_from_height(CARRIER, 0.0) <= angle <= arm_angle_from_height(CARRIER, CARRIER.arm_travel_m)


@given(heights, st.sampled_from(ARMS))
def test_the_hub_is_an_arms_length_from_its_pivot_and_stands_on_the_ground(height, arm):
    pivot, hub = arm_pivot_m(CARRIER, arm), hub_m(CARRIER, arm, height)
    assert dist(pivot, hub) == pytest.approx(CARRIER.arm_length_m)
    assert abs(hub[0]) > abs(pivot[0]), "the arm points away from the articulation"
    assert hub[1] == pivot[1] == (1 if arm.endswith("l") else -1) * CARRIER.track_width_m / 2
    assert pivot_height_m(CARRIER, height) + hub[2] == pytest.approx(CARRIER.wheel_radius_m)


def test_at_transport_height_the_axles_are_where_the_profile_says():
    for arm in ARMS:
        x, _, _ = hub_m(CARRIER, arm, CARRIER.arm_transport_m)
        assert x == pytest.approx(CARRIER.front_axle_m if arm[4] == "f" else -CARRIER.rear_axle_m)


def test_an_arm_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match=r"1\.200.*1\.00"):
        arm_angle_from_height(CARRIER, 1.2)


def test_full_articulation_turns_9_degrees_per_metre():
    radius = turning_radius_m(CARRIER, CARRIER.articulation_limit_rad)
    assert radius == pytest.approx(6.34, abs=0.01)
    assert degrees(1.0 / radius) == pytest.approx(9.03, abs=0.02)
    assert turning_radius_m(CARRIER, -CARRIER.articulation_limit_rad) == radius
    assert turning_radius_m(CARRIER, 0.0) == inf
    wide = msgspec.structs.replace(CARRIER, front_axle_m=2.4, rear_axle_m=2.4, articulation_limit_rad=0.733038)
    assert turning_radius_m(wide, 0.733038) == pytest.approx(6.25, abs=0.01)


@given(bends, st.floats(-1.0, 1.0), st.floats(-0.3, 0.3))
def test_heading_rate_implies_no_side_slip_of_the_axles(bend, speed, rate):
    """The rear axle's middle, moved with both rates, may only move along the rear frame."""
    front = heading_rate_rad_s(CARRIER, speed, bend, rate)
    rear = front - rate
    # In the rear frame: the front axle's middle moves along the front's x with ``speed``.
    joint_v = (
        speed * cos(bend) + front * CARRIER.front_axle_m * sin(bend),
        speed * sin(bend) - front * CARRIER.front_axle_m * cos(bend),
    )
    assert joint_v[1] - rear * CARRIER.rear_axle_m == pytest.approx(0.0, abs=1e-12)


@given(bends, points)
def test_the_front_frame_turns_with_the_articulation_and_plus_bends_left(bend, point):
    back = rear_from_front(-bend, rear_from_front(bend, point))
    assert back == pytest.approx(point, abs=1e-12)
    nose = rear_from_front(bend, (CARRIER.front_axle_m, 0.0, 0.0))
    assert nose[1] == pytest.approx(CARRIER.front_axle_m * sin(bend)), "positive bends left"


@given(points)
def test_crane_base_and_rear_frame(point):
    assert base_from_rear(CARRIER, rear_from_base(CARRIER, point)) == pytest.approx(point, abs=1e-9)
    assert rear_from_base(CARRIER, (0.0, 0.0, 0.0)) == CARRIER.crane_base_m


def test_the_crane_faces_the_bunk_and_the_wheels_stand_on_the_ground():
    bunk, place = AORO.bunk, AORO.workspace
    x, y, floor = rear_from_base(CARRIER, (*bunk.center_m, bunk.floor_z_m))
    assert -CARRIER.rear_axle_m - bunk.length_m / 2 < x < CARRIER.crane_base_m[0] - bunk.length_m / 2
    assert y == pytest.approx(0.0, abs=1e-9) and bunk.width_m < CARRIER.track_width_m + CARRIER.wheel_width_m
    assert -CARRIER.rear_axle_m < CARRIER.crane_base_m[0] < 0.0
    # At the lowest height the crane base stands 1.15 m above the ground, and the bunk clears the wheels.
    assert pivot_height_m(CARRIER, 0.0) + CARRIER.crane_base_m[2] == pytest.approx(-place.ground_z_m)
    assert floor > hub_m(CARRIER, "arm_rl", 0.0)[2] + CARRIER.wheel_radius_m + 0.05
    # Logs of 2 m at the near edge of the pick area lie outside the tracks whichever way they point.
    nearest = abs(place.pick_center_m[1]) - place.pick_half_size_m - 1.0
    assert nearest > (CARRIER.track_width_m + CARRIER.wheel_width_m) / 2
    assert hypot(*place.pick_center_m) == pytest.approx(5.0, abs=0.5), "about 5 m past the log (paper B 3.1)"
    assert CARRIER.crane_yaw_rad == pytest.approx(pi)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_wheels_get_closer_with_the_articulation(a, b):
    less, more = sorted((a, b))
    assert wheel_gap_m(CARRIER, more) <= wheel_gap_m(CARRIER, less) + 1e-12
    straight = CARRIER.front_axle_m + CARRIER.rear_axle_m - 2 * CARRIER.wheel_radius_m
    assert wheel_gap_m(CARRIER, 0.0) == pytest.approx(straight)
