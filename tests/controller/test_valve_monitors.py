"""The monitors of a valve: what a badly known valve may do, which fault each deviation is, and in the controller."""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

import msgspec
import pytest

from can_dbc.messages.crane import GrappleCommand
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
    SPOOL_S,
    SPOOL_WINDOW_S,
    STOOD_S,
    WRONG_S,
    DirectionMonitor,
    RecentRange,
    SpeedMonitor,
    SpoolMonitor,
)
from controller.valve_watch import allowed_delay_s
from machine.loading.profile_file import load_profile
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, SPECS, Bench, T, behind_plc, count_until

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
    knows, does_not = SpoolMonitor(SPOOL_DEADBAND_PCT, T_S, delay_s), SpoolMonitor(SPOOL_DEADBAND_PCT, T_S)
    spool, blamed = Spool(delay_s), set()
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


@pytest.mark.parametrize(
    ("reason", "confirmed_s"),
    [
        (Reason.SPOOL_OPEN, 0.1 + OPEN_S),
        (Reason.SPOOL_SHUT, SPOOL_WINDOW_S + SHUT_S),
        (Reason.SPOOL_WRONG, SPOOL_WINDOW_S + WRONG_S),
    ],
)
def test_the_promised_time_holds_the_window_and_the_confirmation(reason, confirmed_s):
    assert confirmed_s * 1e3 <= FAULTS[reason].bound_ms, "dead time and spool of 0.1 s, or the window"


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


@pytest.mark.parametrize(
    ("excused", "ticks", "then", "more"),
    [
        pytest.param({"pressed": True}, round(FAST_PRESSED_S / T_S) - 1, {"pressed": True}, 3, id="jaws throw it"),
        pytest.param({"pushed": True}, 400, {}, 100, id="against the pressure of its oil"),
    ],
)
def test_a_joint_that_is_thrown_or_pushed_is_no_runaway_and_one_that_goes_on_is(excused, ticks, then, more):
    watched = monitor()
    assert {watched.step(0.0, 0.6 * LIMIT, **excused) for _ in range(ticks)} == {Reason.NONE}
    assert Reason.JOINT_RUNAWAY in {watched.step(0.0, 0.6 * LIMIT, **then) for _ in range(more)}


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


# -- valves and encoders that go wrong under a running controller: the reason tells one from the other

SPEED = 0.25


def driven(bench: Bench, j: int, until: int = 200) -> Bench:
    """The joint moves at a quarter of its speed limit."""
    bench.armed()
    bench.tick([bench.hold()])
    drive(bench, j, until)
    assert bench.mode is Mode.ACTIVE, bench.reason
    return bench


def drive(bench: Bench, j: int, ticks: int) -> int:
    """Keep it moving; the ticks until the machine does not work any more, or these."""
    for k in range(ticks):
        bench.tick([bench.moving(j, SPEED * SPECS[j].speed_limit)] if k % 10 == 0 else ())
        if bench.mode is not Mode.ACTIVE:
            return k + 1
    return ticks


def shown(bench: Bench) -> tuple[float, ...]:
    bench.run(5)
    return bench.reports[-1].numbers


@pytest.mark.parametrize("j", [0, 1, 2, 3, 4])
def test_a_spool_that_stays_shut_stops_and_says_so(j):
    bench = driven(Bench(), j)
    bench.spool_stuck[j] = 0.0
    k = drive(bench, j, 100)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.SPOOL_SHUT, j)
    assert k * T <= FAULTS[Reason.SPOOL_SHUT].bound_ms * MS
    spool, _, commanded = shown(bench)
    assert abs(spool) < 6.0 < abs(commanded)


@pytest.mark.parametrize("place", [60.0, -60.0])
@pytest.mark.parametrize("j", [0, 1, 2, 3, 4])
def test_a_spool_that_stays_open_cuts_the_supply(j, place):
    bench = driven(Bench(), j)
    bench.spool_stuck[j] = place
    k = drive(bench, j, 100)
    assert bench.mode is Mode.FAULT
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.SPOOL_OPEN, j)
    assert k * T <= FAULTS[Reason.SPOOL_OPEN].bound_ms * MS


def test_a_spool_that_opens_while_armed_and_neutral_cuts_before_the_joint_tells():
    bench = Bench().armed()
    bench.run(100)
    bench.spool_stuck[1] = 30.0
    k = count_until(bench.tick, lambda: bench.mode is Mode.FAULT)
    assert bench.reason == Reason.SPOOL_OPEN and (k - 1) * T <= 60 * MS


