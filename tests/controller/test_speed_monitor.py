"""A joint against the speed of its valve: what a badly known map may do, and which fault each deviation is."""

import math
from collections import deque

import pytest

from controller.estimation.speed_monitor import (
    BACKWARDS_S,
    DEADBAND_PCT,
    FAST_PRESSED_S,
    FAST_S,
    HELD_PRESSED_S,
    LEARNED_S,
    SLOW_S,
    STOOD_S,
    WINDOW_S,
    SpeedMonitor,
)
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from tests.controller.bench import SPECS

T_S = 0.005
SPEC = SPECS[0]
LIMIT = SPEC.speed_limit


def monitor() -> SpeedMonitor:
    return SpeedMonitor(SPEC.valve, LIMIT, T_S, WINDOW_S)


def swing(k: int) -> float:
    """Half of the speed limit, to and fro in 4 s."""
    return 0.5 * LIMIT * math.sin(0.5 * math.pi * k * T_S)


def first(watched: SpeedMonitor, expected: float, velocity: float, limit: int = 400) -> tuple[Reason, float]:
    for k in range(1, limit):
        reason = watched.step(expected, velocity)
        if reason is not Reason.NONE:
            return reason, k * T_S
    return Reason.NONE, math.inf


def knowing(expected: float) -> SpeedMonitor:
    """One that has seen the joint follow this speed exactly for long enough."""
    watched = monitor()
    for _ in range(round((LEARNED_S + 2 * WINDOW_S) / T_S)):
        assert watched.step(expected, expected) is Reason.NONE
    return watched


@pytest.mark.parametrize("lag_s", [0.0, 0.1, 0.19])
@pytest.mark.parametrize("gain", [0.75, 1.0, 1.25])
def test_a_joint_that_follows_late_by_a_map_that_is_wrong_by_a_quarter_is_no_fault(lag_s, gain):
    watched, line = monitor(), deque([0.0] * (round(lag_s / T_S) + 1))
    for k in range(4000):
        line.append(gain * swing(k))
        assert watched.step(swing(k), line.popleft()) is Reason.NONE, k


@pytest.mark.parametrize("deadband_pct", [-6.0, 6.0])
def test_a_dead_band_that_is_half_again_as_wide_or_half_as_wide_is_no_fault(deadband_pct):
    watched = monitor()
    shift = deadband_pct / 100.0 * SPEC.valve.full_speed_plus
    for k in range(4000):
        expected = swing(k)
        moves = abs(expected) > max(0.0, shift)
        real = math.copysign(max(0.0, abs(expected) - shift), expected) if moves and expected else 0.0
        assert watched.step(expected, real) is Reason.NONE, k


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("factor", "reason", "within_s"),
    [
        (2.0, Reason.JOINT_RUNAWAY, FAST_S),
        (0.5, Reason.SPEED_WRONG, SLOW_S),
        (-1.0, Reason.SPEED_WRONG, BACKWARDS_S),
        (0.0, Reason.JOINT_STUCK, STOOD_S),
        (1.2, Reason.NONE, math.inf),
        (0.8, Reason.NONE, math.inf),
    ],
)
def test_an_encoder_that_goes_wrong_in_motion_has_its_reason_and_its_time(side, factor, reason, within_s):
    speed = side * 0.4 * LIMIT
    found, after_s = first(knowing(speed), speed, factor * speed)
    assert found is reason and after_s <= within_s + T_S
    assert reason is Reason.NONE or after_s * 1e3 <= FAULTS[reason].bound_ms


@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0, -1.0])
def test_it_is_blind_below_a_tenth_of_the_speed_limit(factor):
    speed = 0.08 * LIMIT
    assert first(knowing(speed), speed, factor * speed)[0] is Reason.NONE


def test_a_first_motion_is_judged_with_the_doubt_about_the_dead_band():
    doubted = 0.9 * DEADBAND_PCT / 100.0 * SPEC.valve.full_speed_plus
    assert first(monitor(), doubted, 0.0)[0] is Reason.NONE
    assert first(monitor(), LIMIT, 0.0)[0] is Reason.JOINT_STUCK


def test_a_shut_valve_allows_small_motion_and_no_fast_one():
    assert first(monitor(), 0.0, 0.15 * LIMIT)[0] is Reason.NONE
    assert first(monitor(), 0.0, 0.6 * LIMIT)[0] is Reason.JOINT_RUNAWAY


def test_a_joint_that_jaws_throw_is_no_runaway_and_one_that_goes_on_is():
    watched = monitor()
    ticks = round(FAST_PRESSED_S / T_S)
    assert {watched.step(0.0, 0.6 * LIMIT, pressed=True) for _ in range(ticks - 1)} == {Reason.NONE}
    assert Reason.JOINT_RUNAWAY in {watched.step(0.0, 0.6 * LIMIT, pressed=True) for _ in range(3)}


def test_a_joint_that_moves_against_the_pressure_of_its_oil_is_no_runaway():
    watched = monitor()
    assert {watched.step(0.0, 0.6 * LIMIT, pushed=True) for _ in range(400)} == {Reason.NONE}
    assert Reason.JOINT_RUNAWAY in {watched.step(0.0, 0.6 * LIMIT) for _ in range(100)}


@pytest.mark.parametrize("share", [-0.5, 0.0, 0.5], ids=["pushed back", "held", "slowed"])
def test_a_joint_that_a_pile_holds_is_no_fault_and_one_that_it_holds_for_long_is(share):
    watched, speed = knowing(0.6 * LIMIT), 0.6 * LIMIT
    ticks = round(HELD_PRESSED_S / T_S)
    assert {watched.step(speed, share * speed, pressed=True) for _ in range(ticks - 2)} == {Reason.NONE}
    for _ in range(60):
        reason = watched.step(speed, share * speed, pressed=True)
    assert reason is not Reason.NONE
    assert first(knowing(speed), speed, share * speed)[0] is not Reason.NONE, "at once, where nothing presses"


def test_a_reset_forgets_the_motion_and_keeps_what_was_learned():
    speed = 0.4 * LIMIT
    watched = knowing(speed)
    watched.step(speed, 0.0)
    watched.reset()
    for _ in range(round(0.8 * WINDOW_S / T_S)):
        assert watched.step(speed, 0.0) is Reason.NONE, "the joint has to begin to move first"
    assert first(watched, speed, 0.0)[0] is Reason.JOINT_STUCK


def test_a_slow_joint_that_sticks_and_slips_is_no_fault():
    """Seen on a machine with a dead-band of its own: pushed, it runs, and nearly stands while the map says 0.04."""
    watched = monitor()
    for k in range(4000):
        expected = LIMIT * (0.19 + 0.07 * math.copysign(1.0, math.sin(2.0 * math.pi * k * T_S / 0.5)))
        real = LIMIT * (0.15 + 0.115 * math.sin(2.0 * math.pi * (k * T_S - 0.19) / 0.5))
        assert watched.step(expected, real) is Reason.NONE, k
