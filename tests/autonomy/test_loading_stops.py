"""Where the machine stops: most logs in reach, none left behind, the base where the real geometry has it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from autonomy.manager.loading_stops import STEP_M, CraneReach, LoadingStop, base_on_path, best_stop
from autonomy.motion.arm_kinematics import Arm
from machine.geometry.carrier import rear_from_front
from machine.loading.profile_file import load_profile
from tests.autonomy.mapped_logs import lying

PROFILE = load_profile("aoro_fc8")
CARRIER = PROFILE.carrier
REACH = CraneReach(Arm(PROFILE), CARRIER)
WHEELBASE_M = CARRIER.front_axle_m + CARRIER.rear_axle_m


def straight(along_m: float):
    """East along y = 0, at the lowest height."""
    return base_on_path(CARRIER, (along_m, 0.0, 0.0), (along_m - WHEELBASE_M, 0.0), 0.0)


def test_the_base_faces_backwards_over_the_bunk() -> None:
    base = straight(10.0)
    assert base.position_m == pytest.approx(
        [10.0 - CARRIER.front_axle_m + CARRIER.crane_base_m[0], 0.0, 1.15], abs=0.03
    )
    assert base.rotation[:, 0] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-9)


def test_the_base_in_a_bend_agrees_with_the_geometry_of_the_carrier() -> None:
    bend = 0.4
    rear = rear_from_front(
        bend, (CARRIER.front_axle_m, 0.0, 0.0)
    )  # front axle in the rear frame, that lies in the plane
    base = base_on_path(CARRIER, (rear[0], rear[1], bend), (-CARRIER.rear_axle_m, 0.0), 0.0)
    assert base.position_m[:2] == pytest.approx(CARRIER.crane_base_m[:2], abs=1e-9)


def test_one_log_is_loaded_from_beside_the_bunk() -> None:
    stop = best_stop([lying(3, 20.0, 4.5)], REACH, straight, 10.0, 40.0)
    assert stop is not None and stop.numbers == (3,)
    x, y, _ = lying(3, 20.0, 4.5).observation(straight(stop.along_m)).center_m
    assert 0.0 < x < 7.0 and abs(abs(y) - 4.5) < 1e-6


def test_several_logs_are_loaded_from_one_stop() -> None:
    logs = [lying(1, 20.0, 4.0), lying(2, 23.0, 4.2), lying(3, 21.5, -4.0)]
    stop = best_stop(logs, REACH, straight, 10.0, 40.0)
    assert stop is not None and sorted(stop.numbers) == [1, 2, 3]


def test_no_log_is_left_for_a_place_with_more_logs() -> None:
    logs = [lying(1, 16.0, 4.0), lying(2, 40.0, 4.0), lying(3, 41.0, 4.0), lying(4, 42.0, -4.0)]
    first = best_stop(logs, REACH, straight, 10.0, 60.0)
    assert first is not None and first.numbers == (1,)
    second = best_stop(logs[1:], REACH, straight, first.along_m, 60.0)
    assert second is not None and sorted(second.numbers) == [2, 3, 4]


@pytest.mark.parametrize("y_m", [0.0, 1.2, 12.0])
def test_logs_under_the_machine_or_out_of_reach_need_no_stop(y_m: float) -> None:
    stop = best_stop([lying(1, 20.0, y_m)], REACH, straight, 18.0, 23.0)
    assert stop is None


def test_work_is_less_for_a_log_near_the_bunk() -> None:
    near, far = (lying(1, 20.0, y).observation(straight(26.0)) for y in (3.5, 6.5))
    assert 0.0 < REACH.work_s(near) < REACH.work_s(far) < math.inf
    assert np.isinf(REACH.work_s(lying(1, 20.0, 0.5).observation(straight(22.0))))


def test_the_altitude_of_the_site_does_not_matter() -> None:
    log = lying(3, 20.0, 4.5)
    high = dataclasses.replace(log, center_m=log.center_m + np.array([0.0, 0.0, 260.0]))
    assert best_stop([high], REACH, straight, 10.0, 40.0) == best_stop([log], REACH, straight, 10.0, 40.0)


def looked_everywhere(logs, begin_m: float, end_m: float) -> LoadingStop | None:
    """The same from the work for every log at every place, as the module's docstring has it."""
    places = np.arange(begin_m, end_m + 1e-9, STEP_M)
    level = [dataclasses.replace(g, center_m=np.array([*g.center_m[:2], 0.5 * g.diameter_m])) for g in logs]
    seen = [[g.observation(straight(x)) for g in level] for x in places.tolist()]
    ground = REACH.ground_z_m + 0.5 * np.array([g.diameter_m for g in logs])
    work = np.array(
        [
            [
                REACH.work_s(dataclasses.replace(o, center_m=(*o.center_m[:2], z)))
                for o, z in zip(row, ground, strict=True)
            ]
            for row in seen
        ]
    ).reshape(len(places), len(logs))
    taken = np.isfinite(work)
    if not taken.any():
        return None
    last = min(np.flatnonzero(column).max() for column in taken.T if column.any())
    sums = np.where(taken, work, 0.0).sum(axis=1)
    best = min(range(last + 1), key=lambda i: (-taken[i].sum(), sums[i], i))
    order = sorted(np.flatnonzero(taken[best]), key=lambda j: work[best, j])
    return LoadingStop(float(places[best]), tuple(logs[j].number for j in order), float(sums[best]))


@pytest.mark.parametrize("seed", range(3))
def test_the_limited_search_finds_the_same_stop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    logs = [lying(n, 20.0 + rng.uniform(-12.0, 14.0), rng.uniform(-9.5, 9.5)) for n in range(1, 5)]
    stop = best_stop(logs, REACH, straight, 16.0, 24.0)
    assert stop is not None and stop == looked_everywhere(logs, 16.0, 24.0)


def test_a_log_at_the_end_of_reach_agrees_with_the_grasp_planner() -> None:
    ways = np.arange(6.0, 9.5, 0.2).tolist()
    stops = [best_stop([lying(1, 20.0, y)], REACH, straight, 24.0, 25.0) for y in ways]
    assert stops == [looked_everywhere([lying(1, 20.0, y)], 24.0, 25.0) for y in ways]
    assert stops[0] is not None and stops[-1] is None
