"""The monitors of a valve alone: what a badly known valve may do, and which fault each deviation is."""

from __future__ import annotations

import math
from collections import deque

import pytest

from controller.estimation.valve_monitors import (
    AGAINST_S_AT_LIMIT,
    ANSWER_S,
    BACKWARDS_S,
    DEADBAND_PCT,
    FAST_PRESSED_S,
    FAST_S,
    HELD_PRESSED_S,
    LEARNED_S,
    LEAST_AGAINST,
    OPEN_S,
    SHUT_S,
    SLOW_S,
    SPEED_WINDOW_S,
    SPOOL_WINDOW_S,
    STOOD_S,
    WRONG_S,
    DirectionMonitor,
    RecentRange,
    SpeedMonitor,
    SpoolMonitor,
)
from machine.loading.profile_file import load_profile
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from tests.controller.bench import SPECS

T_S = 0.005


def first_fault(
    monitor: SpoolMonitor | SpeedMonitor, expected: float, measured: float, limit: int = 400
) -> tuple[Reason, float]:
    """The first fault of a valve or a joint that stays so, and after how long."""
    for k in range(1, limit):
        reason = monitor.step(expected, measured)
        if reason is not Reason.NONE:
            return reason, k * T_S
    return Reason.NONE, math.inf


# -- Spool monitor: what is allowed on the way to a command

SPOOL_DEADBAND_PCT = 12.0


class Spool:
    """Dead time and a spool of second order (40 rad/s, damping 0.8)."""

    def __init__(self, delay_s: float) -> None:
        self.line = [0.0] * (round(delay_s / T_S) + 1)
        self.place = self.speed = 0.0

    def move(self, command: float) -> float:
        self.line = [*self.line[1:], command]
        for _ in range(5):
            self.speed += T_S / 5 * (1600.0 * (self.line[0] - self.place) - 64.0 * self.speed)
            self.place += T_S / 5 * self.speed
        return self.place


def work(k: int) -> float:
    """A lively command [%]: swings, pulses and jumps over the dead-band."""
    t = k * T_S
    return 40.0 * math.sin(2.1 * t) + (25.0 if t % 1.0 < 0.3 else -15.0 if t % 1.7 < 0.2 else 0.0)


def steady(command: float) -> SpoolMonitor:
    monitor = SpoolMonitor(SPOOL_DEADBAND_PCT, T_S)
    for _ in range(round(2 * SPOOL_WINDOW_S / T_S)):
        monitor.follow(command)
    return monitor


@pytest.mark.parametrize("delay_s", [0.0, 0.04, 0.075, 0.15])
def test_a_spool_that_follows_late_is_no_fault(delay_s):
    monitor, spool = SpoolMonitor(SPOOL_DEADBAND_PCT, T_S), Spool(delay_s)
    for k in range(4000):
        assert monitor.step(work(k), spool.move(work(k))) is Reason.NONE, k


@pytest.mark.parametrize("delay_s", [0.2, 0.25])
def test_a_longer_dead_time_is_no_fault_once_the_profile_knows_it(delay_s):
    knows, does_not, spool = (
        SpoolMonitor(SPOOL_DEADBAND_PCT, T_S, delay_s),
        SpoolMonitor(SPOOL_DEADBAND_PCT, T_S),
        Spool(delay_s),
    )
    blamed = set()
    for k in range(4000):
        place = spool.move(work(k))
        assert knows.step(work(k), place) is Reason.NONE, k
        blamed.add(does_not.step(work(k), place))
    assert Reason.SPOOL_OPEN in blamed


def test_in_a_spool_test_any_valves_dead_time_is_waited_for():
    monitor, spool = SpoolMonitor(SPOOL_DEADBAND_PCT, T_S), Spool(0.25)
    for k in range(4000):
        assert monitor.step(work(k), spool.move(work(k)), tested=True) is Reason.NONE, k
    for _ in range(200):
        monitor.step(0.0, 0.0, tested=True)
    reasons = [monitor.step(0.0, 40.0, tested=True) for _ in range(4)]
    assert Reason.SPOOL_OPEN in reasons, "a spool that is open without any command is one all the same"


