"""Planned motions: smooth, inside the limits, without much swing, nearly as fast as can be, where they should be."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.time_law import SWING_RAD, PathGeometry, swing_free_law
from autonomy.motion.time_optimal import time_optimal_law
from autonomy.motion.trajectory import (
    STEP_S,
    Trajectory,
    follow_path,
    hold,
    joint_motion,
    smooth_progress,
    straight_line,
    travel_over,
    with_quick_rotation,
    within_limits,
)
from machine.geometry.kinematics import Unreachable
from machine.joints import JOINTS, N_JOINTS
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from tests.autonomy.motion_figures import assert_within_limits, pins, sampled, swing
from tests.codes import coded

PROFILE = load_profile("palms_471")
ARM = Arm(PROFILE)
TOP = 1.65


def poses(slew: float = 1.6) -> st.SearchStrategy[Pose]:
    return st.builds(
        lambda slew, r, z, rot: ARM.pose_above(-r * np.sin(slew), r * np.cos(slew), z, TOP)._replace(rot_rad=rot),
        st.floats(-slew, slew),
        st.floats(3.3, 6.2),
        st.floats(-0.2, 1.6),
        st.floats(-3.0, 3.0),
    )


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
    assert_within_limits(PROFILE, motion)
    q, _ = sampled(motion)
    assert ARM.pose(q[0]) == pytest.approx(start, abs=1e-6)
    assert ARM.pose(q[-1]) == pytest.approx(goal, abs=1e-6)
    pin = pins(PROFILE, q)
    assert pin[:, 2].max() < TOP + 0.001
    # It moves sideways only when it is almost up, and goes down only when it is almost there.
    aside = np.minimum(np.hypot(*(pin[:, :2] - pin[0, :2]).T), np.hypot(*(pin[:, :2] - pin[-1, :2]).T))
    far = aside > 0.6
    assert not far.any() or pin[far, 2].min() > TOP - 0.15


@settings(deadline=None, max_examples=20)
@given(poses(), st.floats(-0.2, 1.6))
def test_a_vertical_line_is_vertical(start: Pose, z: float) -> None:
    motion = straight_line(ARM, start, start.at_height(z))
    assert_within_limits(PROFILE, motion)
    pin = pins(PROFILE, sampled(motion)[0])
    assert np.max(np.hypot(*(pin[:, :2] - pin[0, :2]).T)) < 0.001
    assert pin[-1, 2] == pytest.approx(z, abs=1e-6)


def test_a_slew_to_the_bunk_takes_about_ten_seconds_and_leaves_little_swing() -> None:
    start, goal = (ARM.pose_above(*at, TOP).at_height(TOP) for at in ((-1.8, 4.4, -0.1), (3.47, 0.96, 0.3)))
    motion = travel_over(ARM, start, goal, TOP)
    assert 6.0 < motion.duration_s < 11.0
    pin = pins(PROFILE, sampled(motion)[0])
    for period_s in (1.55, 1.6, 1.75, 1.9, 2.0):
        left, largest = swing(pin, period_s)
        assert left < 1.1 * SWING_RAD < largest, period_s


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


# -- laws that leave little swing
GOALS, PERIODS_S = [(4.27, 1.86), (6.0, -1.86)], (1.5, 1.57, 1.72, 1.88, 2.03, 2.1)


@dataclass(frozen=True)
class Crane:
    profile: Profile
    arm: Arm

    def above(self, r_m: float, slew_rad: float, z_m: float) -> Pose:
        turn = self.profile.kinematics.theta1_offset_rad + slew_rad
        return self.arm.pose_above(r_m * np.cos(turn), r_m * np.sin(turn), z_m, z_m)


CRANES = {name: Crane(p, Arm(p)) for name in ("aoro_fc8", "palms_471") for p in (load_profile(name),)}
FORWARDER = CRANES["aoro_fc8"]


def left_rad(crane: Crane, motion: Trajectory, period_s: float, damping: float = 0.0) -> float:
    return swing(pins(crane.profile, sampled(motion)[0]), period_s, damping)[0]


def straight_way(arm: Arm, start: Pose, goal: Pose) -> PathGeometry:
    first, last = np.array(start), np.array(goal)
    return PathGeometry(arm, first + np.linspace(0.0, 1.0, 81)[:, None] * (last - first))


def trial(goal: tuple[float, float]) -> tuple[Pose, Pose]:
    """Paper B's accuracy test: from over the bunk to a point beside it."""
    arm = FORWARDER.arm
    return arm.compact_pose_above(3.0, 0.0, 3.5, 3.5), arm.compact_pose_above(*goal, 1.0, 1.0)


