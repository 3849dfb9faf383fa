"""Planned motions: smooth, inside the limits, without much swing, and where they should be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.time_law import SWING_RAD
from autonomy.motion.trajectory import (
    Trajectory,
    follow_path,
    hold,
    joint_motion,
    smooth_progress,
    straight_line,
    travel_over,
    with_quick_rotation,
)
from machine.geometry.kinematics import Unreachable, pin_position
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile
from machine.profile import joint
from tests.codes import coded

PROFILE = load_profile("palms_471")
ARM = Arm(PROFILE)
TOP = 1.65
FINE_S = 0.005


def poses(slew: float = 1.6) -> st.SearchStrategy[Pose]:
    return st.builds(
        lambda slew, r, z, rot: ARM.pose_above(-r * np.sin(slew), r * np.cos(slew), z, TOP)._replace(rot_rad=rot),
        st.floats(-slew, slew),
        st.floats(3.3, 6.2),
        st.floats(-0.2, 1.6),
        st.floats(-3.0, 3.0),
    )


def sampled(motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Positions and the velocities that the motion states, every 5 ms, with rest before and after."""
    times = np.arange(-0.1, motion.duration_s + 0.1, FINE_S)
    both = [motion.at(t) for t in times]
    return np.array([b[0] for b in both]), np.array([b[1] for b in both])


def pins(q: np.ndarray) -> np.ndarray:
    return np.array([pin_position(PROFILE.kinematics, row) for row in q])


def assert_within_limits(motion: Trajectory) -> None:
    q, stated = sampled(motion)
    velocity = np.gradient(q, FINE_S, axis=0)
    acceleration = np.gradient(stated, FINE_S, axis=0)
    assert np.max(np.abs(velocity - stated)) < 0.005
    for j in JOINTS:
        spec = joint(PROFILE, j)
        assert q[:, j].min() >= spec.lower and q[:, j].max() <= spec.upper
        assert np.max(np.abs(velocity[:, j])) < spec.speed_limit
        assert np.max(np.abs(acceleration[:, j])) < spec.acceleration_limit
    assert flow_m3_s(q, stated).max() < 0.96 * PROFILE.hydraulics.pump_flow_m3_s


