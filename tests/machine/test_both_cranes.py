"""The kinematics serve every shipped crane: against plain DH matrices, its own derivative and its own inverse."""

from __future__ import annotations

from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from machine.geometry.kinematics import Unreachable, inverse, jacobian, max_reach_m, pin_position, solve
from machine.joints import Joint
from machine.loading.profile_file import load_profile, shipped_profiles
from machine.profile import Profile, joint_limits
from tests.codes import coded

PROFILES = {name: load_profile(name) for name in shipped_profiles()}
both = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())
shares = st.tuples(*[st.floats(0.0, 1.0)] * 5)
GOALS = [(4.27, 1.86, 1.0), (4.27, -1.86, 1.0), (6.0, 1.86, 1.0), (6.0, -1.86, 1.0)]


def pose(profile: Profile, share: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(low + s * (high - low) for s, (low, high) in zip(share, joint_limits(profile), strict=True))


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
        assert np.allclose([row[j] for row in jacobian(k, q)], column, atol=1e-7)


@both
@given(share=shares)
def test_inverse_returns_to_the_point_inside_the_limits(profile, share):
    q, k, limits = pose(profile, share), profile.kinematics, joint_limits(profile)
    x, y, z = pin_position(k, q)
    theta = q[0] + k.theta1_offset_rad
    assume(x * cos(theta) + y * sin(theta) > 0.5)  # not folded back behind the slew axis
    assume(q[2] < -0.1)  # not bent over the straight arm
    found = inverse(k, limits, x, y, z, q[3])
    assert np.allclose(pin_position(k, (*found, q[3])), (x, y, z), atol=1e-8)
    for preference in (None, q[3], q):
        solved = solve(profile, x, y, z, preference)
        assert np.allclose(pin_position(k, solved), (x, y, z), atol=1e-8)
        for value, (low, high) in zip(solved, limits, strict=False):
            assert low - 1e-8 <= value <= high + 1e-8


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
