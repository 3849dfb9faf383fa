"""Paths that the machine can drive."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.navigation.clothoid_path import HARDEST_SHARE, SPACING_M, PathRefused, drivable_path, path_limits
from machine.geometry.carrier import turning_radius_m
from tests.autonomy.driven_carrier import CARRIER, SQUARE
from tests.codes import coded

POINT = st.tuples(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0))


@settings(max_examples=40, deadline=None)
@given(st.lists(POINT, min_size=2, max_size=7))
def test_every_path_is_drivable_or_refused(points: list[tuple[float, float]]) -> None:
    try:
        path = drivable_path(points, CARRIER)
    except PathRefused as error:
        assert len(str(error)) > 20
        return
    hard = path_limits(CARRIER, HARDEST_SHARE, HARDEST_SHARE)
    assert np.abs(path.curve_1_m).max() <= hard.curve_1_m * (1 + 1e-9)
    step = np.diff(path.s_m)
    assert step.min() > 0.0 and step.max() <= SPACING_M * (1 + 1e-9)
    assert np.abs(np.diff(path.curve_1_m) / step).max() <= hard.change_1_m2 * (1 + 1e-6)
    # A corner ends up to 0.04 mm beside its leg, however short the step is that takes it there.
    assert np.abs(np.hypot(*np.diff(path.xy_m, axis=0).T) - step).max() < 1e-3 * SPACING_M
    turned = 0.5 * (path.curve_1_m[1:] + path.curve_1_m[:-1]) * step
    assert np.abs(np.diff(path.heading_rad) - turned).max() < 2e-4
    assert path.xy_m[0] == pytest.approx(points[0]) and path.xy_m[-1] == pytest.approx(points[-1], abs=1e-3)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 2.6), st.sampled_from((-1.0, 1.0)))
def test_a_corner_is_cut_alike_on_both_legs(size: float, way: float) -> None:
    turn = size * way
    end = (40.0 + 40.0 * math.cos(turn), 40.0 * math.sin(turn))
    try:
        path = drivable_path([(0.0, 0.0), (40.0, 0.0), end], CARRIER)
    except PathRefused:
        assert abs(turn) > 2.3
        return
    assert path.heading_rad[-1] == pytest.approx(turn, abs=1e-6)
    s = path.length_m / 2
    x, y, heading, _ = path.at(s)
    assert heading == pytest.approx(turn / 2, abs=1e-3)
    # The middle of the corner lies on the line that halves it.
    along = (x - 40.0) * math.cos(turn / 2) + y * math.sin(turn / 2)
    assert along == pytest.approx(0.0, abs=0.01)


def test_paths_turn_at_most_nine_degrees_per_metre() -> None:
    path = drivable_path(SQUARE, CARRIER)
    sharpest = 1.0 / turning_radius_m(CARRIER, CARRIER.articulation_limit_rad)
    assert math.degrees(sharpest) == pytest.approx(9.03, abs=0.01)
    assert np.abs(path.curve_1_m).max() < 0.81 * sharpest


def test_a_thousand_points_on_a_line_make_a_straight_path() -> None:
    points = [(0.02 * i, 0.03 * math.sin(i)) for i in range(1000)]
    path = drivable_path(points, CARRIER)
    assert np.abs(path.curve_1_m).max() == 0.0


def test_short_legs_are_driven_with_sharper_bends_or_refused() -> None:
    easy = drivable_path([(0, 0), (30, 0), (30, 30)], CARRIER)
    hard = drivable_path([(0, 0), (8.2, 0), (8.2, 30)], CARRIER)
    assert np.abs(hard.curve_1_m).max() > np.abs(easy.curve_1_m).max()
    with pytest.raises(PathRefused, check=coded("path.short-leg")):
        drivable_path([(0, 0), (5, 0), (5, 30)], CARRIER)
    with pytest.raises(PathRefused, check=coded("path.reverses")):
        drivable_path([(0, 0), (30, 0), (1, 0.1)], CARRIER)


@pytest.mark.parametrize("points", [[], [(1.0, 2.0)], [(1.0, 2.0)] * 3])
def test_a_path_needs_two_points(points: list[tuple[float, float]]) -> None:
    with pytest.raises(PathRefused, check=coded("path.too-short")):
        drivable_path(points, CARRIER)
    with pytest.raises(PathRefused, check=coded("path.not-finite")):
        drivable_path([(0.0, 0.0), (math.nan, 1.0)], CARRIER)


@settings(max_examples=40, deadline=None)
@given(st.floats(2.0, 40.0), st.floats(-3.0, 3.0))
def test_the_nearest_point_is_found(s: float, off: float) -> None:
    path = drivable_path(SQUARE, CARRIER)
    x, y, heading, _ = path.at(s)
    x, y = x - off * math.sin(heading), y + off * math.cos(heading)
    assert path.nearest(x, y, s - 1.0, s + 1.0) == pytest.approx(s, abs=0.03)


def test_a_path_continues_straight_past_its_ends() -> None:
    path = drivable_path(SQUARE, CARRIER)
    assert path.nearest(25.0, 22.0) == pytest.approx(path.length_m + 2.0, abs=1e-6)
    assert path.at(path.length_m + 2.0)[:2] == pytest.approx((25.0, 22.0))
    assert path.nearest(-3.0, 1.0) == pytest.approx(-3.0, abs=1e-6)
