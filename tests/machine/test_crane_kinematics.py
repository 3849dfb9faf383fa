"""Kinematics to the hanger pin: a raw joint table, plain DH matrices, its own derivative, its own inverse; frames."""

from __future__ import annotations

import ast
from itertools import pairwise
from math import cos, hypot, nan, pi, sin
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import machine.geometry.kinematics as kinematics
from machine.geometry.kinematics import (
    MIN_BEND_RAD,
    STOP_MARGIN_SHARE,
    Unreachable,
    chain_points,
    inverse,
    jacobian,
    max_reach_m,
    pin_position,
    reachable_extensions,
    solve,
)
from machine.geometry.link_frames import BASE, LinkFrame, link_frames
from machine.joints import Joint
from machine.loading.profile_file import load_profile, shipped_profiles
from machine.profile import Profile, joint_limits
from tests.codes import coded

PALMS = load_profile("palms_471")
KIN = PALMS.kinematics
LIMITS = joint_limits(PALMS)
# Joint table of the public crane model: origin in the parent frame, joint axis, prismatic or not.
TABLE = (
    ((0.0, 0.0, 0.26881), (0.0, 0.0, 1.0), False),
    ((0.0, -0.0601374, 1.09553), (1.0, 0.0, 0.0), False),
    ((0.0, 3.04904, -0.00649), (1.0, 0.0, 0.0), False),
    ((0.0, 0.1256771629, 0.21905106705), (0.0, 0.997833966, -0.065782793), True),
)
PIN_IN_TELESCOPE = (0.0, 2.03711, -0.20229)


def table_frames(q) -> list[tuple[np.ndarray, np.ndarray]]:
    """(origin, rotation) of each link of the raw table, base frame."""
    p, r, frames = np.zeros(3), np.eye(3), []
    for (origin, axis, prismatic), value in zip(TABLE, q, strict=False):
        p = p + r @ np.array(origin)
        if prismatic:
            p = p + r @ (np.array(axis) / np.linalg.norm(axis) * value)
        else:
            r = r @ Rotation.from_rotvec(np.array(axis) * value).as_matrix()
        frames.append((p, r))
    return frames


def table_pin(q) -> np.ndarray:
    p, r = table_frames(q)[-1]
    return p + r @ np.array(PIN_IN_TELESCOPE)


PROFILES = {name: load_profile(name) for name in shipped_profiles()}
both = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())
shares = st.tuples(*[st.floats(0.0, 1.0)] * 5)


