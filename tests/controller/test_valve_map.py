"""Joint velocity to spool command: compensation of dead-band, metering curve, hysteresis and lever."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.laws.valve_map import LINEAR_SHARE, ValveMap
from tests.controller.bench import SPECS

PLAY, LIFT = SPECS[0].valve, SPECS[1].valve
SLEW = msgspec.structs.replace(PLAY, hysteresis_pct=0.0)
CURVED = msgspec.structs.replace(SLEW, exponent=1.3, deadband_plus_pct=9.0, deadband_minus_pct=14.0)


def metered(valve, u):
    """Share of the full speed of a valve of docs/reference/machines.md section 3 for a command."""
    deadband = (valve.deadband_plus_pct if u > 0 else valve.deadband_minus_pct) / 100.0
    half = valve.hysteresis_pct / 200.0
    return math.copysign((max(0.0, abs(u) - deadband) / (1.0 - half - deadband)) ** valve.exponent, u)


class Hysteresis:
    """The spool behind its command."""

    def __init__(self, valve, at=0.0):
        self.half, self.at = valve.hysteresis_pct / 200.0, at

    def step(self, u):
        self.at = max(u - self.half, min(u + self.half, self.at))
        return self.at


@pytest.mark.parametrize("valve", [SLEW, CURVED])
@given(velocity=st.floats(-0.5, 0.5))
def test_map_is_the_inverse_of_the_valve(valve, velocity):
    u = ValveMap(valve).spool_pct(velocity) / 100.0
    if abs(velocity) > LINEAR_SHARE * 0.5:
        assert metered(valve, u) * 0.5 == pytest.approx(velocity, abs=1e-9)
    else:
        edge = ValveMap(valve).spool_pct(math.copysign(1.001 * LINEAR_SHARE * 0.5, velocity)) / 100.0
        assert abs(u) <= abs(edge)


@given(
    st.lists(st.floats(0.02, 0.45).flatmap(lambda v: st.sampled_from([v, -v])), min_size=2, max_size=8),
    st.floats(-0.01, 0.01),
)
def test_hysteresis_is_compensated_after_every_reversal(goals, at):
    """In sweeps between goals the spool is correct once a sweep is long enough to reverse the lead."""
    made, play, velocity = ValveMap(PLAY), Hysteresis(PLAY, at), 0.0
    for goal in goals:
        last = metered(PLAY, play.at)
        for k in range(1, 51):
            now = velocity + (goal - velocity) * k / 50.0
            spool = play.step(made.spool_pct(now) / 100.0)
        velocity = goal
        assert abs(made.spool_pct(goal)) <= 100.0
        if abs(goal - 0.5 * last) > 0.5 * 0.03:
            assert metered(PLAY, spool) * 0.5 == pytest.approx(goal, abs=1e-9)


def test_without_compensation_hysteresis_costs_speed():
    plain, play = ValveMap(SLEW), Hysteresis(PLAY)
    rising = [metered(PLAY, play.step(plain.spool_pct(0.005 * k) / 100.0)) for k in range(81)][40]
    falling = [metered(PLAY, play.step(plain.spool_pct(0.4 - 0.005 * k) / 100.0)) for k in range(81)][40]
    assert 0.5 * (falling - rising) == pytest.approx(0.5 * 0.02 / 0.87, rel=0.02)


def test_flicker_does_not_reverse_the_lead_and_zero_is_zero():
    made = ValveMap(PLAY)
    for k in range(50):
        made.spool_pct(0.005 * k)
    still = made.spool_pct(0.25)
    assert still - 1.0 < made.spool_pct(0.25 - 0.0002) < still
    assert made.spool_pct(0.0) == 0.0 == made.spool_pct(-0.0)


@pytest.mark.parametrize("valve", [LIFT, CURVED, PLAY])
def test_map_is_monotonic_and_saturates(valve):
    made = ValveMap(valve)
    values = [made.spool_pct(v / 1000) for v in range(-600, 601)]
    assert values == sorted(values) and values[0] == -100.0 and values[-1] == 100.0
    assert made.spool_pct(0.0) == 0.0


def test_two_sides_differ():
    made = ValveMap(LIFT)
    assert made.spool_pct(0.12) > -made.spool_pct(-0.12)


def test_short_lever_makes_the_joint_faster():
    made = ValveMap(LIFT)
    made.set_position(LIFT.lever_at[-1] + 1.0)
    assert made.arm == LIFT.lever[-1]
    assert made.full_plus == pytest.approx(LIFT.full_speed_plus / LIFT.lever[-1])
    short = made.spool_pct(0.1)
    made.set_position(0.5 * (LIFT.lever_at[2] + LIFT.lever_at[3]))
    assert made.arm == pytest.approx(0.5 * (LIFT.lever[2] + LIFT.lever[3]))
    assert made.spool_pct(0.1) > short
    made.set_position(math.nan)
    assert made.arm == pytest.approx(0.5 * (LIFT.lever[2] + LIFT.lever[3]))
    made.set_position(-9.0)
    assert made.arm == LIFT.lever[0]


def test_joint_without_a_lever_is_the_same_everywhere():
    made = ValveMap(SLEW)
    made.set_position(1.0)
    assert (made.arm, made.full_plus) == (1.0, SLEW.full_speed_plus)
