"""A spool against its command: what is allowed on the way, and which fault each deviation is."""

import math

import pytest

from controller.estimation.recent_range import RecentRange
from controller.estimation.spool_monitor import OPEN_S, SHUT_S, WINDOW_S, WRONG_S, SpoolMonitor
from machine.status.faults import FAULTS
from machine.status.reasons import Reason

T_S = 0.005
DEADBAND_PCT = 12.0


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


def first(monitor: SpoolMonitor, command: float, place: float, limit: int = 400) -> tuple[Reason, float]:
    for k in range(1, limit):
        reason = monitor.step(command, place)
        if reason is not Reason.NONE:
            return reason, k * T_S
    return Reason.NONE, math.inf


def steady(command: float) -> SpoolMonitor:
    monitor = SpoolMonitor(DEADBAND_PCT, T_S)
    for _ in range(round(2 * WINDOW_S / T_S)):
        monitor.follow(command)
    return monitor


@pytest.mark.parametrize("delay_s", [0.0, 0.04, 0.075, 0.15])
def test_a_spool_that_follows_late_is_no_fault(delay_s):
    monitor, spool = SpoolMonitor(DEADBAND_PCT, T_S), Spool(delay_s)
    for k in range(4000):
        assert monitor.step(work(k), spool.move(work(k))) is Reason.NONE, k


@pytest.mark.parametrize("delay_s", [0.2, 0.25])
def test_a_longer_dead_time_is_no_fault_once_the_profile_knows_it(delay_s):
    knows, does_not, spool = SpoolMonitor(DEADBAND_PCT, T_S, delay_s), SpoolMonitor(DEADBAND_PCT, T_S), Spool(delay_s)
    blamed = set()
    for k in range(4000):
        place = spool.move(work(k))
        assert knows.step(work(k), place) is Reason.NONE, k
        blamed.add(does_not.step(work(k), place))
    assert Reason.SPOOL_OPEN in blamed


def test_in_a_spool_test_any_valves_dead_time_is_waited_for():
    monitor, spool = SpoolMonitor(DEADBAND_PCT, T_S), Spool(0.25)
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
    found, after_s = first(steady(command), command, place)
    assert found is reason and after_s <= within_s + T_S


def test_a_deviation_that_ends_in_time_is_forgotten():
    monitor = steady(0.0)
    for _ in range(50):
        assert monitor.step(0.0, 45.0) is Reason.NONE
        assert monitor.step(0.0, 0.0) is Reason.NONE


def test_a_spool_that_closes_after_the_end_of_a_motion_is_allowed_until_the_window_is_over():
    monitor = steady(40.0)
    for _ in range(round(0.5 * WINDOW_S / T_S)):
        monitor.follow(0.0)
    assert monitor.step(0.0, 38.0) is Reason.NONE and monitor.step(0.0, 38.0) is Reason.NONE
    found, after_s = first(monitor, 0.0, 38.0)
    assert found is Reason.SPOOL_OPEN and after_s <= 0.5 * WINDOW_S + OPEN_S + T_S


@pytest.mark.parametrize("reason", [Reason.SPOOL_OPEN, Reason.SPOOL_SHUT, Reason.SPOOL_WRONG])
def test_the_promised_time_holds_the_window_and_the_confirmation(reason):
    confirmed = {Reason.SPOOL_OPEN: 0.1 + OPEN_S, Reason.SPOOL_SHUT: WINDOW_S + SHUT_S}.get(reason, WINDOW_S + WRONG_S)
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
