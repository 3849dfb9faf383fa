"""The grasp by friction alone: a log goes into the bunk; a wrong yaw or a wrong place lifts nothing."""

from __future__ import annotations

import math

import pytest

from machine.loading.profile_file import load_profile
from sim.evaluator import Evaluator
from sim.scenes.arrangements import random_scene
from sim.truth.load import load_truth
from sim.world import World
from tests.sim.crane_driver import Driver

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0, "palms_471")


def attempt(seed: int, across_m: float = 0.0, turned_rad: float = 0.0):
    w = World(PROFILE, NOMINAL, seed, random_scene(PROFILE, NOMINAL.wood, seed, 1))
    log = w.log_bodies.states()[0]
    yaw = math.atan2(log.axis[1], log.axis[0])
    evaluator = Evaluator(w)
    driver = Driver(w, evaluator.watch)
    x = log.position_m[0] - across_m * math.sin(yaw)
    y = log.position_m[1] + across_m * math.cos(yaw)
    driver.pick(x, y, yaw + turned_rad)
    return w, evaluator, driver


@pytest.mark.long
def test_a_log_is_grasped_carried_and_placed_in_the_bunk():
    w, evaluator, driver = attempt(403)
    held = evaluator.evaluate()
    assert held.logs[0].lifted and not held.logs[0].released and not held.success
    assert w.load_kg() == pytest.approx(w.log_bodies.masses[0], rel=0.2)
    assert w.grip_n[0] > 9.81 * w.log_bodies.masses[0]
    driver.place()
    done = evaluator.evaluate()
    assert done.success and done.loaded == 1 and done.logs[0].done
    assert done.max_penetration_m < 5e-3 and done.max_log_speed_m_s < 3.0
    assert 50.0 < done.peak_pressure_bar < 240.0 and done.energy_j > 1e3
    w.close()


@pytest.mark.long
@pytest.mark.parametrize(("seed", "least_m", "most_m"), [(423, 0.0, 0.13), (2, 0.29, 0.31)])
def test_thin_and_thick_logs_are_grasped_held_and_released(seed, least_m, most_m):
    w, evaluator, driver = attempt(seed)
    assert least_m < w.log_bodies.states()[0].diameter_m < most_m
    assert evaluator.evaluate().logs[0].lifted and not evaluator.evaluate().logs[0].released
    driver.place()
    verdict = evaluator.evaluate()
    assert verdict.logs[0].released and verdict.max_penetration_m < 5e-3
    w.close()


@pytest.mark.long
@pytest.mark.parametrize("wrong", [{"turned_rad": math.pi / 2}, {"across_m": 1.0}])
def test_a_wrong_aim_lifts_nothing(wrong):
    w, evaluator, _ = attempt(403, **wrong)
    assert not evaluator.evaluate().logs[0].lifted
    w.close()
