"""Movement primitives: they show what was shown, reach other goals, and neither blow up nor mirror what must not be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.motion.movement_primitives import Dmp, learn
from runtime.errors import InputRefused
from tests.codes import coded

TIME_S = np.linspace(0.0, 6.0, 301)
TAU = TIME_S / 6.0
RISE = TAU**3 * (10.0 - 15.0 * TAU + 6.0 * TAU**2)
SHOWN = np.stack([0.2 + 0.9 * RISE, 0.3 + 0.4 * np.sin(np.pi * RISE) ** 2 - 0.1 * RISE], axis=1)
"""A slew, and a height that goes over something and ends a little lower than it began."""
SCALED = learn([(TIME_S, SHOWN)], (True, False))
PLAIN = learn([(TIME_S, SHOWN)])
# movement-primitives 0.9.1, DMP(2, 6.0, dt=0.02, n_weights_per_dim=40, smooth_scaling=True) on the same, every second
LIBRARY = {
    (1.1, 0.2): [
        (0.2, 0.3),
        (0.2337, 0.3018),
        (0.3934, 0.4347),
        (0.6556, 0.6492),
        (0.9155, 0.3647),
        (1.0698, 0.2078),
        (1.1, 0.2),
    ],
    (1.6, 0.4): [
        (0.2, 0.3),
        (0.3247, 0.3382),
        (0.6569, 0.5401),
        (1.037, 0.8017),
        (1.359, 0.5421),
        (1.5433, 0.3972),
        (1.5877, 0.3951),
    ],
    (-0.7, -0.1): [
        (0.2, 0.3),
        (-0.094, 0.2472),
        (-0.5553, 0.2766),
        (-0.7173, 0.4204),
        (-0.6809, 0.0986),
        (-0.6349, -0.0763),
        (-0.6556, -0.0926),
    ],
}
places = st.floats(-2.0, 2.0)


@pytest.mark.parametrize("dmp", [SCALED, PLAIN])
def test_it_reproduces_the_demonstration(dmp: Dmp) -> None:
    again = dmp.rollout(SHOWN[0], SHOWN[-1])
    assert again.duration_s == pytest.approx(6.0)
    assert np.max(np.abs(again.at(TIME_S) - SHOWN) / np.ptp(SHOWN, axis=0)) < 0.02


@settings(deadline=None, max_examples=20)
@given(places, places, places, places)
def test_it_reaches_any_goal_and_is_at_rest_there(a: float, b: float, c: float, d: float) -> None:
    for dmp in (SCALED, PLAIN):
        motion = dmp.rollout(np.array([a, b]), np.array([c, d]))
        assert motion.position[0] == pytest.approx([a, b])
        assert motion.position[-1] == pytest.approx([c, d], abs=1e-9)
        size = np.abs([c - a, d - b]) + np.ptp(SHOWN, axis=0)
        assert np.all(np.abs(motion.position - [a, b]).max(axis=0) < 1.5 * size)
        last = np.abs(np.diff(motion.position[-3:], axis=0))[-1] * 400
        assert np.all(last < 0.05 * size)


def test_the_other_side_is_the_mirror_image_and_the_height_stays_a_lift() -> None:
    start = np.array([0.0, 0.5])
    left = SCALED.rollout(start, np.array([0.8, 0.2])).position
    right = SCALED.rollout(start, np.array([-0.8, 0.2])).position
    assert right[:, 0] == pytest.approx(-left[:, 0], abs=1e-9)
    assert right[:, 1] == pytest.approx(left[:, 1], abs=1e-9)
    assert left[:, 1].max() > 0.65


@pytest.mark.parametrize("end", [0.1, 0.299999, 0.3, 0.300001, 0.5])
def test_a_lift_that_ends_where_it_began_neither_diverges_nor_turns_into_a_dip(end: float) -> None:
    height = PLAIN.rollout(np.array([0.0, 0.3]), np.array([1.0, end])).position[:, 1]
    assert 0.55 < height.max() < 1.0
    assert height.min() > min(0.3, end) - 0.05


def test_the_classic_factor_would_have_made_it_a_dip() -> None:
    """The trap itself: a lift learned in shares of its travel flips with the sign of the travel."""
    classic = learn([(TIME_S, SHOWN)], (True, True), least_way=0.05)
    assert classic.rollout(np.array([0.0, 0.3]), np.array([1.0, 0.4])).position[:, 1].min() < 0.05


@pytest.mark.parametrize("goal", LIBRARY)
def test_it_agrees_with_the_library(goal: tuple[float, float]) -> None:
    """Within 3 % of the range: the library fits its weights all at once, and does not land at the goal."""
    ours = PLAIN.rollout(SHOWN[0], np.array(goal)).at(np.arange(7.0))
    size = np.abs(np.array(goal) - SHOWN[0]) + np.ptp(SHOWN, axis=0)
    assert np.max(np.abs(ours - np.array(LIBRARY[goal])) / size) < 0.03


def test_it_agrees_with_the_library_as_installed() -> None:
    library = pytest.importorskip("movement_primitives.dmp", reason="movement-primitives is not installed")
    goal = np.array([1.4, 0.5])
    other = library.DMP(n_dims=2, execution_time=6.0, dt=0.02, n_weights_per_dim=40, smooth_scaling=True)
    other.imitate(TIME_S, SHOWN)
    other.configure(start_y=SHOWN[0], goal_y=goal)
    time_s, theirs = other.open_loop(run_t=6.0)
    size = np.abs(goal - SHOWN[0]) + np.ptp(SHOWN, axis=0)
    assert np.max(np.abs(PLAIN.rollout(SHOWN[0], goal).at(time_s) - theirs) / size) < 0.03


def test_a_motion_is_the_same_at_any_sampling_and_duration() -> None:
    motion = SCALED.rollout(SHOWN[0], SHOWN[-1])
    coarse, fine = motion.at(np.arange(0.0, 6.0, 0.5)), motion.at(np.arange(0.0, 6.0, 0.005))
    assert coarse == pytest.approx(fine[::100])
    assert motion.at(np.array([8.0]), 16.0) == pytest.approx(motion.at(np.array([3.0])))
    assert motion.at(np.array([-1.0, 99.0])) == pytest.approx(SHOWN[[0, -1]], abs=1e-9)


def test_demonstrations_count_alike_and_the_duration_is_their_mean() -> None:
    long = np.linspace(0.0, 10.0, 1001)
    stretched = np.column_stack([np.interp(long * 0.6, TIME_S, column) for column in SHOWN.T])
    both = learn([(TIME_S, SHOWN), (long, stretched)], (True, False))
    assert both.duration_s == pytest.approx(8.0)
    position = both.rollout(SHOWN[0], SHOWN[-1]).position
    assert np.max(np.abs(position - SCALED.rollout(SHOWN[0], SHOWN[-1]).position)) < 0.01


def test_demonstrations_that_teach_nothing_are_refused() -> None:
    flat = SHOWN.copy()
    flat[:, 0] = 0.2
    cases = {
        "demonstration.none": [],
        "demonstration.too-few-samples": [(TIME_S[:5], SHOWN[:5])],
        "demonstration.not-finite": [(TIME_S, np.where(TAU[:, None] > 0.5, np.nan, SHOWN))],
        "demonstration.times-not-increasing": [(TIME_S[::-1], SHOWN)],
        "demonstration.coordinate-unmoved": [(TIME_S, flat)],
    }
    for code, shown in cases.items():
        with pytest.raises(InputRefused, check=coded(code)):
            learn(shown, (True, False))
    with pytest.raises(InputRefused, check=coded("primitive.not-finite")):
        SCALED.rollout(np.array([0.0, np.nan]), np.array([1.0, 1.0]))
