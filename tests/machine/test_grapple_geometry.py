"""The hanging grapple: yaw modulo pi, rotator choice, jaw table against the joint table."""

from __future__ import annotations

from itertools import pairwise
from math import atan2, cos, pi, sin

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machine.geometry.grapple import (
    grapple_yaw,
    half_gap_m,
    jaw_angle_from_opening_pct,
    lowest_tip_below_pin_m,
    opening_pct_from_jaw_angle,
    pin_to_jaw_pivot_m,
    rotator_for_yaw,
    tip_below_pin_m,
)
from machine.geometry.kinematics import Unreachable, pin_position
from machine.loading.profile_file import load_profile
from tests.codes import numbers_in

PALMS = load_profile("palms_471")
TONGS = PALMS.grapple.jaws
ROT = PALMS.joints["rot"]
angles = st.floats(-10.0, 10.0)


def same_axis(a: float, b: float) -> bool:
    return abs((a - b + pi / 2) % pi - pi / 2) < 1e-9


@given(st.floats(-1.7, 1.7), angles, st.floats(-3.1, 3.1))
def test_rotator_gives_the_yaw_modulo_pi_with_the_least_turn(slew, yaw, near):
    rot = rotator_for_yaw(PALMS, slew, yaw, near)
    assert ROT.lower <= rot <= ROT.upper
    assert same_axis(grapple_yaw(PALMS, (slew, 0.0, 0.0, 0.0, rot)), yaw)
    for other in (rot - pi, rot + pi):
        if ROT.lower <= other <= ROT.upper:
            assert abs(rot - near) <= abs(other - near) + 1e-9


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
@given(st.floats(-1.7, 1.7))
def test_at_rotator_zero_the_jaws_open_across_the_reach_of_both_machines(name, slew):
    profile = load_profile(name)
    x, y, _ = pin_position(profile.kinematics, (slew, 0.4, -1.0, 0.8, 0.0))
    assert same_axis(grapple_yaw(profile, (slew, 0.4, -1.0, 0.8, 0.0)), atan2(y, x) + pi / 2)
    # A log that lies along the reach is gripped with the rotator at 0.
    assert rotator_for_yaw(profile, slew, atan2(y, x) + pi / 2) == pytest.approx(0.0, abs=1e-9)


def test_a_rotator_with_a_small_range_is_reported():
    spec = msgspec.structs.replace(ROT, lower=-0.2, upper=0.2)
    stiff = msgspec.structs.replace(PALMS, joints={**PALMS.joints, "rot": spec})
    assert rotator_for_yaw(stiff, 1.0, 1.1) == pytest.approx(0.1)
    with pytest.raises(Unreachable) as caught:
        rotator_for_yaw(stiff, 0.0, pi / 2)
    assert numbers_in(str(caught.value)) == [90.0, 0.0, -11.5, 11.5]


def palms_tip(tong_rad: float) -> tuple[float, float]:
    """(half gap, depth below the pin) of tong 2 by its joint: pivot (0.275, -0.202), tip (0.458, -0.458)."""
    x, z = 0.458, -0.458
    # Closing swings the tip inward and first down: rotation about +y for the tong on the +x side.
    turned = x * cos(tong_rad) + z * sin(tong_rad), -x * sin(tong_rad) + z * cos(tong_rad)
    return 0.275 + turned[0], 0.154 + 0.261 + 0.202 - turned[1]


def cr250_tip(tong_rad: float) -> tuple[float, float]:
    """(half gap, depth below the pin): pivot 0.25 m off the middle, tip (0.45, -0.45) m from it when open."""
    c, s = cos(tong_rad), sin(tong_rad)
    return 0.25 + 0.45 * (c - s), 0.15 + 0.27 + 0.30 + 0.45 * (c + s)


@pytest.mark.parametrize(
    ("name", "tip", "until_rad", "close_m"),
    [("palms_471", palms_tip, 1.222, 1.5e-3), ("aoro_fc8", cr250_tip, 2.234, 6e-4)],
)
def test_the_jaw_table_is_that_of_one_rigid_jaw_and_between_its_rows_within_2_cm(name, tip, until_rad, close_m):
    """Tongs 2 interpolate the true tips until they meet."""
    tongs = load_profile(name).grapple.jaws
    rows = [(angle, close_m) for angle in tongs.angle_rad]
    for angle, within_m in [*rows, *((i * until_rad / 300, 0.02) for i in range(301))]:
        gap, depth = tip(angle)
        assert half_gap_m(tongs, angle) == pytest.approx(gap, abs=within_m)
        assert tip_below_pin_m(tongs, angle) == pytest.approx(depth, abs=within_m)


def test_tips_close_monotonically_and_sweep_0_18_m_lower():
    gaps = [half_gap_m(TONGS, i * 2.234 / 200) for i in range(201)]
    assert all(a > b for a, b in pairwise(gaps))
    assert lowest_tip_below_pin_m(TONGS) - tip_below_pin_m(TONGS, 0.0) == pytest.approx(0.18, abs=2e-3)
    assert pin_to_jaw_pivot_m(PALMS.kinematics) == pytest.approx(0.617)


def test_outside_the_table_the_end_values_apply():
    assert half_gap_m(TONGS, -1.0) == 0.733 and half_gap_m(TONGS, 9.0) == -0.368
    assert tip_below_pin_m(TONGS, -1.0) == 1.075 and tip_below_pin_m(TONGS, 9.0) == 0.696


@given(st.floats(0.0, 100.0))
def test_opening_is_linear_in_the_jaw_angle(opening_pct):
    angle = jaw_angle_from_opening_pct(TONGS, opening_pct)
    assert 0.0 <= angle <= 2.234
    assert opening_pct_from_jaw_angle(TONGS, angle) == pytest.approx(opening_pct, abs=1e-9)


def test_full_opening_is_jaw_angle_zero_and_out_of_range_is_clipped():
    assert jaw_angle_from_opening_pct(TONGS, 100.0) == 0.0 == jaw_angle_from_opening_pct(TONGS, 120.0)
    assert jaw_angle_from_opening_pct(TONGS, 0.0) == 2.234 == jaw_angle_from_opening_pct(TONGS, -3.0)
    assert opening_pct_from_jaw_angle(TONGS, -0.1) == 100.0 and opening_pct_from_jaw_angle(TONGS, 3.0) == 0.0
