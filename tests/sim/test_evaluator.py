"""Evaluator and ideal detector on both machines: logs, sag, moments and margins from the ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from machine.loading.profile_file import load_profile
from sim.evaluator import Evaluation, Evaluator
from sim.instruments import detect
from sim.plant import Plant
from sim.scenes.arrangements import arrangement
from sim.truth.load import load_truth
from sim.wood.log_shape import LogSpec
from sim.world import World


@pytest.fixture
def watched() -> Iterator[Callable[..., tuple[World, Evaluation]]]:
    """Makes worlds that are stepped and evaluated."""
    worlds: list[World] = []

    def watch(machine: str, scene, steps: int, before=None) -> tuple[World, Evaluation]:
        profile, truth = load_profile(machine), load_truth("nominal", 0, machine)
        worlds.append(world := World(profile, truth, 0, scene(profile, truth.wood)))
        evaluator = Evaluator(world)
        if before:
            before(world)
        still = [0.0] * len(world.functions)
        for _ in range(steps):
            world.step(still)
            evaluator.watch()
        return world, evaluator.evaluate()

    yield watch
    for world in worlds:
        world.close()


def test_logs_in_the_bunk_are_done_once_at_rest_and_one_beside_it_is_not(watched):
    def scene(profile, wood):
        ground = LogSpec(-1.8, 4.4, 0.3, 2.6, 0.2, 600.0, z_m=0.004)
        return (*arrangement("bunk", profile, wood, 0, 6), ground)

    _, early = watched("palms_471", scene, 40)
    assert not early.success and early.loaded == 0 and all(v.in_bunk for v in early.logs[:6])
    _, verdict = watched("palms_471", scene, 160)
    assert [v.done for v in verdict.logs] == [True] * 6 + [False] and verdict.loaded == 6 and not verdict.success
    assert not any(v.lifted or v.left_ground for v in verdict.logs) and verdict.time_s == pytest.approx(0.4)
    assert verdict.tip_margin_m is None and verdict.max_grip_n == 0.0 and verdict.max_penetration_m == 0.0


def test_a_log_leaning_out_of_the_bunk_is_not_in_it(watched):
    def across(world):
        b = world.profile.bunk
        world.log_bodies.wake()
        turn = world.client.getQuaternionFromEuler([0.0, 1.5708, b.yaw_rad + 1.5708])
        at = (*b.center_m, b.floor_z_m + b.stake_height_m - 0.2)
        world.client.resetBasePositionAndOrientation(world.log_bodies.body_ids[0], at, turn)

    _, verdict = watched("palms_471", lambda p, w: arrangement("bunk", p, w, 0, 1), 1, across)
    assert not verdict.logs[0].in_bunk


def test_the_tip_sags_under_a_load_unlike_the_rigid_chain(watched):
    def load(world):
        link = world.crane.link["rotator"]
        own = world.client.getDynamicsInfo(world.crane.body, link)[0]
        world.client.changeDynamics(world.crane.body, link, mass=own + 250.0)

    _, verdict = watched("palms_471", lambda p, w: (), 1200, load)
    _, empty = watched("palms_471", lambda p, w: (), 40)
    assert empty.sag_m < 2e-3 and 0.02 < verdict.sag_m <= verdict.max_sag_m < 0.3
    assert verdict.tip_m[2] < verdict.rigid_tip_m[2] - 0.01
    reach = (verdict.tip_m[0] ** 2 + verdict.tip_m[1] ** 2) ** 0.5
    assert verdict.max_foot_moment_nm - empty.max_foot_moment_nm > 0.9 * 250.0 * 9.81 * reach
    assert verdict.max_load_kg > 240.0 > 20.0 > empty.max_load_kg


def test_a_loaded_carrier_is_evaluated_in_its_own_frame(watched):
    world, verdict = watched("aoro_fc8", lambda p, w: arrangement("bunk", p, w, 1, 8), 400)
    assert all(v.in_bunk and v.released for v in verdict.logs)
    assert verdict.tip_margin_m is not None and 0.3 < verdict.tip_margin_m < 1.5
    base, _ = world.base_pose()
    assert base[2] > 0.8  # so the bunk's heights are not the world's


# -- the ideal detector reports in the crane's base frame, which a carrier moves


def test_on_a_fixed_machine_the_base_frame_is_the_world() -> None:
    plant = Plant(load_profile("palms_471"), seed=3)
    (seen,), (log,) = detect(plant), plant.logs()
    assert (seen.position_m, seen.axis) == (log.position_m, log.axis)
    assert (seen.length_m, seen.diameter_m) == (log.length_m, log.diameter_m)


def test_on_a_carrier_logs_lie_below_the_crane_base_and_ahead_means_backwards() -> None:
    """Slew 0 points backward, and the base is its height above the ground."""
    plant = Plant(load_profile("aoro_fc8"), seed=3)
    (seen,), (log,) = detect(plant), plant.logs()
    (x, y, z), _ = plant.base_pose()
    assert seen.position_m == pytest.approx(
        (x - log.position_m[0], y - log.position_m[1], log.position_m[2] - z), abs=0.02
    )
    assert math.hypot(*seen.axis) == pytest.approx(1.0)
    assert np.allclose(seen.axis[:2], np.negative(log.axis[:2]), atol=0.02)
    assert seen.position_m[2] < -1.0