@pytest.mark.parametrize(
    ("command", "place", "reason", "within_s"),
    [
        (0.0, 45.0, Reason.SPOOL_OPEN, OPEN_S),
        (0.0, -45.0, Reason.SPOOL_OPEN, OPEN_S),
        (30.0, -20.0, Reason.SPOOL_OPEN, OPEN_S),
        (-30.0, 20.0, Reason.SPOOL_OPEN, OPEN_S),
        (30.0, 45.0, Reason.SPOOL_OPEN, OPEN_S),
        (30.0, 0.0, Reason.SPOOL_SHUT, SHUT_S),
        (-30.0, 0.0, Reason.SPOOL_SHUT, SHUT_S),
        (-30.0, 5.0, Reason.SPOOL_SHUT, SHUT_S),
        (30.0, 15.0, Reason.SPOOL_WRONG, WRONG_S),
        (-30.0, -15.0, Reason.SPOOL_WRONG, WRONG_S),
        (0.0, 8.0, Reason.SPOOL_WRONG, WRONG_S),  # inside the dead-band: no oil
        (30.0, 25.0, Reason.NONE, math.inf),
        (30.0, 33.0, Reason.NONE, math.inf),
        (0.0, 2.5, Reason.NONE, math.inf),
    ],
)
def test_each_deviation_has_its_reason_and_its_time(command, place, reason, within_s):
    found, after_s = first_fault(steady(command), command, place)
    assert found is reason and after_s <= within_s + T_S


def test_a_deviation_that_ends_in_time_is_forgotten():
    monitor = steady(0.0)
    for _ in range(50):
        assert monitor.step(0.0, 45.0) is Reason.NONE
        assert monitor.step(0.0, 0.0) is Reason.NONE


def test_a_spool_that_closes_after_the_end_of_a_motion_is_allowed_until_the_window_is_over():
    monitor = steady(40.0)
    for _ in range(round(0.5 * SPOOL_WINDOW_S / T_S)):
        monitor.follow(0.0)
    assert monitor.step(0.0, 38.0) is Reason.NONE and monitor.step(0.0, 38.0) is Reason.NONE
    found, after_s = first_fault(monitor, 0.0, 38.0)
    assert found is Reason.SPOOL_OPEN and after_s <= 0.5 * SPOOL_WINDOW_S + OPEN_S + T_S


@pytest.mark.parametrize("reason", [Reason.SPOOL_OPEN, Reason.SPOOL_SHUT, Reason.SPOOL_WRONG])
def test_the_promised_time_holds_the_window_and_the_confirmation(reason):
    confirmed = {
        Reason.SPOOL_OPEN: 0.1 + OPEN_S,
        Reason.SPOOL_SHUT: SPOOL_WINDOW_S + SHUT_S,
        Reason.SPOOL_WRONG: SPOOL_WINDOW_S + WRONG_S,
    }[reason]
    assert confirmed * 1e3 <= FAULTS[reason].bound_ms, "dead time and spool of 0.1 s, or the window"


def test_the_recent_range_covers_most_of_its_window_and_no_more():
    seen = RecentRange(0.4, T_S)
    for value in [*range(100), *[50.0] * 59]:
        seen.add(float(value))
    assert seen.high == 99.0 and seen.low == 50.0, "0.3 s are always covered"
    for _ in range(22):
        seen.add(50.0)
    assert (seen.low, seen.high) == (50.0, 50.0)
    seen.add(-3.0)
    assert seen.low == -3.0
    seen.reset(7.0)
    assert (seen.low, seen.high) == (7.0, 7.0)


# -- Speed monitor: a joint against the speed of its valve

SPEC = SPECS[0]
LIMIT = SPEC.speed_limit


def monitor() -> SpeedMonitor:
    return SpeedMonitor(SPEC.valve, LIMIT, T_S, SPEED_WINDOW_S)


def swing(k: int) -> float:
    """Half of the speed limit, to and fro in 4 s."""
    return 0.5 * LIMIT * math.sin(0.5 * math.pi * k * T_S)


