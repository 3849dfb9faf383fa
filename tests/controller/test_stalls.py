"""Several inputs that are lost at once are put down to what they have in common: this computer, or the bus."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from controller.config import Settings
from controller.supervisor import STALL_MEMORY_NS, STALL_NS
from machine.status.explanation import describe
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.codes import numbers_in
from tests.controller.bench import AORO, MACHINE_PERIOD_MS, MS, SETTINGS, VALUES, Bench, T

SAMPLED = ("EncSlew", "EncLift", "EncTilt", "EncExt", "EncRot")
"""Sent in answer to SYNC."""


def stalled(bench: Bench, stall_ns: int, lost: tuple[str, ...] = SAMPLED) -> None:
    """The loop stands still: its periods are skipped, no SYNC goes out meanwhile, and the next tick is late."""
    bench.dropped.update(lost)
    bench.now_ns += stall_ns // T * T
    bench.tick(late_ns=stall_ns)
    bench.dropped.difference_update(lost)


def silent(bench: Bench, ticks: int) -> int:
    """Nothing comes on crane0; returns after how many ticks the machine stopped."""
    bench.dropped.update([*VALUES, *SAMPLED])
    bench.silent_nodes.update([*bench.nodes, *bench.encoders])
    for k in range(1, ticks + 1):
        bench.tick()
        if bench.mode is not Mode.ACTIVE:
            return k
    raise AssertionError("it did not stop")


def test_a_stalled_loop_blames_the_computer_and_not_a_cable() -> None:
    bench = Bench().active()
    stalled(bench, 23 * MS)
    assert (bench.mode, bench.reason) == (Mode.FAULT, Reason.COMPUTER_STALLED)
    assert bench.neutral
    stood_ms, limit, lost = bench.controller.evidence.numbers
    assert (stood_ms, lost) == (23.0, 5.0) and math.isnan(limit)
    assert 23.0 in numbers_in(describe(bench.reason, numbers=bench.controller.evidence.numbers))
    bench.run(200)
    assert (bench.mode, bench.reason) == (Mode.FAULT, Reason.COMPUTER_STALLED), "a person resets it"


def test_inputs_that_are_lost_just_after_a_stall_are_its_work() -> None:
    bench = Bench().active()
    bench.tick(late_ns=9 * MS)
    bench.tick(late_ns=6 * MS)
    bench.dropped.update(SAMPLED)
    bench.run(3)
    assert bench.reason == Reason.COMPUTER_STALLED
    assert bench.controller.evidence.numbers[0] == 9.0, "the longest"


@pytest.mark.parametrize("late_ns", [0, 4 * MS])
def test_a_silent_bus_is_no_encoder_s_fault(late_ns: int) -> None:
    bench = Bench().active()
    bench.tick(late_ns=late_ns)
    ticks = silent(bench, 10)
    assert ticks * T <= FAULTS[Reason.INPUTS_LOST].bound_ms * MS
    assert (bench.mode, bench.reason, bench.controller.supervisor.detail) == (Mode.FAULT, Reason.INPUTS_LOST, 0)
    assert 10.0 <= bench.controller.evidence.numbers[0] <= 20.0


@pytest.mark.parametrize("late_ns", [0, 4 * MS, 12 * MS])
def test_one_cut_cable_is_the_encoder_s_fault(late_ns: int) -> None:
    bench = Bench().active()
    bench.dropped.add("EncLift")
    bench.tick(late_ns=late_ns)
    bench.run(4)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.ENCODER_LOST, 1)


@pytest.mark.parametrize(
    ("settings", "name", "ticks", "reason"),
    [
        (SETTINGS, "EstopStat", 12, Reason.ESTOP_LOST),
        (SETTINGS, "GuardStat", 12, Reason.GUARD_LOST),
        (AORO, "VehStat", 30, Reason.CARRIER_LOST),
        (AORO, "ArmHeightA", 30, Reason.SWING_ARMS_LOST),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_one_silent_node_is_that_node_s_fault(settings: Settings, name: str, ticks: int, reason: Reason) -> None:
    bench = Bench(settings).active()
    bench.dropped.add(name)
    bench.run(ticks)
    assert (bench.mode, bench.reason) == (Mode.FAULT, reason)


def test_long_after_a_stall_a_cut_trunk_is_no_computer_s_fault() -> None:
    bench = Bench().active()
    bench.tick(late_ns=9 * MS)
    bench.run(6)
    bench.dropped.update(("EncLift", "EncTilt"))
    bench.run(4)
    assert bench.reason == Reason.INPUTS_LOST
    assert bench.controller.evidence.numbers[0] < 10.0, "others are heard"


def test_a_machine_that_stands_still_beside_a_living_guard_is_no_encoder_s_fault() -> None:
    bench = Bench().active()
    bench.dropped.update({*VALUES, *SAMPLED} - {"GuardStat"})
    bench.run(4)
    assert (bench.mode, bench.reason) == (Mode.FAULT, Reason.INPUTS_LOST)


def test_one_node_with_two_messages_is_that_node_s_fault() -> None:
    bench = Bench().active()
    bench.dropped.update(("ValveFbA", "ValveFbB"))
    bench.run(12)
    assert bench.reason == Reason.VALVE_FEEDBACK_LOST


def test_a_silent_machine_bus_is_named() -> None:
    bench = Bench(AORO).active()
    bench.dropped.update(MACHINE_PERIOD_MS)
    bench.run(30)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.INPUTS_LOST, 1)
    assert bench.controller.evidence.numbers[0] > 15.0


def test_a_stall_that_the_machine_bus_feels_is_the_computer_s() -> None:
    bench = Bench(AORO).active()
    bench.dropped.update(("VehStat", "ArmHeightA", "ArmHeightB"))
    bench.run(30, late_ns=8 * MS)
    assert bench.reason == Reason.COMPUTER_STALLED


# -- At the edges of the rule.


def lost(*nodes: tuple[tuple[bool, int], ...], heard_ms: int = 0, bench: Bench | None = None) -> Reason:
    """The common cause of what is lost, by (here, time-out [ms]) of every message of every node."""
    states = [[SimpleNamespace(values=() if here else None, timeout_ns=ms * MS) for here, ms in node] for node in nodes]
    supervisor, now_ns = (bench or Bench()).controller.supervisor, (bench or Bench()).now_ns
    return supervisor._lost_together(states, now_ns - heard_ms * MS, now_ns)


@pytest.mark.parametrize(
    ("heard_ms", "reason"), [(0, Reason.NONE), (40, Reason.NONE), (50, Reason.NONE), (51, Reason.INPUTS_LOST)]
)
def test_one_lost_message_is_the_bus_s_fault_once_it_was_silent_for_half_its_time_out(
    heard_ms: int, reason: Reason
) -> None:
    assert lost(((False, 100), (True, 10)), ((True, 100),), heard_ms=heard_ms) == reason


def test_two_nodes_are_lost_together_by_a_message_each() -> None:
    assert lost(((False, 100), (True, 100)), ((False, 100), (True, 100))) == Reason.INPUTS_LOST
    assert lost(((False, 100), (False, 100)), ((True, 100),)) == Reason.NONE
    assert lost(((True, 100),), ((True, 100),)) == Reason.NONE


def test_a_stall_is_remembered_for_its_time_and_no_longer() -> None:
    bench, both = Bench(), (((False, 100),), ((False, 100),))
    supervisor, begin_ns = bench.controller.supervisor, bench.now_ns
    supervisor._note_stall(STALL_NS, begin_ns)
    assert supervisor.stall_ns == 0 and lost(*both, bench=bench) == Reason.INPUTS_LOST
    supervisor._note_stall(9 * MS, begin_ns)
    bench.now_ns = begin_ns + STALL_MEMORY_NS - 1
    assert lost(*both, bench=bench) == Reason.COMPUTER_STALLED
    supervisor._note_stall(6 * MS, bench.now_ns)
    assert supervisor.stall_ns == 9 * MS
    bench.now_ns += STALL_MEMORY_NS
    assert lost(*both, bench=bench) == Reason.INPUTS_LOST
    supervisor._note_stall(6 * MS, bench.now_ns)
    assert supervisor.stall_ns == 6 * MS
