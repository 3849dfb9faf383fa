"""Paths that the machine can drive, following them, and how fast."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.navigation.clothoid_path import HARDEST_SHARE, SPACING_M, Path, PathRefused, drivable_path, path_limits
from autonomy.navigation.path_drive import (
    MIN_SPEED_SHARE,
    FollowerState,
    PathDrive,
    Rocking,
    follow_path,
    terrain_speed_share,
    tip_margin_m,
)
from machine.geometry.carrier import turning_radius_m
from tests.autonomy.carrier_model import CARRIER, SQUARE, at
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
    with pytest.raises(PathRefused, check=coded("path.reverses")):  # its points lie on one line
        drivable_path([(0.0, 0.0), (30.0, 0.0), (10.0, 0.0), (50.0, 0.0)], CARRIER)
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


# -- follower
def glide(path: Path, x: float, y: float, yaw: float, metres: float, slip: float = 0.0) -> list[float]:
    """Lateral errors of a perfect machine that executes the follower's output, 50 ms per step."""
    lf, lr = CARRIER.front_axle_m, CARRIER.rear_axle_m
    bend, v, dt, stamp = 0.0, 0.6, 0.05, 10**9
    state, errors = FollowerState(), []
    for _ in range(round(metres / v / dt)):
        location = at(x, y, yaw, articulation_rad=bend, course_rad=yaw + slip, stamp_ns=stamp)
        state, steer = follow_path(CARRIER, path, state, location, v)
        errors.append(steer.off_m)
        after = steer.articulation_rad + steer.articulation_rate_rad_s * dt
        assert abs(steer.articulation_rate_rad_s) <= CARRIER.articulation_rate_limit_rad_s
        assert abs(steer.articulation_rad) <= CARRIER.articulation_limit_rad
        middle = 0.5 * (bend + after)
        turn = (v * dt * math.sin(middle) + lr * (after - bend)) / (lf * math.cos(middle) + lr)
        x += v * dt * math.cos(yaw + 0.5 * turn + slip)
        y += v * dt * math.sin(yaw + 0.5 * turn + slip)
        yaw, bend, stamp = yaw + turn, after, stamp + 50_000_000
    return errors


def test_the_follower_stays_on_a_path_with_corners() -> None:
    path = drivable_path(SQUARE, CARRIER)
    assert max(map(abs, glide(path, 0.0, 0.0, 0.0, path.length_m - 1.0))) < 0.03


@settings(max_examples=12, deadline=None)
@given(st.floats(-4.0, 4.0), st.floats(-2.0, 2.0), st.floats(-0.08, 0.08))
def test_the_follower_returns_from_anywhere_and_compensates_side_slip(off: float, yaw: float, slip: float) -> None:
    path = drivable_path([(-5.0, 0.0), (80.0, 0.0)], CARRIER)
    errors = glide(path, 0.0, off, yaw, 45.0, slip)
    assert max(map(abs, errors[-50:])) < 0.02
    assert max(map(abs, errors)) < abs(off) + 13.0  # no wider than its turning circle


def test_the_follower_stays_on_its_lap_where_the_path_crosses_itself() -> None:
    path = drivable_path([(0, 0), (40, 0), (40, 20), (20, 20), (20, -30)], CARRIER)
    _, steer = follow_path(CARRIER, path, FollowerState(s_m=20.0), at(20.0, 0.4, 0.0), 0.6)
    assert steer.s_m == pytest.approx(20.0, abs=0.2) and steer.off_m == pytest.approx(0.4, abs=0.05)
    late = path.length_m - 30.0
    _, steer = follow_path(CARRIER, path, FollowerState(s_m=late), at(20.0, 0.0, -math.pi / 2), 0.6)
    assert steer.s_m == pytest.approx(late, abs=0.2) and abs(steer.off_rad) < 0.01


def test_the_follower_steers_by_course_not_by_heading() -> None:
    path = drivable_path([(-5.0, 0.0), (80.0, 0.0)], CARRIER)
    slides = at(10.0, 0.0, 0.05, course_rad=0.0)
    _, steer = follow_path(CARRIER, path, FollowerState(s_m=10.0), slides, 0.6)
    assert steer.off_rad == 0.0 and steer.articulation_rate_rad_s == pytest.approx(0.0, abs=1e-9)


def test_a_standing_machine_is_not_steered() -> None:
    path = drivable_path(SQUARE, CARRIER)
    _, steer = follow_path(CARRIER, path, FollowerState(), at(3.0, 1.0, 0.5, speed_m_s=0.0), 0.0)
    assert steer.articulation_rate_rad_s == 0.0 and steer.articulation_rad == 0.0


# -- speed
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.6, 0.6))
def test_leaning_reduces_the_margin_and_the_speed(roll: float, pitch: float, bend: float) -> None:
    level = tip_margin_m(CARRIER, at(0, 0, 0, articulation_rad=bend))
    leans = tip_margin_m(CARRIER, at(0, 0, 0, articulation_rad=bend, roll_rad=roll, pitch_rad=pitch))
    more = tip_margin_m(CARRIER, at(0, 0, 0, articulation_rad=bend, roll_rad=3 * roll, pitch_rad=pitch))
    if abs(roll) > 0.1 and abs(bend) < 0.1:
        assert more < leans
    assert 0.5 < level < 1.1
    assert 0.0 <= terrain_speed_share(leans, 0.0) <= 1.0
    assert terrain_speed_share(leans, 0.2) <= terrain_speed_share(leans, 0.0)


def test_the_margin_of_a_level_machine_is_half_its_track() -> None:
    assert tip_margin_m(CARRIER, at(0, 0, 0)) == pytest.approx(0.5 * CARRIER.track_width_m)
    right_down = tip_margin_m(CARRIER, at(0, 0, 0, roll_rad=0.2))
    assert tip_margin_m(CARRIER, at(0, 0, 0, roll_rad=0.2), -1.0) > right_down  # a bend to the right helps
    assert tip_margin_m(CARRIER, at(0, 0, 0, roll_rad=0.2), 1.0) < right_down


def test_rocking_reduces_the_speed_for_a_while() -> None:
    rocking = Rocking()
    for i in range(60):
        rate = rocking.step(at(0, 0, 0, roll_rad=0.02 * (i % 2), stamp_ns=10**9 + i * 50_000_000))
    assert terrain_speed_share(1.0, rate) == pytest.approx(MIN_SPEED_SHARE)
    for i in range(60, 400):
        rate = rocking.step(at(0, 0, 0, stamp_ns=10**9 + i * 50_000_000))
    assert terrain_speed_share(1.0, rate) == 1.0


def test_close_to_tipping_the_machine_does_not_drive() -> None:
    way = PathDrive(CARRIER, drivable_path(SQUARE, CARRIER))
    order = way.step(at(0.0, 0.0, 0.0, roll_rad=0.6))
    assert order.speed_m_s == 0.0 and order.stop_reason
