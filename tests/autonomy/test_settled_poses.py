"""Logs lie on the ground or on others, not in it and not in each other: what that tells of logs that are badly seen."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.grasp.cylinders import Cylinders, as_cylinders, default_covariance
from autonomy.grasp.settled_poses import CONTACT_OVERLAP_M, settled_poses, surface_gaps
from autonomy.perception.log_list import ACROSS_2, RADIUS, TILT_2, LogObservation
from tests.autonomy.grasp_scenes import GROUND, log, small_pile

WELL = np.array([0.012, 0.018, 0.007, 0.017, 0.02, 0.03, 0.005])
"""Standard deviations of a log that a surveyed camera sees whole, in the order of ``LogEstimate``, ..."""
HIDDEN = np.array([0.024, 0.058, 0.02, 0.055, 0.27, 0.046, 0.018])
"""... and of one of which it sees a strip."""


def laid(logs: list[LogObservation], *sigmas: np.ndarray) -> tuple[Cylinders, np.ndarray]:
    return settled_poses(as_cylinders(logs), np.stack([np.diag(s**2) for s in sigmas]), GROUND)


def seen_higher(one: LogObservation, by_m: float, diameter_m: float | None = None) -> LogObservation:
    x, y, z = one.center_m
    return replace(one, center_m=(x, y, z + by_m), diameter_m=diameter_m or one.diameter_m)


def undersides(world: Cylinders) -> np.ndarray:
    return np.asarray(world.center[:, 2] - world.radius - GROUND)


def test_a_thin_log_seen_thick_and_sunk_between_two_others_is_thin_and_lies_on_the_ground() -> None:
    row = [log(0, -0.21, diameter=0.29), log(1, 0.0, diameter=0.13), log(2, 0.21, diameter=0.29)]
    world, sigma = laid([row[0], seen_higher(row[1], -0.04, 0.28), row[2]], WELL, HIDDEN, WELL)
    assert world.center[[0, 2]] == pytest.approx(as_cylinders([row[0], row[2]]).center, abs=0.01), "hardly moved"
    assert undersides(world) == pytest.approx(0.0, abs=0.02)
    assert 2.0 * world.radius[1] < 0.2, "there is no room for more"
    assert sqrt(sigma[1, ACROSS_2, ACROSS_2]) < 0.5 * HIDDEN[ACROSS_2]


def test_a_half_hidden_log_that_seems_to_hang_in_the_air_lies_on_the_ground() -> None:
    world, _ = laid([log(0), seen_higher(log(1, 0.4), 0.11)], WELL, HIDDEN)
    assert undersides(world) == pytest.approx(0.0, abs=0.02)


def test_a_log_on_others_stays_there_however_badly_its_height_is_known() -> None:
    pile = small_pile()
    top, ground = as_cylinders(pile).center[2], [WELL, WELL]
    assert laid(pile, *ground, WELL)[0].center[2] == pytest.approx(top, abs=0.005)
    unsure = WELL.copy()
    unsure[[ACROSS_2, TILT_2]] = 0.08
    assert laid(pile, *ground, unsure)[0].center[2] == pytest.approx(top, abs=0.02)


def test_a_common_height_error_is_removed_from_the_logs_on_others_too() -> None:
    pile = small_pile()
    known = np.sqrt(np.diag(default_covariance(pile[0])))
    known[ACROSS_2] = 0.04
    world, sigma = laid([seen_higher(one, 0.06) for one in pile], known, known, known)
    assert world.center == pytest.approx(as_cylinders(pile).center, abs=0.015)
    assert np.all(np.diagonal(sigma, axis1=1, axis2=2) <= known**2 + 1e-12)


def test_one_badly_seen_log_moves_no_others() -> None:
    others = [log(0), seen_higher(log(1, 0.205, diameter=0.2), 0.3)]
    world, _ = laid([*others, seen_higher(log(2, 0.8), -0.15)], WELL, WELL, HIDDEN)
    assert world.center[:2] == pytest.approx(as_cylinders(others).center, abs=0.01)
    assert undersides(world)[2] == pytest.approx(0.0, abs=0.02)


def test_logs_that_lie_on_something_else_are_left_alone() -> None:
    far = [seen_higher(one, 0.5) for one in small_pile()]
    world, sigma = laid(far, WELL, WELL, WELL)
    assert world.center == pytest.approx(as_cylinders(far).center)
    assert sigma == pytest.approx(np.stack([np.diag(WELL**2)] * 3))


def test_of_two_overlapping_logs_the_less_certain_moves() -> None:
    world, _ = laid([log(0), log(1, 0.12)], WELL, HIDDEN)
    assert surface_gaps(world)[0, 1] == pytest.approx(-CONTACT_OVERLAP_M, abs=0.005)
    assert world.center[0] == pytest.approx(as_cylinders([log(0)]).center[0], abs=0.01)
    assert abs(world.radius[1] - 0.1) + abs(world.center[1, 1] - log(1, 0.12).center_m[1]) > 0.03


@given(
    heights=st.lists(st.floats(-0.3, 0.6), min_size=1, max_size=5),
    spread=st.floats(0.0, 0.5),
    sizes=st.lists(st.floats(0.06, 0.5), min_size=5, max_size=5),
)
def test_any_input_gives_finite_estimates_that_are_no_less_certain(
    heights: list[float], spread: float, sizes: list[float]
) -> None:
    logs = [log(i, spread * i, z, 0.3 * i, sizes[i]) for i, z in enumerate(heights)]
    before = np.stack([np.diag(HIDDEN**2)] * len(logs))
    world, sigma = settled_poses(as_cylinders(logs), before, GROUND)
    assert all(np.isfinite(a).all() for a in (world.center, world.axis, world.length, world.radius, sigma))
    assert np.all(world.radius > 0.0) and np.all(world.length >= 2.0 * world.radius)
    assert np.linalg.eigvalsh(sigma).min() > -1e-9
    assert np.all(np.diagonal(sigma, axis1=1, axis2=2) <= np.diagonal(before, axis1=1, axis2=2) + 1e-9)
    assert sigma[:, RADIUS, RADIUS].min() >= 0.0
