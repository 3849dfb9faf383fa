"""Where logs come to rest: in a bunk until it is full, and those that are badly seen on the ground or on others."""

from __future__ import annotations

import random
from dataclasses import replace
from math import cos, pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.grasp.bunk_load import GRID_M, BunkLoad, log_in_bunk, settled_in_bunk
from autonomy.grasp.cylinders import Cylinders, as_cylinders, default_covariance
from autonomy.grasp.settled_poses import CONTACT_OVERLAP_M, settled_poses, surface_gaps
from autonomy.perception.log_list import ACROSS_2, RADIUS, TILT_2, LogObservation
from machine.loading.profile_file import load_profile
from machine.profile import Bunk
from tests.autonomy.grasp_scenes import GROUND, log, small_pile

BUNK = load_profile("aoro_fc8").bunk
HALF_M, FLOOR_M = BUNK.width_m / 2, BUNK.floor_z_m
REACH_M = 0.6
D_M, L_M = 0.25, 2.0
R_M = D_M / 2
LAID_M = FLOOR_M + R_M
HOLLOW_M = LAID_M + sqrt(D_M**2 - 0.13**2)


def lying(across_m: float, z_m: float, bunk: Bunk = BUNK, skew_rad: float = 0.0, diameter_m: float = D_M):
    """A log in the bunk, its middle over the bunk's."""
    yaw = bunk.yaw_rad
    x, y = bunk.center_m[0] - across_m * sin(yaw), bunk.center_m[1] + across_m * cos(yaw)
    axis = (cos(yaw + skew_rad), sin(yaw + skew_rad), 0.0)
    return LogObservation(0, (x, y, z_m), axis, L_M, diameter_m)


def heap(*logs: LogObservation, diameter_m: float = D_M) -> BunkLoad:
    return BunkLoad(BUNK, logs, diameter_m, L_M)


def test_in_an_empty_bunk_it_lies_on_the_floor_in_the_middle() -> None:
    rest = heap().lowest_place(REACH_M)
    assert (rest.across_m, rest.support_z_m, rest.rest_z_m) == (0.0, FLOOR_M, FLOOR_M + R_M)


def test_on_a_slope_it_rolls_to_the_lower_stakes_and_is_laid_near_them() -> None:
    down = (0.0, 0.15)
    slope = BunkLoad(BUNK, (), D_M, L_M, down)
    assert slope.resting_point(0.0)[0] == pytest.approx(HALF_M - R_M, abs=GRID_M)
    assert slope.lowest_place(REACH_M).across_m > 0.5 * REACH_M
    laid = settled_in_bunk(BUNK, lying(0.0, FLOOR_M + 0.5), (), down)
    assert log_in_bunk(BUNK, laid)[1] == pytest.approx(HALF_M - R_M, abs=GRID_M)
    barely = BunkLoad(BUNK, (), D_M, L_M, (0.0, 0.03))
    assert barely.resting_point(0.0)[0] == 0.0, "friction holds it"


def test_the_second_lies_by_the_stakes_clear_of_the_first() -> None:
    rest = heap(lying(0.0, FLOOR_M + R_M)).lowest_place(REACH_M)
    assert abs(rest.across_m) == pytest.approx(REACH_M, abs=GRID_M)
    assert (rest.support_z_m, rest.rest_z_m) == (FLOOR_M, FLOOR_M + R_M)


def test_a_log_rolls_into_the_hollow_between_two() -> None:
    pair = heap(lying(-0.13, LAID_M), lying(0.13, LAID_M))
    for at in (-0.05, 0.0, 0.05):
        assert pair.place_at(at).rest_z_m == pytest.approx(HOLLOW_M, abs=2e-3)
    assert pair.place_at(0.0).support_z_m == pytest.approx(LAID_M + R_M), "the tongs meet the tops of both"


def test_on_the_back_of_a_log_the_worse_side_counts() -> None:
    wall = heap(lying(0.2, LAID_M), lying(-0.1, LAID_M), lying(0.2, LAID_M + D_M))
    assert wall.place_at(-0.1).rest_z_m > LAID_M + R_M, "it may roll into the high hollow as well as down to the floor"


def test_a_place_is_chosen_where_what_falls_does_not_roll_to_either_side() -> None:
    rest = heap(*(lying(y, LAID_M) for y in (-0.6, 0.0, 0.6))).lowest_place(REACH_M)
    assert 0.2 < abs(rest.across_m) < 0.4, "into the gap, and not on the back of the log beside the stakes"
    assert rest.rest_z_m == pytest.approx(LAID_M, abs=1e-3)


def test_a_place_that_may_be_too_high_is_chosen_only_where_no_other_is_low_enough() -> None:
    row = heap(*(lying(y, LAID_M) for y in (-0.54, -0.06, 0.53)))
    best = row.lowest_place(REACH_M)
    assert best.rest_z_m > LAID_M + 0.05, "in a gap that is a little too narrow: beside it there is more room"
    assert row.lowest_place(REACH_M, LAID_M + 0.05).rest_z_m == pytest.approx(LAID_M, abs=1e-3)
    assert row.lowest_place(REACH_M, FLOOR_M) == best


