"""Valves and encoders that go wrong under a running controller: the reason tells one from the other."""

import math
from typing import Literal

import msgspec
import pytest

from can_dbc.messages.crane import GrappleCommand
from controller.estimation.valve_monitors import SPOOL_S, SpoolMonitor
from controller.valve_watch import allowed_delay_s
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, SPECS, Bench, T, behind_plc, count_until

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
