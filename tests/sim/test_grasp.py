"""The grasp by friction alone: a log goes into the bunk; a wrong yaw or a wrong place lifts nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from experiments.common.worlds import trial_world
from experiments.plant.grasps import Driver, pick_logs, unload
from experiments.plant.runs import values_of
from machine.loading.profile_file import load_profile
from sim.evaluator import Evaluator
from sim.scenes.arrangements import random_scene
from sim.truth.load import load_truth
from sim.world import World

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0, "palms_471")
Attempt = tuple[World, Evaluator, Driver]


@pytest.fixture
def attempt(request: pytest.FixtureRequest) -> Iterator[Attempt]:
    """A world with one log of this seed, after a grasp at it."""
    seed, aim = request.param
    with trial_world("palms_471", "nominal", seed, random_scene(PROFILE, NOMINAL.wood, seed, 1)) as w:
        evaluator = Evaluator(w)
        driver = Driver(w, evaluator.watch)
        pick_logs(w, driver, **aim)
        yield w, evaluator, driver


@pytest.mark.long
@pytest.mark.parametrize("attempt", [(403, {})], indirect=True)
def test_a_log_is_grasped_carried_and_placed_in_the_bunk(attempt: Attempt) -> None:
    w, evaluator, driver = attempt
    held = evaluator.evaluate()
    assert held.logs[0].lifted and not held.logs[0].released and not held.success
    assert w.load_kg() == pytest.approx(w.log_bodies.masses[0], rel=0.2)
    assert w.grip_n[0] > 9.81 * w.log_bodies.masses[0]
    unload(w, driver, w.log_bodies.states())
    driver.wait(1.0)
    done = evaluator.evaluate()
    assert done.success and done.loaded == 1 and done.logs[0].done
    assert done.max_penetration_m < 5e-3 and done.max_log_speed_m_s < 3.0
    assert 50.0 < done.peak_pressure_bar < 240.0 and done.energy_j > 1e3


@pytest.mark.long
@pytest.mark.parametrize(
    ("attempt", "least_m", "most_m"), [((423, {}), 0.0, 0.13), ((2, {}), 0.29, 0.31)], indirect=["attempt"]
)
def test_thin_and_thick_logs_are_grasped_held_and_released(attempt: Attempt, least_m: float, most_m: float) -> None:
    w, evaluator, driver = attempt
    assert least_m < w.log_bodies.states()[0].diameter_m < most_m
    assert evaluator.evaluate().logs[0].lifted and not evaluator.evaluate().logs[0].released
    unload(w, driver, w.log_bodies.states())
    verdict = evaluator.evaluate()
    assert verdict.logs[0].released and verdict.max_penetration_m < 5e-3


@pytest.mark.long
@pytest.mark.parametrize("attempt", [(403, {"turned_rad": math.pi / 2}), (403, {"across_m": 1.0})], indirect=True)
def test_a_wrong_aim_lifts_nothing(attempt: Attempt) -> None:
    assert not attempt[1].evaluate().logs[0].lifted


@pytest.mark.long
def test_the_same_seed_is_the_same_grasp_to_the_bit_and_another_seed_another() -> None:
    def grasp(seed: int) -> list[tuple[float, ...]]:
        with trial_world("palms_471", "nominal", seed, "single", 1) as w:
            seen: list[tuple[float, ...]] = []
            pick_logs(w, Driver(w, lambda: seen.append(tuple(values_of(w)))))
            return seen

    first = grasp(1)
    assert first == grasp(1) != grasp(2)