def pose(profile: Profile, share: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(low + s * (high - low) for s, (low, high) in zip(share, joint_limits(profile), strict=True))


def joint_values():
    return st.tuples(*(st.floats(low, high) for low, high in LIMITS))


def is_ordinary(profile: Profile, q) -> bool:
    """Whether the pin is before the mast and the elbow points up: the inverse gives no other poses."""
    c, s = cos(q[0] + profile.kinematics.theta1_offset_rad), sin(q[0] + profile.kinematics.theta1_offset_rad)
    points = chain_points(profile.kinematics, q)
    boom, stick, pin = ((x * c + y * s, z) for x, y, z in (points.boom_pin, points.stick_pin, points.hanger_pin))
    bend = (stick[0] - boom[0]) * (pin[1] - stick[1]) - (stick[1] - boom[1]) * (pin[0] - stick[0])
    return pin[0] > 1e-3 and bend < 0.0


@given(joint_values())
@settings(max_examples=300)
def test_pin_agrees_with_the_raw_joint_table(q):
    assert np.abs(np.array(pin_position(KIN, q)) - table_pin(q)).max() < 4e-10


def test_signs_slew_zero_reaches_y_and_boom_and_stick_are_positive_upward():
    level = (0.0, 0.0, -0.5, 1.0)
    x, y, z = pin_position(KIN, level)
    assert x == pytest.approx(0.0, abs=1e-12) and y > 4.0
    assert pin_position(KIN, (0.1, *level[1:]))[0] < -0.3  # slew turns left seen from above
    assert pin_position(KIN, (0.0, 0.1, -0.5, 1.0))[2] > z + 0.3
    assert pin_position(KIN, (0.0, 0.0, -0.4, 1.0))[2] > z + 0.2
    assert hypot(*pin_position(KIN, (0.0, 0.0, -0.5, 1.1))[:2]) > y


def test_maximum_reach_is_6_949_m():
    assert max_reach_m(PALMS) == pytest.approx(6.949, abs=5e-4)
    rng = np.random.default_rng(2)
    low, high = np.array(LIMITS).T
    reach = max(hypot(*pin_position(KIN, q)[:2]) for q in rng.uniform(low, high, (20000, 5)).tolist())
    assert 6.7 < reach <= max_reach_m(PALMS)


@given(joint_values())
def test_points_for_drawing_are_the_joints_of_the_table(q):
    points = chain_points(KIN, q)
    frames = table_frames(q)
    assert points.base == (0.0, 0.0, 0.0)
    for point, wanted in (
        (points.boom_pin, frames[1][0]),
        (points.stick_pin, frames[2][0]),
        (points.telescope_front, table_pin((*q[:3], 0.0))),
        (points.hanger_pin, table_pin(q)),
    ):
        assert np.abs(np.array(point) - wanted).max() < 4e-10
    pin, rotator, grapple = points[-3:]
    assert pin[:2] == rotator[:2] == grapple[:2]
    assert pin[2] - rotator[2] == pytest.approx(0.415) and pin[2] - grapple[2] == pytest.approx(0.617)


@both
@given(share=shares)
@settings(max_examples=300)
def test_inverse_round_trip_over_reachable_poses(profile, share):
    q, kin = pose(profile, share), profile.kinematics
    assume(is_ordinary(profile, q))
    x, y, z = pin_position(kin, q)
    found = inverse(kin, joint_limits(profile), x, y, z, q[3])
    assert pin_position(kin, (*found, q[3])) == pytest.approx((x, y, z), abs=1e-9)
    if q[2] < -0.05:  # the straight arm is singular: there the angles are only as good as the root of rounding
        assert found == pytest.approx(q[:3], abs=1e-9)


@both
@given(share=shares, how=st.sampled_from(["none", "near", "wish"]))
@settings(max_examples=200)
def test_solve_reaches_every_reachable_pin_within_limits(profile, share, how):
    q = pose(profile, share)
    assume(is_ordinary(profile, q))
    x, y, z = pin_position(profile.kinematics, q)
    preference = {"none": None, "near": q, "wish": q[3]}[how]
    found = solve(profile, x, y, z, preference)
    assert pin_position(profile.kinematics, found) == pytest.approx((x, y, z), abs=1e-9)
    for value, (low, high) in zip(found, joint_limits(profile), strict=False):
        assert low - 1e-8 <= value <= high + 1e-8


@given(joint_values())
@settings(max_examples=200)
def test_reachable_extensions_are_exactly_those_the_inverse_accepts(q):
    assume(is_ordinary(PALMS, q))
    x, y, z = pin_position(KIN, q)
    intervals = reachable_extensions(PALMS, x, y, z)
    assert any(low - 1e-6 <= q[3] <= high + 1e-6 for low, high in intervals)
    assert all(before[1] < after[0] for before, after in pairwise(intervals))
    for ext in np.linspace(*LIMITS[3], 60).tolist():
        if any(abs(ext - edge) < 1e-6 for pair in intervals for edge in pair):
            continue
        inside = any(low < ext < high for low, high in intervals)
        if inside:
            inverse(KIN, LIMITS, x, y, z, ext)
        else:
            with pytest.raises(Unreachable):
                inverse(KIN, LIMITS, x, y, z, ext)


@given(st.floats(0.5, 6.5), st.floats(-1.0, 4.0), st.floats(-1.7, 1.7), joint_values())
@settings(max_examples=200)
def test_solve_with_a_pose_minimizes_the_travel_time(r, z, slew, present):
    x, y = -r * sin(slew), r * cos(slew)
    speeds = [PALMS.joints[name].speed_limit for name in ("lift", "tilt", "ext")]

    def travel_s(q):
        return max(abs(a - b) / v for a, b, v in zip(q[1:4], present[1:4], speeds, strict=True))

    try:
        best = travel_s(solve(PALMS, x, y, z, present))
    except Unreachable:
        assume(False)
    for wish in np.linspace(*LIMITS[3], 40).tolist():
        assert best <= travel_s(solve(PALMS, x, y, z, wish)) + 0.01


def test_solve_uses_the_preferred_extension_or_the_nearest_one():
    assert solve(PALMS, 0.0, 4.5, 0.5, 0.9)[3] == pytest.approx(0.9)
    far = solve(PALMS, 0.0, 6.3, 0.5, 0.2)
    assert far[3] > 0.2
    inner = [(low, high) for low, high in reachable_extensions(PALMS, 0.0, 6.3, 0.5)]
    assert far[3] - inner[0][0] < 0.05  # no longer than the bend of the elbow asks


def test_solve_without_preference_keeps_off_the_stops_and_the_straight_arm():
    for x, y, z in ((0.0, 4.5, -0.5), (-1.8, 4.4, 0.5), (3.47, 0.96, 1.0)):
        q = solve(PALMS, x, y, z)
        for i in (Joint.LIFT, Joint.TILT, Joint.EXT):
            low, high = LIMITS[i]
            assert min(q[i] - low, high - q[i]) > STOP_MARGIN_SHARE * (high - low)
        assert q[Joint.TILT] < -MIN_BEND_RAD


def test_points_that_need_a_straight_arm_are_reached():
    z = KIN.d1_m
    assert solve(PALMS, 0.0, 6.94, z)[3] > 1.78
    edge = max_reach_m(PALMS)
    q = solve(PALMS, 0.0, edge, z)
    assert q[3] == LIMITS[3][1] and pin_position(KIN, q)[1] == pytest.approx(edge, abs=1e-7)


@pytest.mark.parametrize(
    ("point", "code", "named"),
    [
        ((0.0, 7.269103, 1.36434), "reach.too-far", ("(0.00, 7.27, 1.36) m", "0.32 m")),
        ((0.0, -5.0, 1.0), "reach.slew", ("180.0 deg", "-100.0..100.0 deg")),
        ((4.0, -1.5, 1.0), "reach.slew", ("-110.6 deg", "-100.0..100.0 deg")),
        ((0.0, 1.0, 5.2), "reach.boom-upper-stop", ("34.7 deg",)),
        ((0.0, 4.9, -3.3), "reach.boom-lower-stop", ("5.4 deg",)),
        ((0.0, -0.0601374, 1.36434), "reach.slew", ("180.0 deg",)),
    ],
)
def test_solve_gives_the_reason_of_an_unreachable_point(point, code, named):
    with pytest.raises(Unreachable, check=coded(code)) as caught:
        solve(PALMS, *point)
    assert all(number in str(caught.value) for number in named)
    assert reachable_extensions(PALMS, *point) == ()
    with pytest.raises(Unreachable):
        inverse(KIN, LIMITS, *point, 1.0)


@pytest.mark.parametrize(
    ("point", "ext", "code", "named"),
    [
        ((0.0, 4.0, 0.5), 2.0, "reach.extension", ("2.00 m", "0.13..1.80 m")),
        ((0.0, 6.0, 1.36434), 0.2, "reach.too-far", ("0.65 m",)),
        ((0.0, 0.1, 1.2), 1.8, "reach.too-close", ("0.68 m",)),
        ((0.0, 0.3, 2.3), 1.8, "reach.boom-upper-stop", ("145.7 deg",)),
        ((0.0, 0.45, 1.9), 0.13, "reach.too-close", ("0.02 m",)),
        ((-4.0, -1.5, 1.0), 1.0, "reach.slew", ("110.6 deg",)),
    ],
)
def test_inverse_gives_the_reason_of_an_unreachable_point(point, ext, code, named):
    with pytest.raises(Unreachable, check=coded(code)) as caught:
        inverse(KIN, LIMITS, *point, ext)
    assert all(number in str(caught.value) for number in named)


def test_the_stops_of_the_stick_are_named():
    stiff = [*LIMITS]
    stiff[Joint.TILT] = (-2.0, -0.5)
    with pytest.raises(Unreachable, check=coded("reach.stick-straight-stop")):
        inverse(KIN, stiff, 0.0, 6.8, 1.4, 1.8)
    with pytest.raises(Unreachable, check=coded("reach.stick-folded-stop")):
        inverse(KIN, stiff, 0.0, 2.0, 1.4, 1.0)


def test_the_boom_pin_itself_cannot_be_reached_with_any_extension():
    turned = msgspec.structs.replace(KIN, a1_m=0.5)
    profile = msgspec.structs.replace(PALMS, kinematics=turned)
    with pytest.raises(Unreachable, match=r"0\.00", check=coded("reach.too-close")):
        solve(profile, 0.0, 0.5, KIN.d1_m)


def test_slew_wraps_into_its_limits_from_both_sides():
    for slew in (-1.7, -0.4, 0.0, 1.7):
        x, y, z = pin_position(KIN, (slew, 0.4, -1.2, 0.8))
        assert inverse(KIN, LIMITS, x, y, z, 0.8)[0] == pytest.approx(slew, abs=1e-12)


def test_kinematics_uses_no_numpy():
    tree = ast.parse(Path(kinematics.__file__).read_text())
    names = {n.name for node in ast.walk(tree) if isinstance(node, ast.Import) for n in node.names}
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    standard = {"__future__", "collections.abc", "itertools", "math", "typing"}
    assert not names and modules <= standard | {"machine.joints", "machine.profile", "runtime.errors"}


# -- every shipped crane

GOALS = [(4.27, 1.86, 1.0), (4.27, -1.86, 1.0), (6.0, 1.86, 1.0), (6.0, -1.86, 1.0)]


def matrix(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    ct, st_, ca, sa = cos(theta), sin(theta), cos(alpha), sin(alpha)
    return np.array(
        [[ct, -st_ * ca, st_ * sa, a * ct], [st_, ct * ca, -ct * sa, a * st_], [0, sa, ca, d], [0, 0, 0, 1]]
    )


@both
@given(share=shares)
def test_pin_is_the_product_of_the_standard_dh_matrices(profile, share):
    q, k = pose(profile, share), profile.kinematics
    chain = (
        matrix(q[0] + k.theta1_offset_rad, k.d1_m, k.a1_m, pi / 2)
        @ matrix(q[1] + k.theta2_offset_rad, 0.0, k.a2_m, 0.0)
        @ matrix(q[2] + k.theta3_offset_rad, 0.0, k.a3_m, pi / 2)
        @ matrix(0.0, k.d4_m + q[3], 0.0, 0.0)
    )
    assert np.allclose(pin_position(k, q), chain[:3, 3], atol=1e-12)


@both
@given(share=shares)
def test_jacobian_is_the_derivative(profile, share):
    q, k, step = pose(profile, share), profile.kinematics, 1e-6
    for j in range(4):
        up, down = (pin_position(k, [v + s * (i == j) for i, v in enumerate(q)]) for s in (step, -step))
        column = [(u - d) / (2 * step) for u, d in zip(up, down, strict=True)]
        assert np.allclose([row[j] for row in jacobian(k, q)], column, atol=1e-8)


@pytest.mark.parametrize("goal", GOALS)
def test_the_forwarder_reaches_the_goals_of_paper_b_far_from_every_stop(goal):
    profile = PROFILES["aoro_fc8"]
    q = solve(profile, *goal)
    assert np.allclose(pin_position(profile.kinematics, q), goal, atol=1e-9)
    for value, (low, high) in zip(q, joint_limits(profile), strict=False):
        assert 0.2 < (value - low) / (high - low) < 0.8


def test_the_forwarder_reaches_9_m_backward_and_not_ahead():
    profile = PROFILES["aoro_fc8"]
    assert max_reach_m(profile) == pytest.approx(9.0, abs=0.01)
    assert hypot(*pin_position(profile.kinematics, (0.0, 0.0, -0.0873, 2.5))[:2]) == pytest.approx(9.0, abs=0.03)
    assert pin_position(profile.kinematics, (0.0, 0.0, -1.0, 1.0))[0] > 4.0
    with pytest.raises(Unreachable, match=r"180\.0", check=coded("reach.slew")):
        solve(profile, -4.0, 0.0, 1.0)
    assert abs(solve(profile, 0.0, 4.0, 1.0)[Joint.SLEW]) == pytest.approx(pi / 2)


@both
def test_pick_area_and_bunk_are_within_reach_with_a_hanging_log(profile):
    (x, y), half = profile.workspace.pick_center_m, profile.workspace.pick_half_size_m
    ground, bunk = profile.workspace.ground_z_m, profile.bunk
    for dx in (-half, 0.0, half):
        for dy in (-half, 0.0, half):
            for above in (1.2, 2.5):
                if profile.name == "aoro_fc8" or hypot(x + dx, y + dy) < 6.0:
                    solve(profile, x + dx, y + dy, ground + above)
    for rise in (1.35, bunk.stake_height_m + 1.4):
        solve(profile, *bunk.center_m, bunk.floor_z_m + rise)


# -- the frames for display
def placed(frames: tuple[LinkFrame, ...]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Origin and rotation of every frame in the base frame."""
    found = {BASE: (np.zeros(3), np.eye(3))}
    for frame in frames:
        origin, rotation = found[frame.parent]
        turn = Rotation.from_quat(frame.rotation).as_matrix()
        found[frame.child] = (origin + rotation @ frame.translation_m, rotation @ turn)
    return found


@both
@pytest.mark.parametrize("q", [(0.0, 0.3, -1.0, 0.1, 0.0), (-1.1, 0.9, -1.7, 0.8, 1.2)])
def test_the_frames_chain_to_the_points_of_the_kinematics(profile: Profile, q: tuple[float, ...]) -> None:
    points, frames = chain_points(profile.kinematics, q), placed(link_frames(profile, q))
    for frame, point in (
        ("boom", points.boom_pin),
        ("stick", points.stick_pin),
        ("pin", points.hanger_pin),
        ("grapple", points.grapple),
    ):
        assert frames[frame][0] == pytest.approx(np.array(point), abs=1e-9), frame
    boom = np.array(points.stick_pin) - points.boom_pin
    assert frames["boom"][1][:, 0] == pytest.approx(boom / np.linalg.norm(boom), abs=1e-9), "x is along the boom"
    telescope = np.array(points.hanger_pin) - points.telescope_front
    assert frames["stick"][1][:, 0] == pytest.approx(telescope / np.linalg.norm(telescope), abs=1e-9)
    assert frames["grapple"][1][:, 2] == pytest.approx(np.array([0.0, 0.0, 1.0]), abs=1e-9), "it hangs"


def test_what_depends_on_an_unknown_joint_is_left_out() -> None:
    assert [f.child for f in link_frames(PALMS, (0.0, 0.3, -1.0, 0.1, nan))] == ["column", "boom", "stick", "pin"]
    assert link_frames(PALMS, (0.0, nan, -1.0, 0.1, 0.0)) == ()