@pytest.mark.parametrize("goal", GOALS)
def test_the_trial_motions_leave_little_swing_for_every_period_of_the_range(goal: tuple[float, float]) -> None:
    start, end = trial(goal)
    shaped, plain = (straight_line(FORWARDER.arm, start, end, shaped) for shaped in (True, False))
    assert shaped.duration_s == plain.duration_s and shaped.goal == pytest.approx(plain.goal)
    left, left_plain = ([left_rad(FORWARDER, m, p) for p in PERIODS_S] for m in (shaped, plain))
    assert max(left) < 1.15 * SWING_RAD < np.radians(3.0)
    assert max(left) < 0.4 * max(left_plain) and np.mean(left) < 0.4 * np.mean(left_plain)
    for motion in (shaped, plain):
        assert_within_limits(FORWARDER.profile, motion)


@pytest.mark.parametrize("damping", [0.05, 0.1, 0.15])
@pytest.mark.parametrize("goal", GOALS)
def test_links_with_friction_swing_as_little(goal: tuple[float, float], damping: float) -> None:
    motion = straight_line(FORWARDER.arm, *trial(goal))
    left = [left_rad(FORWARDER, motion, p, damping) for p in PERIODS_S]
    assert max(left) < 1.1 * SWING_RAD


@pytest.mark.parametrize("goal", GOALS)
def test_the_law_without_swing_takes_little_longer_than_the_fastest(goal: tuple[float, float]) -> None:
    way = straight_way(FORWARDER.arm, *trial(goal))
    fastest, shaped = swing_free_law(way, shaped=False), swing_free_law(way)
    assert fastest.duration_s < shaped.duration_s < 1.13 * fastest.duration_s
    assert straight_line(FORWARDER.arm, *trial(goal)).duration_s < shaped.duration_s + STEP_S, "as its law says"


@pytest.mark.long
@pytest.mark.parametrize("name", CRANES)
@settings(deadline=None, max_examples=20)
@given(slew=st.floats(-1.2, 1.2), near=st.floats(3.4, 4.2), far=st.floats(4.2, 6.0), z=st.floats(0.8, 1.6))
def test_any_straight_motion_keeps_limits_and_swing(name: str, slew: float, near: float, far: float, z: float) -> None:
    crane = CRANES[name]
    start, goal = crane.above(near, 0.0, 1.2), crane.above(far, slew, z)
    motion = straight_line(crane.arm, start, goal)
    assert_within_limits(crane.profile, motion)
    assert crane.arm.pose(motion.goal) == pytest.approx(goal, abs=1e-6)
    assert max(left_rad(crane, motion, p) for p in (1.53, 1.75, 2.05)) < 1.2 * SWING_RAD


def test_a_short_motion_that_needs_a_second_stretch_keeps_its_limits() -> None:
    crane = FORWARDER
    start = crane.above(4.171785896742758, 0.0, 1.2)
    goal = crane.above(4.203125, 0.0, 1.158203125)
    assert_within_limits(crane.profile, straight_line(crane.arm, start, goal))


