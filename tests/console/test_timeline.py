"""The timeline: modes, stops with sentence and remedy, loads."""

from __future__ import annotations

import json
from dataclasses import replace
from math import nan

import msgspec

from can_dbc.messages.crane import StateReport
from console.timeline import ENTRIES, Timeline
from machine.status.explanation import explain
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.codes import numbers_in
from tests.console.state_reports import at

REPORT = at((0.0,) * 5, 10**9, Mode.STANDBY, grapple_state=1, load_kg=240.0)
STUCK = pack(Reason.JOINT_STUCK, 1)


def story(*reports: StateReport) -> list[dict]:
    timeline = Timeline()
    for report in reports:
        timeline.on_report(report)
    json.dumps(list(timeline.entries), allow_nan=False)
    return list(timeline.entries)


def test_a_stop_has_its_code_sentence_measurement_and_remedy() -> None:
    stop = replace(
        REPORT, stamp_ns=3 * 10**9, mode=Mode.STOP, reason=STUCK, since_ns=2_990_000_000, numbers=(0.4, 0.1, 0.0)
    )
    *_, entry = story(REPORT, replace(REPORT, mode=Mode.ACTIVE), stop, replace(stop, stamp_ns=4 * 10**9))
    told = explain(STUCK, stop.numbers)
    assert (entry["kind"], entry["title"], entry["advice"]) == ("stop", "JOINT_STUCK", told.advice)
    assert told.sentence in entry["text"] and all(q.text in entry["text"] for q in told.quantities)
    assert (entry["at_s"], entry["mode"], entry["before"]) == (2.99, "STOP", "ACTIVE")


def test_the_fault_behind_a_ramp_is_the_same_stop_and_a_second_reason_is_another() -> None:
    stop = replace(REPORT, mode=Mode.STOP, reason=STUCK)
    fault = replace(stop, mode=Mode.FAULT)
    other = replace(fault, reason=pack(Reason.ESTOP_PRESSED, 0))
    found = story(replace(REPORT, mode=Mode.ACTIVE), stop, fault, other)
    assert [(e["kind"], e["title"]) for e in found] == [
        ("mode", "ACTIVE"),
        ("stop", "JOINT_STUCK"),
        ("mode", "FAULT"),
        ("stop", "ESTOP_PRESSED"),
    ]


def test_a_machine_that_was_stopped_before_has_no_stop() -> None:
    assert [e["kind"] for e in story(replace(REPORT, mode=Mode.FAULT, reason=STUCK))] == ["mode"]


def held(at_s: float, load_kg: float, state: int = 5) -> StateReport:
    return replace(REPORT, stamp_ns=int(at_s * 1e9), grapple_state=state, load_kg=load_kg)


def grips(*reports: StateReport) -> list[tuple[float, list[float]]]:
    """When the grapple took or released a load, and the numbers that are told of it."""
    return [(e["at_s"], numbers_in(e["text"])) for e in story(*reports) if e["kind"] == "grip"]


def test_a_load_is_told_once_with_its_weight_when_it_has_hung_for_a_second() -> None:
    lifted = (held(1.0, 1.4), held(2.0, 80.0), held(2.5, 190.0), held(3.0, 240.0), held(4.0, 250.0), held(9.0, 3.0))
    assert grips(REPORT, *lifted, held(9.5, 3.0, state=2), held(9.9, 0.0, state=1)) == [
        (2.0, [240]),
        (9.5, []),
    ]


def test_jaws_that_close_empty_hold_no_load() -> None:
    assert grips(held(1.0, 0.4), held(5.0, 2.0), held(5.1, 12.0), held(5.2, 1.0), held(7.0, 12.0)) == []


def test_a_load_that_nothing_weighs_is_told_at_once() -> None:
    assert grips(held(1.0, nan), held(5.0, nan)) == [(1.0, [])]


def test_loads_of_a_mission_are_told() -> None:
    timeline = Timeline()
    timeline.on_mission(MISSION_REPORT, 0)
    timeline.on_mission(msgspec.structs.replace(MISSION_REPORT, loaded=MISSION_REPORT.loaded + 1), 10**9)
    assert [e["kind"] for e in timeline.entries] == ["mission", "load"]
    assert MISSION_REPORT.name in timeline.entries[0]["title"]
    assert timeline.entries[-1]["at_s"] == 1.0


def test_the_memory_is_bounded_and_the_count_is_not() -> None:
    timeline = Timeline()
    for k in range(ENTRIES + 9):
        timeline.on_report(replace(REPORT, mode=Mode.ARMED if k % 2 else Mode.STANDBY))
    assert (len(timeline.entries), timeline.count) == (ENTRIES, ENTRIES + 9)
