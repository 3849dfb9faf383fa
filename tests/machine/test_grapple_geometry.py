"""The hanging grapple: yaw modulo pi, rotator choice, tong table against the joint table."""

from __future__ import annotations

from itertools import pairwise
from math import cos, pi, sin

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machine.grapple import (
    grapple_yaw,
    half_gap_m,
    lowest_tip_below_pin_m,
    opening_pct_from_tong_angle,
    pin_to_tong_pivot_m,
    rotator_for_yaw,
    tip_below_pin_m,
    tong_angle_from_opening_pct,
)
from machine.kinematics import Unreachable
from machine.load import load_profile

PALMS = load_profile("palms_471")
TONGS = PALMS.grapple.tongs
ROT = PALMS.joints["rot"]
angles = st.floats(-10.0, 10.0)


def same_axis(a: float, b: float) -> bool:
    return abs((a - b + pi / 2) % pi - pi / 2) < 1e-9


@given(st.floats(-1.7, 1.7), angles, st.floats(-3.1, 3.1))
def test_rotator_gives_the_yaw_modulo_pi_with_the_least_turn(slew, yaw, near):
    rot = rotator_for_yaw(PALMS, slew, yaw, near)
    assert ROT.lower <= rot <= ROT.upper
    assert same_axis(grapple_yaw((slew, 0.0, 0.0, 0.0, rot)), yaw)
    for other in (rot - pi, rot + pi):
        if ROT.lower <= other <= ROT.upper:
            assert abs(rot - near) <= abs(other - near) + 1e-9


def test_convention_at_rotator_zero_the_tongs_open_across_the_reach():
    # Reach +y at slew 0; the carrier's x axis is the opening axis.
    assert grapple_yaw((0.0, 0.4, -1.0, 0.8, 0.0)) == 0.0
    # A log along y (psi = pi/2) is gripped with yaw psi + pi/2 = pi, the same axis.
    assert rotator_for_yaw(PALMS, 0.0, pi / 2 + pi / 2) == pytest.approx(0.0, abs=1e-12)
    assert rotator_for_yaw(PALMS, 0.5, 0.0) == pytest.approx(-0.5)


def test_a_stiff_rotator_says_so():
    spec = msgspec.structs.replace(ROT, lower=-0.2, upper=0.2)
    stiff = msgspec.structs.replace(PALMS, joints={**PALMS.joints, "rot": spec})
    assert rotator_for_yaw(stiff, 1.0, 1.1) == pytest.approx(0.1)
    with pytest.raises(Unreachable) as caught:
        rotator_for_yaw(stiff, 0.0, pi / 2)
    assert str(caught.value) == (
        "grapple yaw 90.0 deg at slew 0.0 deg is out of reach: the rotator turns only -11.5..11.5 deg"
    )


def tip(tong_rad: float) -> tuple[float, float]:
    """(half gap, depth below the pin) of tong 2 by its joint: pivot (0.275, -0.202), tip (0.458, -0.458)."""
    x, z = 0.458, -0.458
    # Closing swings the tip inward and first down: rotation about +y for the tong on the +x side.
    turned = x * cos(tong_rad) + z * sin(tong_rad), -x * sin(tong_rad) + z * cos(tong_rad)
    return 0.275 + turned[0], 0.154 + 0.261 + 0.202 - turned[1]


@pytest.mark.parametrize("angle", TONGS.angle_rad)
def test_the_tong_table_is_the_joint_table(angle):
    gap, depth = tip(angle)
    assert half_gap_m(TONGS, angle) == pytest.approx(gap, abs=1.5e-3)
    assert tip_below_pin_m(TONGS, angle) == pytest.approx(depth, abs=1.5e-3)


@given(st.floats(0.0, 1.222))
def test_interpolation_stays_within_2_cm_of_the_true_tips_until_they_meet(angle):
    gap, depth = tip(angle)
    assert half_gap_m(TONGS, angle) == pytest.approx(gap, abs=0.02)
    assert tip_below_pin_m(TONGS, angle) == pytest.approx(depth, abs=0.02)


def test_tips_close_monotonically_and_sweep_0_18_m_lower():
    gaps = [half_gap_m(TONGS, i * 2.234 / 200) for i in range(201)]
    assert all(a > b for a, b in pairwise(gaps))
    assert lowest_tip_below_pin_m(TONGS) - tip_below_pin_m(TONGS, 0.0) == pytest.approx(0.18, abs=2e-3)
    assert pin_to_tong_pivot_m(PALMS.kinematics) == pytest.approx(0.617)


def test_outside_the_table_the_end_values_hold():
    assert half_gap_m(TONGS, -1.0) == 0.733 and half_gap_m(TONGS, 9.0) == -0.368
    assert tip_below_pin_m(TONGS, -1.0) == 1.075 and tip_below_pin_m(TONGS, 9.0) == 0.696


@given(st.floats(0.0, 100.0))
def test_opening_is_linear_in_the_tong_angle(opening_pct):
    angle = tong_angle_from_opening_pct(TONGS, opening_pct)
    assert 0.0 <= angle <= 2.234
    assert opening_pct_from_tong_angle(TONGS, angle) == pytest.approx(opening_pct, abs=1e-9)


def test_full_opening_is_tong_zero_and_out_of_range_is_clipped():
    assert tong_angle_from_opening_pct(TONGS, 100.0) == 0.0 == tong_angle_from_opening_pct(TONGS, 120.0)
    assert tong_angle_from_opening_pct(TONGS, 0.0) == 2.234 == tong_angle_from_opening_pct(TONGS, -3.0)
    assert opening_pct_from_tong_angle(TONGS, -0.1) == 100.0 and opening_pct_from_tong_angle(TONGS, 3.0) == 0.0