def test_a_spool_that_opens_half_as_far_slows_the_machine_and_lets_it_work():
    bench = driven(Bench(), 0)
    bench.spool_gain[0] = 0.7
    seen = set()
    for k in range(400):
        bench.tick([bench.moving(0, SPEED * SPECS[0].speed_limit)] if k % 10 == 0 else ())
        seen.add((bench.reason, bench.controller.supervisor.half_speed))
    assert bench.mode is Mode.ACTIVE and (Reason.SPOOL_WRONG, True) in seen


@pytest.mark.parametrize("j", [0, 1, 2, 3])
def test_a_joint_that_its_spool_does_not_move_is_the_encoders_fault_or_an_obstacle(j):
    bench = driven(Bench(), j)
    bench.stuck.add(j)
    k = drive(bench, j, 100)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.JOINT_STUCK, j)
    assert k * T <= 200 * MS


def behind_a_plc(role: Literal["references", "valves"] = "valves") -> Bench:
    bench = Bench(behind_plc(role))
    bench.spools_measured = False
    return bench


@pytest.mark.parametrize("j", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("role", ["references", "valves"])
def test_behind_a_plc_a_joint_is_compared_with_what_the_plc_drives_its_valve_with(role, j):
    bench = driven(behind_a_plc(role), j)
    bench.stuck.add(j)
    k = drive(bench, j, 120)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.JOINT_STUCK, j)
    assert k * T <= 300 * MS
    assert math.isfinite(shown(bench)[0])


@pytest.mark.parametrize(("role", "reason"), [("references", Reason.NONE), ("valves", Reason.SPOOL_WRONG)])
def test_a_plc_that_closes_the_loop_drives_the_valves_as_it_likes_and_one_that_passes_openings_on_does_not(
    role, reason
):
    bench = driven(behind_a_plc(role), 0)
    bench.plc_output[0] = 0.5 * bench.plc_outputs[0]
    drive(bench, 0, 60)
    assert bench.reason is reason


def test_a_plc_that_does_not_report_its_outputs_is_lost():
    bench = driven(behind_a_plc("references"), 0)
    bench.dropped.add("PlcOut")
    k = drive(bench, 0, 40)
    assert bench.reason is Reason.PLC_LOST and 50 * MS <= k * T <= 100 * MS
    age_ms, limit_ms, _ = shown(bench)
    assert age_ms > 50.0 and limit_ms == 50.0


@pytest.mark.parametrize(("make", "ticks"), [(Bench, 30), (behind_a_plc, 45)])
def test_what_the_tongs_do_to_the_rotator_is_no_fault(make, ticks):
    bench = make().armed()
    bench.tick([bench.hold()])
    drive(bench, 4, 200)
    bench.stuck.add(4)
    for k in range(ticks):
        bench.tick([bench.moving(4, 0.3, grapple=GrappleCommand.CLOSE)] if k % 10 == 0 else ())
    assert bench.mode is Mode.ACTIVE


def test_a_pump_at_its_limit_excuses_a_slow_joint():
    bench = driven(Bench(), 0)
    bench.changed["ValveFbB"] = {"Limit": 1}
    bench.stuck.add(0)
    assert drive(bench, 0, 60) == 60, "it stands for longer than the speed monitor allows"


@pytest.mark.parametrize("encoder", [None, SPECS[4].encoder])
def test_the_dead_time_of_a_valve_that_no_calibration_measures_may_be_the_longest_one(encoder):
    """A rotator without an encoder keeps the dead time of the shipped profile."""
    spec = msgspec.structs.replace(SPECS[4], encoder=encoder)
    watch, late = SpoolMonitor(5.0, T * 1e-9, allowed_delay_s(spec)), round((0.25 + SPOOL_S) * 1e9 / T)
    commands = [40.0] * 200 + [0.0] * 100
    found = {watch.step(now, commands[max(i - late, 0)]) for i, now in enumerate(commands)}
    assert (Reason.SPOOL_OPEN in found) is (encoder is not None)


def test_a_new_session_may_begin_while_the_spools_still_close():
    bench = driven(Bench(), 0)
    bench.press(2)
    bench.run(40)
    bench.press(1)
    assert bench.run(100) is Mode.ARMED
