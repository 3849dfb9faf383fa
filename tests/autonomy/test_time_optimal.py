"""The quick time law: within the limits, calm, and nearly as fast as the slow one."""

from __future__ import annotations

import numpy as np
import pytest

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.time_law import SWING_RAD, PathGeometry, swing_free_law
from autonomy.motion.time_optimal import STEP_S, time_optimal_law
from machine.joints import N_JOINTS
from machine.loading.profile_file import load_profile

ARMS = {name: Arm(load_profile(name)) for name in ("palms_471", "aoro_fc8")}
ENDS = {
    "palms_471": ((-1.8, 4.4), (3.47, 0.96), 1.6),
    "aoro_fc8": ((2.4, 0.0), (3.4, 4.1), 2.9),
}


def way_over(name: str) -> PathGeometry:
    arm, (a, b, z) = ARMS[name], ENDS[name]
    first, last = (np.array(arm.pose_above(*xy, z - 0.5, z).at_height(z)) for xy in (a, b))
    return PathGeometry(arm, first + np.linspace(0.0, 1.0, 81)[:, None] * (last - first))


@pytest.mark.parametrize("name", ARMS)
def test_it_keeps_speeds_accelerations_and_pump(name: str) -> None:
    arm, way = ARMS[name], way_over(name)
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


@pytest.mark.parametrize("name", ARMS)
def test_it_leaves_little_swing_and_says_how_much(name: str) -> None:
    arm, way = ARMS[name], way_over(name)
    law = time_optimal_law(arm, way)
    pin = way.curve(law.done)[:, N_JOINTS:]
    push = np.gradient(np.gradient(pin, STEP_S, axis=0), STEP_S, axis=0)
    for period_s in (1.5, 1.8, 2.1):
        omega, swing, speed = 2.0 * np.pi / period_s, np.zeros(2), np.zeros(2)
        for a in np.repeat(push, 4, axis=0):
            speed += STEP_S / 4 * (-a - omega**2 * swing)
            swing += STEP_S / 4 * speed
        left = np.hypot(np.hypot(*swing), np.hypot(*speed) / omega) * omega**2 / 9.81
        assert left < 1.15 * SWING_RAD
    assert law.swing_rad <= SWING_RAD
    assert time_optimal_law(arm, way, shaped=False).swing_rad > 2.0 * SWING_RAD


@pytest.mark.parametrize("name", ARMS)
def test_without_regard_to_swing_it_is_as_fast_as_the_slow_law(name: str) -> None:
    way = way_over(name)
    quick, slow = time_optimal_law(ARMS[name], way, shaped=False), swing_free_law(way, shaped=False)
    assert quick.duration_s < 1.06 * slow.duration_s


@pytest.mark.parametrize("name", ARMS)
def test_a_level_path_takes_at_most_a_second_longer_than_the_slow_law(name: str) -> None:
    way = way_over(name)
    assert time_optimal_law(ARMS[name], way).duration_s < swing_free_law(way).duration_s + 1.3


def test_a_vertical_path_needs_no_window() -> None:
    arm = ARMS["palms_471"]
    low = np.array(arm.pose_above(-1.8, 4.4, 0.0, 1.6))
    way = PathGeometry(arm, low + np.linspace(0.0, 1.0, 81)[:, None] * np.array([0.0, 0.0, 1.2, 0.0, 0.0]))
    law = time_optimal_law(arm, way)
    assert law.swing_rad == 0.0
    assert law.duration_s < 1.08 * swing_free_law(way).duration_s


def test_a_path_too_short_to_swing_anything_is_as_fast_as_a_vertical_one() -> None:
    arm = ARMS["palms_471"]
    low = np.array(arm.pose_above(-1.8, 4.4, 0.0, 1.6))
    up, aside = (
        PathGeometry(arm, low + np.linspace(0.0, 1.0, 81)[:, None] * np.array([0.0, r_m, 1.2, 0.0, 0.0]))
        for r_m in (0.0, 0.015)
    )
    assert swing_free_law(aside).duration_s < swing_free_law(up).duration_s + 0.05
    pin = aside.curve(np.linspace(0.0, 1.0, 2))[:, N_JOINTS:]
    omega = 2.0 * np.pi / 1.5
    assert not aside.sideways and float(np.hypot(*(pin[1] - pin[0]))) * omega**2 / 9.81 < SWING_RAD