def knowing(expected: float) -> SpeedMonitor:
    """One that has seen the joint follow this speed exactly for long enough."""
    watched = monitor()
    for _ in range(round((LEARNED_S + 2 * SPEED_WINDOW_S) / T_S)):
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
    found, after_s = first_fault(knowing(speed), speed, factor * speed)
    assert found is reason and after_s <= within_s + T_S
    assert reason is Reason.NONE or after_s * 1e3 <= FAULTS[reason].bound_ms


@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0, -1.0])
def test_it_is_blind_below_a_tenth_of_the_speed_limit(factor):
    speed = 0.08 * LIMIT
    assert first_fault(knowing(speed), speed, factor * speed)[0] is Reason.NONE


def test_a_first_motion_is_judged_with_the_doubt_about_the_dead_band():
    doubted = 0.9 * DEADBAND_PCT / 100.0 * SPEC.valve.full_speed_plus
    assert first_fault(monitor(), doubted, 0.0)[0] is Reason.NONE
    assert first_fault(monitor(), LIMIT, 0.0)[0] is Reason.JOINT_STUCK


def test_a_shut_valve_allows_small_motion_and_no_fast_one():
    assert first_fault(monitor(), 0.0, 0.15 * LIMIT)[0] is Reason.NONE
    assert first_fault(monitor(), 0.0, 0.6 * LIMIT)[0] is Reason.JOINT_RUNAWAY


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
    assert first_fault(knowing(speed), speed, share * speed)[0] is not Reason.NONE, "at once, where nothing presses"


def test_a_reset_forgets_the_motion_and_keeps_what_was_learned():
    speed = 0.4 * LIMIT
    watched = knowing(speed)
    watched.step(speed, 0.0)
    watched.reset()
    for _ in range(round(0.8 * SPEED_WINDOW_S / T_S)):
        assert watched.step(speed, 0.0) is Reason.NONE, "the joint has to begin to move first"
    assert first_fault(watched, speed, 0.0)[0] is Reason.JOINT_STUCK


def test_a_slow_joint_that_sticks_and_slips_is_no_fault():
    """Seen on a machine with a dead-band of its own: pushed, it runs, and nearly stands while the map says 0.04."""
    watched = monitor()
    for k in range(4000):
        expected = LIMIT * (0.19 + 0.07 * math.copysign(1.0, math.sin(2.0 * math.pi * k * T_S / 0.5)))
        real = LIMIT * (0.15 + 0.115 * math.sin(2.0 * math.pi * (k * T_S - 0.19) / 0.5))
        assert watched.step(expected, real) is Reason.NONE, k


# -- Direction monitor: in a spool test standing and any speed are allowed, going the other way is not

PALMS = load_profile("palms_471").joints


def travel_until_told(name: str, percent: float, velocity: float, seconds: float = 3.0) -> float | None:
    """How far a joint goes at ``velocity`` under a command before the monitor tells; None: it does not."""
    monitor, way = DirectionMonitor(PALMS[name], T_S), 0.0
    for _ in range(round(seconds / T_S)):
        way += abs(velocity) * T_S
        if monitor.step(percent, velocity):
            return way
    return None


@pytest.mark.parametrize("name", PALMS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_stands_or_follows_at_any_speed_is_none(name, side):
    for velocity in (0.0, 0.1, 1.2):
        assert travel_until_told(name, side * 25.0, side * velocity) is None


@pytest.mark.parametrize("name", PALMS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_goes_against_its_command_is_told_within_centimetres(name, side):
    limit = max(AGAINST_S_AT_LIMIT * PALMS[name].speed_limit, LEAST_AGAINST)
    speed = 0.5 * PALMS[name].speed_limit
    way = travel_until_told(name, side * 25.0, -side * speed)
    assert way is not None and way <= speed * ANSWER_S + 1.5 * limit


def test_a_valve_that_answers_late_has_not_gone_the_wrong_way():
    monitor = DirectionMonitor(PALMS["slew"], T_S)
    for k in range(400):
        command, velocity = (20.0, 0.2) if k < 200 else (-20.0, 0.2 if k < 200 + 0.32 / T_S else -0.2)
        assert not monitor.step(command, velocity), k
