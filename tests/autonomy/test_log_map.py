"""The log map: stable numbers, improving averages, no logs from the bunk."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.manager.log_map import CONFIRMED_HITS, LogMap, nearest
from autonomy.perception.log_list import LogObservation
from machine.loading.profile_file import load_profile
from tests.autonomy.mapped_logs import base, lying, seen

PROFILE = load_profile("aoro_fc8")


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


def test_an_average_is_better_than_its_observations() -> None:
    field, rng, at = LogMap(PROFILE.bunk), np.random.default_rng(3), base(0.0, 0.0, 0.3)
    true = lying(1, 6.0, 5.0)
    for k in range(40):
        field.observe(seen([true], at, tuple(rng.normal(0.0, 0.1, 2))), at, k)
    (log,) = field.logs
    assert np.linalg.norm(log.center_m - true.center_m) < 0.05
    assert log.sigma_m == pytest.approx(0.1 / math.sqrt(40), rel=1e-6)


def test_a_more_certain_observation_has_more_weight() -> None:
    field, at = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0)
    true = lying(1, 6.0, 5.0)
    (o,) = seen([true], at)
    field.observe(seen([true], at, (0.2, 0.0)), at, 1)
    good = np.zeros((7, 7))
    good[np.diag_indices(7)] = 1e-4
    sure = LogObservation(o.id, o.center_m, o.axis, o.length_m, o.diameter_m, tuple(good[np.triu_indices(7)]))
    field.observe([sure], at, 2)
    assert np.linalg.norm(field.logs[0].center_m - true.center_m) < 0.01


def sighting(
    whole: LogObservation, length_m: float, sigmas_m: tuple[float, float], sense: float = 1.0
) -> LogObservation:
    """The log with its end towards its axis cut off; ``sigmas_m`` of its start and its end."""
    spread = np.diag(np.square([0.02, 0.02, 0.02, 0.02, *sigmas_m[:: int(sense)], 0.01]))
    cut_m = 0.5 * (whole.length_m - length_m)
    x, y, z = (c - cut_m * a for c, a in zip(whole.center_m, whole.axis, strict=True))
    axis = tuple(sense * a for a in whole.axis)
    known = tuple(spread[np.triu_indices(7)].tolist())
    return LogObservation(whole.id, (x, y, z), axis, length_m, whole.diameter_m, known)  # type: ignore[arg-type]


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_an_end_that_leaves_the_picture_does_not_move_the_middle(sense: float) -> None:
    field, at, true = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0), lying(1, 6.0, 5.0)
    (whole,) = seen([true], at)
    for k in range(20):
        field.observe([sighting(whole, whole.length_m, (0.3, 0.3), sense)], at, 1 + k)
    for k in range(30):
        field.observe([sighting(whole, 0.6 * whole.length_m, (0.02, 0.61), sense)], at, 30 + k)
    (log,) = field.logs
    assert np.linalg.norm(log.center_m - true.center_m) < 0.02
    assert log.length_m == pytest.approx(whole.length_m, abs=0.02)


@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("others", [2, 3])
def test_a_log_never_seen_whole_is_as_long_as_the_others_once_there_are_some(sense: float, others: int) -> None:
    field, at, true = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0), lying(9, 6.0, 5.0)
    for other in seen([lying(1 + i, 9.0 + 3.0 * i, 8.0) for i in range(others)], at):
        field.observe([sighting(other, other.length_m, (0.05, 0.05))], at, 1)
    field.remove(1)  # a collected log counts
    (whole,) = seen([true], at)
    for k in range(10):
        field.observe([sighting(whole, 1.2, (0.02, 0.61), sense)], at, 2 + k)
    log = nearest(field.logs, true.center_m[:2])
    assert log is not None
    off_m = float(np.linalg.norm(log.center_m - true.center_m))
    assert (off_m < 0.02) == (others >= 3) and (others >= 3 or off_m == pytest.approx(0.4, abs=0.02))


def test_one_observation_does_not_confirm_a_log() -> None:
    field, at = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0)
    field.observe(seen([lying(1, 6.0, 5.0)], at), at, 10)
    assert CONFIRMED_HITS == 2 and not field.logs
    field.observe(seen([lying(1, 6.0, 5.0)], at), at, 20)
    assert len(field.logs) == 1


def test_logs_in_the_bunk_are_not_mapped() -> None:
    field, at, bunk = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0), PROFILE.bunk
    inside = LogObservation(4, (*bunk.center_m, bunk.floor_z_m + 0.2), (1.0, 0.0, 0.0), 2.0, 0.25)
    for k in range(3):
        assert field.observe([inside], at, k) == {}
    assert not field.logs


def test_two_logs_side_by_side_stay_separate() -> None:
    field, at = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0)
    logs = [lying(1, 6.0, 5.0), lying(2, 6.0, 5.3)]
    for k in range(3):
        assert field.observe(seen(logs, at), at, k) == {1: 1, 2: 2}
    assert len(field.logs) == 2


def test_a_restarted_average_drops_old_observations_and_keeps_misses() -> None:
    field, at = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0)
    true = lying(1, 6.0, 5.0)
    for k in range(5):
        field.observe(seen([true], at, (0.25, 0.0)), at, k)
    assert field.record_miss(1) == 1
    for k in range(2):
        field.observe(seen([true], at), at, 10 + k)
    (log,) = field.logs
    assert log.number == 1 and log.misses == 1
    assert log.center_m == pytest.approx(true.center_m, abs=1e-9)
    field.remove(1)
    assert not field.logs and field.get(1) is None


def test_a_listed_log_is_mapped_at_once_and_matched_when_observed() -> None:
    field, at = LogMap(PROFILE.bunk), base(0.0, 0.0, 0.0)
    field.add_known(lying(0, 6.1, 5.0))
    assert nearest(field.logs, np.array([0.0, 0.0])) is field.logs[0]
    assert field.observe(seen([lying(5, 6.0, 5.0)], at), at, 1) == {5: 1}


def test_an_unknown_axis_does_not_split_a_log() -> None:
    sure, unsure = (
        tuple(np.diag([0.01] * 2 + [turn**2] * 2 + [0.04] * 2 + [0.01])[np.triu_indices(7)].tolist())
        for turn in (0.02, 0.6)
    )
    for covariance, logs in ((unsure, 1), (sure, 2)):
        field = LogMap(PROFILE.bunk)
        for k, axis in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) * 2):
            field.observe([LogObservation(1, (-4.0, 3.0, -1.3), axis, 2.0, 0.25, covariance)], base(0.0, 0.0, 0.0), k)
        assert len(field.logs) == logs
