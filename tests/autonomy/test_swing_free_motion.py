"""Time laws of planned motions: what hangs from the pin hardly swings after them, and they are fast all the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.time_law import SWING_RAD, PathGeometry, swing_free_law
from autonomy.motion.trajectory import STEP_S, Trajectory, straight_line, within_limits
from machine.geometry.kinematics import Unreachable, pin_position
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile
from machine.profile import Profile, joint
from tests.codes import coded

GRAVITY_M_S2 = 9.81
FINE_S = 0.004
GOALS = [(4.27, 1.86), (6.0, -1.86)]


@dataclass(frozen=True)
class Crane:
    profile: Profile
    arm: Arm


CRANES = {name: Crane(p, Arm(p)) for name in ("aoro_fc8", "palms_471") for p in (load_profile(name),)}
FORWARDER = CRANES["aoro_fc8"]


def trial(goal: tuple[float, float]) -> tuple[Pose, Pose]:
    """Paper B's accuracy test: from over the bunk to a point beside it."""
    arm = FORWARDER.arm
    return arm.compact_pose_above(3.0, 0.0, 3.5, 3.5), arm.compact_pose_above(*goal, 1.0, 1.0)


def sampled(motion: Trajectory, step_s: float = FINE_S) -> tuple[np.ndarray, np.ndarray]:
    both = [motion.at(t) for t in np.arange(-0.02, motion.duration_s + 0.02, step_s)]
    return np.array([b[0] for b in both]), np.array([b[1] for b in both])


def swing_left_rad(profile: Profile, motion: Trajectory, period_s: float, damping: float = 0.0) -> float:
    """A point mass on a rigid massless rod below the pin, in two vertical planes, stepped through the motion."""
    omega = 2.0 * np.pi / period_s
    length_m = GRAVITY_M_S2 / omega**2
    q, _ = sampled(motion)
    pin = np.array([pin_position(profile.kinematics, row)[:2] for row in q])
    pushed = np.diff(pin, 2, axis=0) / FINE_S**2
    angle, rate = np.zeros(2), np.zeros(2)
    for a in pushed:
        rate -= FINE_S * ((a * np.cos(angle) + GRAVITY_M_S2 * np.sin(angle)) / length_m + 2.0 * damping * omega * rate)
        angle += FINE_S * rate
    return float(np.hypot(np.hypot(*angle), np.hypot(*rate) / omega))


def assert_within_limits(profile: Profile, motion: Trajectory) -> None:
    q, velocity = sampled(motion)
    acceleration = np.gradient(velocity, FINE_S, axis=0)
    flow = np.zeros(len(q))
    for j in JOINTS:
        spec = joint(profile, j)
        assert np.max(np.abs(velocity[:, j])) < spec.speed_limit
        assert np.max(np.abs(acceleration[:, j])) < spec.acceleration_limit
        valve = spec.valve
        lever = np.interp(q[:, j], valve.lever_at, valve.lever) if valve.lever else 1.0
        flow += lever * np.where(velocity[:, j] >= 0.0, valve.flow_plus, -valve.flow_minus) * velocity[:, j]
    assert np.max(flow) < 0.96 * profile.hydraulics.pump_flow_m3_s


@pytest.mark.parametrize("goal", GOALS)
def test_the_trial_motions_leave_little_swing_for_every_period_of_the_range(goal: tuple[float, float]) -> None:
    start, end = trial(goal)
    shaped, plain = (straight_line(FORWARDER.arm, start, end, shaped) for shaped in (True, False))
    assert shaped.duration_s == plain.duration_s and shaped.goal == pytest.approx(plain.goal)
    periods = (1.5, 1.57, 1.72, 1.88, 2.03, 2.1)
    left, left_plain = ([swing_left_rad(FORWARDER.profile, m, p) for p in periods] for m in (shaped, plain))
    assert max(left) < 1.15 * SWING_RAD < np.radians(3.0)
    assert max(left) < 0.4 * max(left_plain) and np.mean(left) < 0.4 * np.mean(left_plain)
    for motion in (shaped, plain):
        assert_within_limits(FORWARDER.profile, motion)


@pytest.mark.parametrize("damping", [0.05, 0.1, 0.15])
@pytest.mark.parametrize("goal", GOALS)
def test_links_with_friction_swing_as_little(goal: tuple[float, float], damping: float) -> None:
    motion = straight_line(FORWARDER.arm, *trial(goal))
    left = [swing_left_rad(FORWARDER.profile, motion, p, damping) for p in (1.5, 1.57, 1.72, 1.88, 2.03, 2.1)]
    assert max(left) < 1.1 * SWING_RAD


@pytest.mark.parametrize("goal", GOALS)
def test_a_motion_takes_as_long_as_its_law_says(goal: tuple[float, float]) -> None:
    start, end = (np.array(pose) for pose in trial(goal))
    law = swing_free_law(PathGeometry(FORWARDER.arm, start + np.linspace(0.0, 1.0, 81)[:, None] * (end - start)))
    assert straight_line(FORWARDER.arm, *trial(goal)).duration_s < law.duration_s + STEP_S


@pytest.mark.parametrize("goal", GOALS)
def test_the_law_without_swing_takes_little_longer_than_the_fastest(goal: tuple[float, float]) -> None:
    start, end = (np.array(pose) for pose in trial(goal))
    way = PathGeometry(FORWARDER.arm, start + np.linspace(0.0, 1.0, 81)[:, None] * (end - start))
    fastest, shaped = swing_free_law(way, shaped=False), swing_free_law(way)
    assert fastest.duration_s < shaped.duration_s < 1.13 * fastest.duration_s


@pytest.mark.long
@pytest.mark.parametrize("name", CRANES)
@settings(deadline=None, max_examples=20)
@given(slew=st.floats(-1.2, 1.2), near=st.floats(3.4, 4.2), far=st.floats(4.2, 6.0), z=st.floats(0.8, 1.6))
def test_any_straight_motion_keeps_limits_and_swing(name: str, slew: float, near: float, far: float, z: float) -> None:
    crane = CRANES[name]
    turn = crane.profile.kinematics.theta1_offset_rad
    start = crane.arm.pose_above(near * np.cos(turn), near * np.sin(turn), 1.2, 1.2)
    goal = crane.arm.pose_above(far * np.cos(turn + slew), far * np.sin(turn + slew), z, z)
    motion = straight_line(crane.arm, start, goal)
    assert_within_limits(crane.profile, motion)
    assert crane.arm.pose(motion.goal) == pytest.approx(goal, abs=1e-6)
    assert max(swing_left_rad(crane.profile, motion, p) for p in (1.53, 1.75, 2.05)) < 1.2 * SWING_RAD


def test_a_short_motion_that_needs_a_second_stretch_keeps_its_limits() -> None:
    crane = FORWARDER
    turn = crane.profile.kinematics.theta1_offset_rad
    reach = np.cos(turn), np.sin(turn)
    start = crane.arm.pose_above(*(4.171785896742758 * c for c in reach), 1.2, 1.2)
    goal = crane.arm.pose_above(*(4.203125 * c for c in reach), 1.158203125, 1.158203125)
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
