"""The grasp by friction alone: a log goes into the bunk; a wrong yaw or a wrong place lifts nothing."""

from __future__ import annotations

import math

import pytest
from crane_driver import Driver

from machine.load import load_profile
from sim.judge import Judge
from sim.scene import random_scene
from sim.truth import load_truth
from sim.world import World

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0)


def attempt(seed: int, across_m: float = 0.0, turned_rad: float = 0.0):
    w = World(PROFILE, NOMINAL, seed, logs=1)
    log = random_scene(PROFILE, NOMINAL.contact, seed, 1)[0]
    judge = Judge(w)
    driver = Driver(w, judge.watch)
    x = log.x_m - across_m * math.sin(log.yaw_rad)
    y = log.y_m + across_m * math.cos(log.yaw_rad)
    driver.pick(x, y, log.yaw_rad + turned_rad)
    return w, judge, driver


def test_a_log_is_grasped_carried_and_laid_into_the_bunk():
    w, judge, driver = attempt(403)
    held = judge.verdict()
    assert held.logs[0].lifted and not held.logs[0].released and not held.success
    assert w.load_kg() == pytest.approx(w.yard.masses[0], rel=0.2)
    driver.place()
    done = judge.verdict()
    assert done.success and done.loaded == 1 and done.logs[0].done
    assert done.max_penetration_m < 5e-3 and done.max_log_speed_m_s < 2.5
    assert 50.0 < done.peak_pressure_bar < 240.0 and done.energy_j > 1e3
    w.close()


def test_a_thin_log_is_scooped_up_and_held():
    w, judge, driver = attempt(423)
    assert w.yard.states()[0].diameter_m < 0.13
    driver.wait(1.0)
    verdict = judge.verdict()
    assert verdict.logs[0].lifted and not verdict.logs[0].released and verdict.max_penetration_m < 5e-3
    w.close()


@pytest.mark.parametrize("wrong", [{"turned_rad": math.pi / 2}, {"across_m": 1.0}])
def test_a_wrong_aim_lifts_nothing(wrong):
    w, judge, _ = attempt(403, **wrong)
    assert not judge.verdict().logs[0].lifted
    w.close()
