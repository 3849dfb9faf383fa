"""The log map: stable numbers, improving averages, no logs from the bunk; and stops from which most are in reach."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.manager.loading_stops import STEP_M, CraneReach, LoadingStop, base_on_path, best_stop
from autonomy.manager.log_map import CONFIRMED_HITS, LogMap, nearest
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from machine.geometry.carrier import rear_from_front
from machine.loading.profile_file import load_profile
from tests.autonomy.mapped_logs import base, lying, seen

PROFILE = load_profile("aoro_fc8")
HERE = base(0.0, 0.0, 0.0)


@pytest.fixture
def field() -> LogMap:
    return LogMap(PROFILE.bunk)


def triangle(*variances: float) -> tuple[float, ...]:
    """The covariance of a log without correlations."""
    return tuple(np.diag(variances)[np.triu_indices(7)].tolist())


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-3, 3), st.floats(-3, 3)), min_size=3, max_size=8))
def test_a_log_keeps_its_number_and_position_while_the_machine_passes(poses) -> None:
    field, logs = LogMap(PROFILE.bunk), [lying(7, 12.0, 30.0), lying(9, 15.0, 30.0, 1.2)]
    numbers = set()
    for k, pose in enumerate(poses):
        at = base(*pose)
        field.observe(seen(logs, at), at, k)
        numbers |= {log.number for log in field.logs}
    assert numbers == {1, 2}
    for log, true in zip(field.logs, logs, strict=True):
        assert log.center_m == pytest.approx(true.center_m, abs=1e-9)
        assert log.hits == len(poses)


def test_an_average_is_better_than_its_observations(field: LogMap) -> None:
    rng, at = np.random.default_rng(3), base(0.0, 0.0, 0.3)
    true = lying(1, 6.0, 5.0)
    for k in range(40):
        field.observe(seen([true], at, tuple(rng.normal(0.0, 0.1, 2))), at, k)
    (log,) = field.logs
    assert np.linalg.norm(log.center_m - true.center_m) < 0.05
    assert log.sigma_m == pytest.approx(0.1 / math.sqrt(40), rel=1e-6)


def test_a_more_certain_observation_has_more_weight(field: LogMap) -> None:
    true = lying(1, 6.0, 5.0)
    field.observe(seen([true], HERE, (0.2, 0.0)), HERE, 1)
    (sure,) = seen([true], HERE)
    field.observe([replace(sure, covariance=triangle(*[1e-4] * 7))], HERE, 2)
    assert np.linalg.norm(field.logs[0].center_m - true.center_m) < 0.01


def sighting(
    whole: LogObservation, length_m: float, sigmas_m: tuple[float, float], sense: float = 1.0
) -> LogObservation:
    """The log with its end towards its axis cut off; ``sigmas_m`` of its start and its end."""
    known = triangle(*np.square([0.02, 0.02, 0.02, 0.02, *sigmas_m[:: int(sense)], 0.01]))
    cut_m = 0.5 * (whole.length_m - length_m)
    x, y, z = (c - cut_m * a for c, a in zip(whole.center_m, whole.axis, strict=True))
    axis = tuple(sense * a for a in whole.axis)
    return replace(whole, center_m=(x, y, z), axis=axis, length_m=length_m, covariance=known)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_an_end_that_leaves_the_picture_does_not_move_the_middle(sense: float, field: LogMap) -> None:
    true = lying(1, 6.0, 5.0)
    (whole,) = seen([true], HERE)
    for k in range(20):
        field.observe([sighting(whole, whole.length_m, (0.3, 0.3), sense)], HERE, 1 + k)
    for k in range(30):
        field.observe([sighting(whole, 0.6 * whole.length_m, (0.02, 0.61), sense)], HERE, 30 + k)
    (log,) = field.logs
    assert np.linalg.norm(log.center_m - true.center_m) < 0.02
    assert log.length_m == pytest.approx(whole.length_m, abs=0.02)


@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("others", [2, 3])
def test_a_log_never_seen_whole_is_as_long_as_the_others_once_there_are_some(sense, others, field) -> None:
    true = lying(9, 6.0, 5.0)
    for other in seen([lying(1 + i, 9.0 + 3.0 * i, 8.0) for i in range(others)], HERE):
        field.observe([sighting(other, other.length_m, (0.05, 0.05))], HERE, 1)
    field.remove(1)  # a collected log counts
    (whole,) = seen([true], HERE)
    for k in range(10):
        field.observe([sighting(whole, 1.2, (0.02, 0.61), sense)], HERE, 2 + k)
    log = nearest(field.logs, true.center_m[:2])
    off_m = float(np.linalg.norm(log.center_m - true.center_m))
    assert (off_m < 0.02) == (others >= 3) and (others >= 3 or off_m == pytest.approx(0.4, abs=0.02))


def test_one_observation_does_not_confirm_a_log(field: LogMap) -> None:
    field.observe(seen([lying(1, 6.0, 5.0)], HERE), HERE, 10)
    assert CONFIRMED_HITS == 2 and not field.logs
    field.observe(seen([lying(1, 6.0, 5.0)], HERE), HERE, 20)
    assert len(field.logs) == 1


def test_logs_in_the_bunk_are_not_mapped(field: LogMap) -> None:
    bunk = PROFILE.bunk
    inside = LogObservation(4, (*bunk.center_m, bunk.floor_z_m + 0.2), (1.0, 0.0, 0.0), 2.0, 0.25)
    for k in range(3):
        assert field.observe([inside], HERE, k) == {}
    assert not field.logs


def test_two_logs_side_by_side_stay_separate(field: LogMap) -> None:
    logs = [lying(1, 6.0, 5.0), lying(2, 6.0, 5.3)]
    for k in range(3):
        assert field.observe(seen(logs, HERE), HERE, k) == {1: 1, 2: 2}
    assert len(field.logs) == 2


def test_a_restarted_average_drops_old_observations_and_keeps_misses(field: LogMap) -> None:
    true = lying(1, 6.0, 5.0)
    for k in range(5):
        field.observe(seen([true], HERE, (0.25, 0.0)), HERE, k)
    assert field.record_miss(1) == 1
    for k in range(2):
        field.observe(seen([true], HERE), HERE, 10 + k)
    (log,) = field.logs
    assert log.number == 1 and log.misses == 1
    assert log.center_m == pytest.approx(true.center_m, abs=1e-9)
    field.remove(1)
    assert not field.logs and field.get(1) is None


def test_a_listed_log_is_mapped_at_once_and_matched_when_observed(field: LogMap) -> None:
    field.add_known(lying(0, 6.1, 5.0))
    assert nearest(field.logs, np.array([0.0, 0.0])) is field.logs[0]
    assert field.observe(seen([lying(5, 6.0, 5.0)], HERE), HERE, 1) == {5: 1}


def test_the_logs_near_a_point_are_those_of_the_map_as_it_is_now(field: LogMap) -> None:
    here = np.array([6.0, 5.0])
    for x_m in (6.1, 7.0, 30.0):
        field.add_known(lying(0, x_m, 5.0))
    assert [log.number for log in field.near(here, 2.0)] == [1, 2]
    field.observe(seen([lying(5, 6.0, 5.0)], HERE), HERE, 1)
    assert field.near(here, 0.09)[0] is field.get(1), "the average moved"
    field.record_miss(2)
    assert [log.number for log in field.near(here, 2.0)] == [1], "no longer confirmed"
    field.remove(1)
    assert not field.near(here, 2.0) and [log.number for log in field.near(here, 25.0)] == [3]


@pytest.mark.parametrize(("turn_rad", "logs"), [(0.6, 1), (0.02, 2)])
def test_an_unknown_axis_does_not_split_a_log(turn_rad: float, logs: int, field: LogMap) -> None:
    covariance = triangle(0.01, 0.01, turn_rad**2, turn_rad**2, 0.04, 0.04, 0.01)
    for k, axis in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) * 2):
        field.observe([LogObservation(1, (-4.0, 3.0, -1.3), axis, 2.0, 0.25, covariance)], HERE, k)
    assert len(field.logs) == logs


# -- where the machine stops
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
    rear = rear_from_front(bend, (CARRIER.front_axle_m, 0.0, 0.0))  # the front axle, in the plane of the rear frame
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
    high = replace(log, center_m=log.center_m + np.array([0.0, 0.0, 260.0]))
    assert best_stop([high], REACH, straight, 10.0, 40.0) == best_stop([log], REACH, straight, 10.0, 40.0)


def looked_everywhere(logs, begin_m: float, end_m: float) -> LoadingStop | None:
    """The same from the work for every log at every place, as the module's docstring has it."""
    places = np.arange(begin_m, end_m + 1e-9, STEP_M)
    level = [replace(g, center_m=np.array([*g.center_m[:2], 0.5 * g.diameter_m])) for g in logs]
    seen = [[g.observation(straight(x)) for g in level] for x in places.tolist()]
    ground = REACH.ground_z_m + 0.5 * np.array([g.diameter_m for g in logs])
    rested = [[replace(o, center_m=(*o.center_m[:2], z)) for o, z in zip(row, ground, strict=True)] for row in seen]
    work = np.array([[REACH.work_s(o) for o in row] for row in rested]).reshape(len(places), len(logs))
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
