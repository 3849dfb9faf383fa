"""How far a slope may turn a shut slew: nothing on level ground, and never far enough to hide a runaway."""

import math

import pytest

from controller.estimation.slope_yield import LIMIT_RAD, SlopeYield
from controller.estimation.standstill_monitor import StandstillMonitor
from tests.controller.bench import SPECS, T

PERIOD_S = T * 1e-9
SLEW = SPECS[0]
LEVEL, SLOPE = (0.005, -0.01), (0.0, 0.12)


def after(seconds, pressed=False, tilt=LEVEL, one=None):
    one = one or SlopeYield(PERIOD_S)
    for _ in range(max(1, round(seconds / PERIOD_S))):
        one.step(pressed, *tilt)
    return one


def test_on_level_ground_nothing_changes():
    one = after(1.0)
    for pressed in (True, False):
        assert after(0.5, pressed, one=one).rad == 0.0


def test_on_a_slope_the_slew_yields_while_jaws_or_a_load_press():
    one = after(20.0, tilt=SLOPE)
    assert one.rad == 0.0, "nothing turns it"
    assert after(0.0, pressed=True, tilt=SLOPE, one=one).rad == pytest.approx(0.4 * 0.10)
    assert after(0.0, tilt=SLOPE, one=one).rad == 0.0


def test_it_yields_when_a_wheel_climbs_a_stump_and_rests_soon_after():
    one = after(20.0)
    after(0.3, tilt=(0.095, -0.01), one=one)
    assert 0.02 < one.rad < 0.04
    assert after(8.0, tilt=(0.095, -0.01), one=one).rad == 0.0


def test_it_never_yields_far_and_an_unknown_inclination_is_level():
    one = after(0.1, True, tilt=(1.0, -1.0))
    assert one.rad == LIMIT_RAD
    assert after(0.1, True, tilt=(math.nan, math.nan)).rad == 0.0


@pytest.mark.parametrize(("slack", "bound_s"), [(0.0, 0.2), (LIMIT_RAD, 0.35)])
def test_a_valve_stuck_open_is_seen_with_all_the_slack(slack, bound_s):
    monitor, position = StandstillMonitor(SLEW, PERIOD_S), 0.0
    for _ in range(600):
        monitor.step(True, True, position, slack)
    seen_s = 0.0
    while not monitor.step(True, True, position, slack) and seen_s < 2.0:
        position += SLEW.speed_limit * PERIOD_S
        seen_s += PERIOD_S
    assert monitor.moves and seen_s < bound_s


def test_a_slew_that_yields_on_a_slope_does_not_run_away():
    for slack, moves in ((0.03, False), (0.0, True)):
        monitor = StandstillMonitor(SLEW, PERIOD_S)
        for _ in range(600):
            monitor.step(True, True, 0.0, slack)
        seen = any(monitor.step(True, True, 0.02 * min(1.0, k * PERIOD_S), slack) for k in range(400))
        assert seen is moves
