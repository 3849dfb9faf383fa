"""The load of a bunk: where a log comes to rest, and how many fit before the bunk is full."""

from __future__ import annotations

import random
from dataclasses import replace
from math import cos, pi, sin, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.grasp.bunk_load import GRID_M, BunkLoad, log_in_bunk, settled_in_bunk
from autonomy.perception.log_list import LogObservation
from machine.loading.profile_file import load_profile
from machine.profile import Bunk

BUNK = load_profile("aoro_fc8").bunk
HALF_M, FLOOR_M = BUNK.width_m / 2, BUNK.floor_z_m
REACH_M = 0.6
D_M, L_M = 0.25, 2.0
R_M = D_M / 2


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
    z = FLOOR_M + R_M
    pair = heap(lying(-0.13, z), lying(0.13, z))
    hollow = z + sqrt(D_M**2 - 0.13**2)
    for at in (-0.05, 0.0, 0.05):
        assert pair.place_at(at).rest_z_m == pytest.approx(hollow, abs=2e-3)
    assert pair.place_at(0.0).support_z_m == pytest.approx(z + R_M), "the tongs meet the tops of both"


def test_on_the_back_of_a_log_the_worse_side_counts() -> None:
    z = FLOOR_M + R_M
    wall = heap(lying(0.2, z), lying(-0.1, z), lying(0.2, z + D_M))
    assert wall.place_at(-0.1).rest_z_m > z + R_M, "it may roll into the high hollow as well as down to the floor"


def test_a_place_is_chosen_where_what_falls_does_not_roll_to_either_side() -> None:
    z = FLOOR_M + R_M
    rest = heap(*(lying(y, z) for y in (-0.6, 0.0, 0.6))).lowest_place(REACH_M)
    assert 0.2 < abs(rest.across_m) < 0.4, "into the gap, and not on the back of the log beside the stakes"
    assert rest.rest_z_m == pytest.approx(z, abs=1e-3)


def test_logs_that_lie_askew_count_at_their_ends() -> None:
    z = FLOOR_M + R_M
    straight, askew = heap(lying(0.4, z)), heap(lying(0.4, z, skew_rad=0.3))
    assert straight.place_at(-0.05).support_z_m == FLOOR_M
    assert askew.place_at(-0.05).support_z_m == pytest.approx(z + R_M), "its end is 21 cm nearer to the middle"


def test_what_lies_across_counts_everywhere_between_its_ends() -> None:
    z = FLOOR_M + R_M
    across = heap(lying(0.0, z, skew_rad=pi / 2))
    assert all(across.place_at(a).support_z_m == pytest.approx(z + R_M) for a in (0.0, 0.4))


def test_a_released_log_lies_where_it_fell() -> None:
    z = FLOOR_M + R_M
    bed = [lying(-0.13, z), lying(0.13, z)]
    laid = settled_in_bunk(BUNK, replace(lying(0.05, z + 0.9), axis=(0.99, 0.1, 0.1)), bed)
    assert log_in_bunk(BUNK, laid)[1] == pytest.approx(0.0, abs=GRID_M)
    assert laid.center_m[2] == pytest.approx(z + sqrt(D_M**2 - 0.13**2), abs=2e-3) and laid.axis[2] == 0.0
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