def test_a_motion_that_no_duration_slows_is_refused() -> None:
    def sampled(duration_s: float) -> np.ndarray:
        q = np.zeros((int(duration_s / STEP_S) + 2, len(JOINTS)))
        q[len(q) // 2, 0] = 0.5
        return q

    with pytest.raises(Unreachable, check=coded("motion.over-limits")):
        within_limits(FORWARDER.arm, sampled, 1.0)


def test_equal_paths_have_equal_laws_and_a_point_has_none() -> None:
    start, end = trial(GOALS[0])
    first, again = (straight_line(Arm(FORWARDER.profile), start, end) for _ in range(2))
    assert first.position == again.position and first.velocity == again.velocity
    still = straight_line(FORWARDER.arm, start, start)
    assert still.duration_s == STEP_S and still.velocity == [(0.0,) * len(JOINTS)] * 2


# -- the quick law
ENDS = {
    "palms_471": ((-1.8, 4.4), (3.47, 0.96), 1.6),
    "aoro_fc8": ((2.4, 0.0), (3.4, 4.1), 2.9),
}


def way_over(name: str) -> PathGeometry:
    arm, (a, b, z) = CRANES[name].arm, ENDS[name]
    return straight_way(arm, *(arm.pose_above(*xy, z - 0.5, z).at_height(z) for xy in (a, b)))


def way_by(arm: Arm, slew_rad: float = 0.0, r_m: float = 0.0, z_m: float = 0.0) -> PathGeometry:
    """From a low place beside the loader."""
    low = arm.pose_above(-1.8, 4.4, 0.0, 1.6)
    goal = low._replace(slew_rad=low.slew_rad + slew_rad, r_m=low.r_m + r_m, z_m=low.z_m + z_m)
    return straight_way(arm, low, goal)


@pytest.mark.parametrize("name", CRANES)
def test_it_keeps_speeds_accelerations_and_pump(name: str) -> None:
    arm, way = CRANES[name].arm, way_over(name)
    law = time_optimal_law(arm, way)
    time_s = np.arange(0.0, law.duration_s + 1e-9, 0.01)
    q = way.curve(law.progress(time_s))[:, :N_JOINTS]
    v = np.gradient(q, 0.01, axis=0)
    a = np.gradient(v, 0.01, axis=0)
    assert np.max(np.abs(v) / arm.speed) < 1.01 and np.max(arm.pump_load(q, v)) < 1.01
    assert np.max(np.abs(a) / arm.acceleration) < 1.04  # cubics between the samples overshoot a little
    assert law.done[0] == 0.0 and law.done[-1] == pytest.approx(1.0)
    assert np.all(np.diff(law.done) >= -1e-9)
    assert np.max(np.abs(v[[0, -1]] / arm.speed)) < 0.01


@pytest.mark.parametrize("name", CRANES)
def test_it_leaves_little_swing_and_says_how_much(name: str) -> None:
    arm, way = CRANES[name].arm, way_over(name)
    law = time_optimal_law(arm, way)
    pin = way.curve(law.progress(np.arange(0.0, law.duration_s, 0.005)))[:, N_JOINTS:]
    assert max(swing(pin, period_s)[0] for period_s in (1.5, 1.8, 2.1)) < 1.15 * SWING_RAD
    assert law.swing_rad <= SWING_RAD
    assert time_optimal_law(arm, way, shaped=False).swing_rad > 2.0 * SWING_RAD


@pytest.mark.parametrize("name", CRANES)
@pytest.mark.parametrize(("shaped", "share", "more_s"), [(False, 1.06, 0.0), (True, 1.0, 1.3)])
def test_a_level_path_takes_little_longer_than_by_the_slow_law(name, shaped, share, more_s) -> None:
    way = way_over(name)
    quick, slow = time_optimal_law(CRANES[name].arm, way, shaped=shaped), swing_free_law(way, shaped=shaped)
    assert quick.duration_s < share * slow.duration_s + more_s


def test_a_vertical_path_needs_no_window() -> None:
    way = way_by(ARM, z_m=1.2)
    law = time_optimal_law(ARM, way)
    assert law.swing_rad == 0.0
    assert law.duration_s < 1.08 * swing_free_law(way).duration_s


def test_a_path_too_short_to_swing_anything_is_as_fast_as_a_vertical_one() -> None:
    up, aside = (way_by(ARM, r_m=r_m, z_m=1.2) for r_m in (0.0, 0.015))
    assert swing_free_law(aside).duration_s < swing_free_law(up).duration_s + 0.05
    pin = aside.curve(np.linspace(0.0, 1.0, 2))[:, N_JOINTS:]
    omega = 2.0 * np.pi / 1.5
    assert not aside.sideways and float(np.hypot(*(pin[1] - pin[0]))) * omega**2 / 9.81 < SWING_RAD


def test_a_leg_of_more_than_a_minute_is_planned() -> None:
    slew = msgspec.structs.replace(PROFILE.joints["slew"], speed_limit=0.025)
    arm = Arm(msgspec.structs.replace(PROFILE, joints={**PROFILE.joints, "slew": slew}))
    law = time_optimal_law(arm, way_by(arm, slew_rad=-2.0))
    assert law.duration_s > 75.0 and law.swing_rad <= SWING_RAD
