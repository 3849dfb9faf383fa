"""The true position of the hanger pin and its inverse, and weighing by the lift cylinder."""

from __future__ import annotations

from math import cos, dist, hypot, isnan, nan, pi, sin

import msgspec
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from machine.geometry.kinematics import Unreachable, inverse, pin_position, solve
from machine.geometry.sag import (
    FOOT_SHARE,
    GRAVITY_M_S2,
    MAX_LOAD_KG,
    aim,
    aim_free,
    lean_rad,
    plausible_load_kg,
    true_pin,
)
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import Sag, joint_limits
from machine.sensing import empty_moment_nm, hanging_load_kg, lift_moment_nm
from tests.codes import coded

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")
LIMITS = joint_limits(PALMS)
KIN = PALMS.kinematics
SOFT = Sag(0.004, 0.003, 0.012, 1.4e-6, 5200.0, 2900.0)
LEANING = msgspec.structs.replace(PALMS, sag=SOFT)
GIVES = st.builds(
    Sag,
    st.floats(0.0, 0.008),
    st.floats(0.0, 0.006),
    st.floats(-0.02, 0.05),
    st.floats(0.0, 3e-6),
)
LOADS = st.floats(0.0, 400.0)
INSIDE = st.tuples(*(st.floats(low + 0.05, high - 0.05) for low, high in LIMITS))


@given(GIVES, INSIDE, LOADS)
@settings(max_examples=120, deadline=None)
def test_the_joints_for_a_true_point_bring_the_true_pin_there(sag, q, load_kg):
    point = true_pin(sag, KIN, q, load_kg)
    try:
        found = aim(sag, KIN, LIMITS, *point, q[Joint.EXT], load_kg)
    except Unreachable:
        assume(False)  # a stop, or a point on the far side of the mast, which the inverse does not produce
    assert dist(true_pin(sag, KIN, (*found, q[Joint.EXT]), load_kg), point) < 2e-6


def test_a_point_that_the_lean_carries_past_the_mast_is_refused():
    sag, q = Sag(0.0078125, 0.0, 0.0, 0.0), (1.5, -0.25, -3.0, 0.78125, 0.0)
    with pytest.raises(Unreachable):
        aim(sag, KIN, LIMITS, *true_pin(sag, KIN, q), q[Joint.EXT])


@given(GIVES, INSIDE, LOADS)
@settings(max_examples=50, deadline=None)
def test_a_given_extension_works_as_well(sag, q, load_kg):
    profile = msgspec.structs.replace(PALMS, sag=sag)
    point = true_pin(sag, KIN, q, load_kg)
    try:
        found = aim_free(profile, *point, 0.8, load_kg)
    except Unreachable:
        assume(False)
    assert dist(true_pin(sag, KIN, found, load_kg), point) < 2e-6
    assert all(low - 1e-6 <= v <= high + 1e-6 for v, (low, high) in zip(found, LIMITS, strict=False))


def test_without_a_sag_table_the_encoder_kinematics_apply():
    q = (0.3, 0.6, -1.2, 0.9, 0.0)
    point = pin_position(KIN, q)
    assert true_pin(None, KIN, q, 200.0) == point
    assert aim(None, KIN, LIMITS, *point, 0.9, 200.0) == inverse(KIN, LIMITS, *point, 0.9)
    assert aim_free(PALMS, *point, 0.9, 200.0) == solve(PALMS, *point, 0.9)
    assert true_pin(Sag(0.0, 0.0, 0.0), KIN, q) == pytest.approx(point, abs=1e-12)


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
def test_a_load_turns_the_crane_about_its_foot_by_its_moment(profile):
    kin, q = profile.kinematics, (0.4, 0.5, -0.9, 0.6, 0.0)
    sag, kg = Sag(0.0, 0.0, 0.0, 1e-6), 250.0
    x, y, z = pin_position(kin, q)
    r, up = hypot(x, y), z - FOOT_SHARE * kin.d1_m
    lean = 1e-6 * GRAVITY_M_S2 * kg * r
    assert lean_rad(sag, kin, q, kg) == pytest.approx(lean)
    tx, ty, tz = true_pin(sag, kin, q, kg)
    assert hypot(tx, ty) == pytest.approx(r * cos(lean) + up * sin(lean))
    assert tz - z == pytest.approx(up * (cos(lean) - 1.0) - r * sin(lean))
    assert tx * y == pytest.approx(ty * x), "it leans in the crane's plane"
    assert tz < z - 0.02


def test_an_unreachable_point_is_refused():
    with pytest.raises(Unreachable, check=coded("reach.too-far")):
        aim(SOFT, KIN, LIMITS, 0.0, 7.5, KIN.d1_m, LIMITS[Joint.EXT][1], 400.0)
    with pytest.raises(Unreachable, check=coded("reach.too-far")):
        aim_free(LEANING, 0.0, 7.5, KIN.d1_m, None, 400.0)


@pytest.mark.parametrize("said", [nan, -5.0, MAX_LOAD_KG + 1.0, float("inf")])
def test_an_implausible_load_counts_as_zero(said):
    assert plausible_load_kg(said) == 0.0
    assert plausible_load_kg(180.0) == 180.0


def test_the_moment_is_pressure_times_area_times_arm():
    lift = PALMS.joints["lift"].valve
    at, lever = lift.lever_at[1], lift.lever[1]
    area_arm = lift.flow_plus  # displaced volume per angle is area times arm
    assert lift_moment_nm(PALMS, at, 100.0, 0.0) == pytest.approx(100e5 * area_arm * lever)
    balanced = lift_moment_nm(PALMS, at, 10.0 * lift.flow_minus / lift.flow_plus, 10.0)
    assert balanced == pytest.approx(0.0, abs=1e-6)
    ends = [lift_moment_nm(PALMS, q, 50.0, 0.0) / (50e5 * area_arm) for q in (-9.0, 9.0)]
    assert ends == pytest.approx([lift.lever[0], lift.lever[-1]])
    half = 0.5 * (lift.lever_at[1] + lift.lever_at[2])
    between = lift_moment_nm(PALMS, half, 1.0, 0.0) / (1e5 * area_arm)
    assert between == pytest.approx(0.5 * (lift.lever[1] + lift.lever[2]))


@given(INSIDE, LOADS)
def test_a_load_is_the_moment_beyond_that_of_the_empty_crane(q, load_kg):
    ahead = (lambda p: p[0] * cos(q[0] + pi / 2) + p[1] * sin(q[0] + pi / 2))(pin_position(KIN, q)) - KIN.a1_m
    moment_nm = empty_moment_nm(SOFT, KIN, q) + load_kg * GRAVITY_M_S2 * ahead
    found = hanging_load_kg(SOFT, KIN, q, moment_nm)
    assert isnan(found) if ahead < 1.0 else found == pytest.approx(load_kg, abs=1e-6)


def test_a_load_is_unknown_before_a_calibration():
    q = (0.3, 0.6, -1.2, 0.9, 0.0)
    assert isnan(hanging_load_kg(None, KIN, q, 2e4))
    assert isnan(hanging_load_kg(Sag(0.004, 0.003, 0.012), KIN, q, 2e4))