def flow_m3_s(q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """What the valves of all joints take, by the profile."""
    total = np.zeros(len(q))
    for j in JOINTS:
        valve = joint(PROFILE, j).valve
        for i, (at, v) in enumerate(zip(q[:, j], velocity[:, j], strict=True)):
            arm = np.interp(at, valve.lever_at, valve.lever) if valve.lever else 1.0
            total[i] += abs(v) * arm * (valve.flow_plus if v >= 0.0 else valve.flow_minus)
    return total


def test_progress_goes_from_0_to_1_with_rest_up_to_the_jerk_at_both_ends() -> None:
    tau = np.linspace(-0.1, 1.1, 2401)
    s = smooth_progress(tau)
    assert s[0] == 0.0 and s[-1] == 1.0 and np.all(np.diff(s) >= 0.0)
    assert s == pytest.approx(1.0 - s[::-1])
    jerk = np.diff(s, 3) / (tau[1] - tau[0]) ** 3
    assert np.max(np.abs(np.diff(jerk))) < 0.05 * np.max(np.abs(jerk))  # no step in it


@pytest.mark.long
@settings(deadline=None, max_examples=20)
@given(poses(), poses())
def test_a_travel_keeps_the_limits_and_ends_at_the_goal(start: Pose, goal: Pose) -> None:
    motion = travel_over(ARM, start, goal, TOP)
    assert_within_limits(motion)
    q, _ = sampled(motion)
    assert ARM.pose(q[0]) == pytest.approx(start, abs=1e-6)
    assert ARM.pose(q[-1]) == pytest.approx(goal, abs=1e-6)
    pin = pins(q)
    assert pin[:, 2].max() < TOP + 0.001
    # It moves sideways only when it is almost up, and goes down only when it is almost there.
    aside = np.minimum(np.hypot(*(pin[:, :2] - pin[0, :2]).T), np.hypot(*(pin[:, :2] - pin[-1, :2]).T))
    far = aside > 0.6
    assert not far.any() or pin[far, 2].min() > TOP - 0.15


@settings(deadline=None, max_examples=20)
@given(poses(), st.floats(-0.2, 1.6))
def test_a_vertical_line_is_vertical(start: Pose, z: float) -> None:
    motion = straight_line(ARM, start, start.at_height(z))
    assert_within_limits(motion)
    pin = pins(sampled(motion)[0])
    assert np.max(np.hypot(*(pin[:, :2] - pin[0, :2]).T)) < 0.001
    assert pin[-1, 2] == pytest.approx(z, abs=1e-6)


@pytest.mark.parametrize("period_s", [1.55, 1.6, 1.75, 1.9, 2.0])
def test_a_hanging_log_swings_little_after_a_slew(period_s: float) -> None:
    start = ARM.pose_above(-1.8, 4.4, -0.1, TOP).at_height(TOP)
    goal = ARM.pose_above(3.47, 0.96, 0.3, TOP).at_height(TOP)
    pin = pins(sampled(travel_over(ARM, start, goal, TOP))[0])[:, :2]
    omega = 2 * np.pi / period_s
    swing, speed = np.zeros(2), np.zeros(2)  # a pendulum integrated step by step, undamped
    acceleration = np.gradient(np.gradient(pin, FINE_S, axis=0), FINE_S, axis=0)
    largest = 0.0
    for a in acceleration:
        speed += FINE_S * (-a - omega**2 * swing)
        swing += FINE_S * speed
        largest = max(largest, float(np.hypot(*swing)))
    left = np.hypot(np.hypot(*swing), np.hypot(*speed) / omega) * omega**2 / 9.81
    assert left < 1.1 * SWING_RAD < largest * omega**2 / 9.81


def test_a_slew_to_the_bunk_takes_about_ten_seconds() -> None:
    start = ARM.pose_above(-1.8, 4.4, -0.1, TOP).at_height(TOP)
    goal = ARM.pose_above(3.47, 0.96, 0.3, TOP).at_height(TOP)
    assert 6.0 < travel_over(ARM, start, goal, TOP).duration_s < 11.0


def test_hold_stands_still() -> None:
    q = (0.1, 0.5, -1.2, 0.4, 0.3)
    motion = hold(q)
    assert all(motion.at(t) == (q, (0.0,) * 5) for t in (-1.0, 0.0, 0.01, 1.0))


def test_a_wrong_start_fades_out() -> None:
    path = ARM.pose_above(-1.8, 4.4, -0.1, TOP)
    start = path._replace(slew_rad=path.slew_rad + 0.01, z_m=path.z_m + 0.05)
    motion = follow_path(ARM, start, lambda t: path.at_height(path.z_m + 0.02 * t), 3.0, 1.0)
    assert ARM.pose(motion.at(0.0)[0]) == pytest.approx(start, abs=1e-6)
    assert ARM.pose(motion.at(2.0)[0]) == pytest.approx(path.at_height(path.z_m + 0.04), abs=1e-6)


def test_a_pose_outside_the_limits_is_refused() -> None:
    near = ARM.pose_above(-1.8, 4.4, -0.1, TOP)
    with pytest.raises(Unreachable, check=coded("reach.too-far")):
        straight_line(ARM, near, near._replace(r_m=9.0))
    with pytest.raises(Unreachable, check=coded("reach.slew")):
        ARM.pose_above(0.5, -4.0, -0.1, TOP)


def test_a_quick_turn_is_the_same_turn_in_less_time_and_within_the_limits() -> None:
    arm = Arm(load_profile("aoro_fc8"))
    start = np.array([0.0, 0.3, -1.5, 0.5, 0.0])
    slow = joint_motion(arm, start, start + np.array([1.5, 0.2, 0.1, 0.4, 0.7]))
    quick = with_quick_rotation(arm, slow)
    before, after = np.array(slow.position), np.array(quick.position)
    assert after[:, :4] == pytest.approx(before[:, :4]) and len(after) == len(before)
    assert after[[0, -1], 4] == pytest.approx(before[[0, -1], 4])
    turns = [float(np.count_nonzero(np.abs(np.array(m.velocity)[:, 4]) > 0.02)) for m in (slow, quick)]
    assert turns[1] < 0.7 * turns[0]
    assert np.max(np.abs(np.array(quick.velocity)[:, 4])) <= arm.speed[4] + 1e-9
    push = np.gradient(np.array(quick.velocity)[:, 4], 0.02)
    assert np.max(np.abs(push)) <= 1.01 * arm.acceleration[4]
    assert np.array(quick.velocity)[:, 4] == pytest.approx(np.gradient(after[:, 4], 0.02), abs=0.02)
    assert with_quick_rotation(arm, hold(start)).position == hold(start).position