def test_logs_that_lie_askew_count_at_their_ends() -> None:
    straight, askew = heap(lying(0.4, LAID_M)), heap(lying(0.4, LAID_M, skew_rad=0.3))
    assert straight.place_at(-0.05).support_z_m == FLOOR_M
    assert askew.place_at(-0.05).support_z_m == pytest.approx(LAID_M + R_M), "its end is 21 cm nearer to the middle"


def test_what_lies_across_counts_everywhere_between_its_ends() -> None:
    across = heap(lying(0.0, LAID_M, skew_rad=pi / 2))
    assert all(across.place_at(a).support_z_m == pytest.approx(LAID_M + R_M) for a in (0.0, 0.4))


def test_a_released_log_lies_where_it_fell() -> None:
    bed = [lying(-0.13, LAID_M), lying(0.13, LAID_M)]
    laid = settled_in_bunk(BUNK, replace(lying(0.05, LAID_M + 0.9), axis=(0.99, 0.1, 0.1)), bed)
    assert log_in_bunk(BUNK, laid)[1] == pytest.approx(0.0, abs=GRID_M)
    assert laid.center_m[2] == pytest.approx(HOLLOW_M, abs=2e-3) and laid.axis[2] == 0.0
    beside = lying(HALF_M + 0.5, 1.0)
    assert settled_in_bunk(BUNK, beside, bed) is beside


def test_logs_on_the_ground_do_not_matter() -> None:
    assert heap(lying(HALF_M + 0.6, -1.0), lying(0.0, -1.0)).lowest_place(REACH_M) == heap().lowest_place(REACH_M)


@given(
    st.lists(
        st.tuples(st.floats(-0.9, 0.9), st.floats(0.3, 1.2), st.floats(-0.4, 0.4), st.floats(0.1, 0.5)), max_size=30
    ),
    st.floats(0.08, 0.6),
)
def test_a_rest_is_on_something_and_no_higher_than_a_drop_from_there(told, diameter_m) -> None:
    logs = [lying(a, z, skew_rad=k, diameter_m=d) for a, z, k, d in told]
    found = heap(*logs, diameter_m=diameter_m)
    rest = found.lowest_place(REACH_M)
    assert abs(rest.across_m) <= REACH_M + GRID_M and rest.support_z_m >= FLOOR_M
    assert rest.rest_z_m >= FLOOR_M + diameter_m / 2 - 1e-9
    highest = max([FLOOR_M, *(z + d / 2 for _, z, _, d in told)])
    assert rest.support_z_m <= highest + 0.5 and rest.rest_z_m <= highest + 0.5 + diameter_m / 2


@pytest.mark.parametrize("seed", range(5))
def test_paper_bs_logs_find_room(seed: int) -> None:
    """24 logs of 25 cm, each astray by some cm, their middles below the top of the stakes."""
    rng, logs = random.Random(seed), []
    for _ in range(24):
        found = heap(*logs)
        at = found.place_at(found.lowest_place(REACH_M).across_m + rng.gauss(0.0, 0.03))
        # Judged by its own fall: it rolls while another place beside it is lower.
        across, z = rolled(logs, at.across_m)
        logs.append(lying(across, z))
    assert max(log.center_m[2] for log in logs) < FLOOR_M + BUNK.stake_height_m - 0.08


def rolled(logs: list[LogObservation], across_m: float) -> tuple[float, float]:
    """Where a released circle comes to rest, in steps of half a millimetre."""
    beds = [(log_in_bunk(BUNK, log)[1], log.center_m[2]) for log in logs]

    def height(x: float) -> float:
        return max([FLOOR_M + R_M, *(z + sqrt(D_M**2 - (x - a) ** 2) for a, z in beds if abs(x - a) < D_M)])

    at, step = across_m, 5e-4
    while True:
        sides = [x for x in (at - step, at + step) if abs(x) <= HALF_M - R_M]
        down = min(sides, key=height)
        if height(down) >= height(at) - 1e-9:
            return at, height(at)
        at = down


# -- logs that are badly seen
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
def test_any_input_gives_finite_estimates_that_are_no_less_certain(heights, spread, sizes) -> None:
    logs = [log(i, spread * i, z, 0.3 * i, sizes[i]) for i, z in enumerate(heights)]
    before = np.stack([np.diag(HIDDEN**2)] * len(logs))
    world, sigma = settled_poses(as_cylinders(logs), before, GROUND)
    assert all(np.isfinite(a).all() for a in (world.center, world.axis, world.length, world.radius, sigma))
    assert np.all(world.radius > 0.0) and np.all(world.length >= 2.0 * world.radius)
    assert np.linalg.eigvalsh(sigma).min() > -1e-9
    assert np.all(np.diagonal(sigma, axis1=1, axis2=2) <= np.diagonal(before, axis1=1, axis2=2) + 1e-9)
    assert sigma[:, RADIUS, RADIUS].min() >= 0.0
