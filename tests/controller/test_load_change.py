"""When a load comes or goes, and what the watch of the joints makes of it."""

import math

import pytest

from controller.crane.motion import LOAD_PERIOD_NS
from controller.estimation.load_change import CHANGE_KG, MEAN_S, REST_NS, LoadChange

T_S = LOAD_PERIOD_NS * 1e-9


class Scale:
    """A load that is estimated again and again."""

    def __init__(self) -> None:
        self.change = LoadChange(T_S)
        self.now_ns = 0

    def weighs(self, seconds, load_kg):
        """Whether the load changed while it was ``load_kg(t)``, the time from the start of this."""
        seen = False
        for k in range(round(seconds / T_S)):
            self.now_ns += LOAD_PERIOD_NS
            self.change.step(load_kg(k * T_S), self.now_ns)
            seen |= self.change.recent(self.now_ns)
        return seen


def settled(load_kg):
    scale = Scale()
    scale.weighs(8.0 * MEAN_S + REST_NS * 1e-9, lambda t: load_kg)
    assert not scale.change.recent(scale.now_ns)
    return scale


def test_a_load_that_hangs_is_none_and_one_that_swings_is_none():
    assert not settled(0.0).weighs(5.0, lambda t: 0.9 * CHANGE_KG)
    assert not settled(93.0).weighs(5.0, lambda t: 93.0 + 20.0 * math.sin(6.0 * t))
    assert not settled(600.0).weighs(5.0, lambda t: 600.0 + 90.0 * math.sin(6.0 * t))


@pytest.mark.parametrize(
    ("before_kg", "after_kg"),
    [
        pytest.param(0.0, lambda t: 60.0, id="a log is lifted"),
        pytest.param(93.0, lambda t: 0.0, id="a log touches the ground"),
        pytest.param(93.0, lambda t: 93.0 + 1500.0 * t, id="a log is caught"),
        pytest.param(780.0, lambda t: 780.0 - 210.0 * t, id="logs come to rest"),
    ],
)
def test_a_load_that_comes_or_goes_is_a_change_until_the_boom_has_come_to_rest(before_kg, after_kg):
    scale = settled(before_kg)
    assert scale.weighs(1.5, after_kg)
    rests_kg = max(0.0, after_kg(1.5))
    assert scale.weighs(REST_NS * 1e-9, lambda t: rests_kg)
    scale.weighs(8.0 * MEAN_S, lambda t: rests_kg)
    assert not scale.change.recent(scale.now_ns)


def test_a_load_that_nobody_knows_is_no_change():
    scale = settled(500.0)
    assert not scale.weighs(2.0, lambda t: math.nan)
