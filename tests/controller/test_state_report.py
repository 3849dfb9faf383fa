"""What the controller measured when it stopped, in its reports: the numbers of each reason, kept until the reset."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from can_dbc.messages.crane import OperatorAction
from can_dbc.messages.datagrams import encode
from can_dbc.protocols.canopen import Emergency, emergency_frame
from machine.joints import ARTICULATION, Joint
from machine.status.evidence import EVIDENCE
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import DetailKind, Reason
from tests.controller.bench import MS, OTHER_CHECK, SETTINGS, Bench, T, count_until
from tests.controller.drive_bench import DriveBench

REPORT_TICKS = 4


def stopped(bench: Bench, disturb: Callable[[Bench], None], reason: Reason, **measured: int) -> Bench:
    """The bench, one report after the reason was set."""
    disturb(bench)
    bench.until(reason, 200, **measured)
    bench.run(REPORT_TICKS)
    return bench


def numbers(bench: Bench) -> tuple[float, ...]:
    return bench.reports[-1].numbers


def test_a_good_report_has_no_evidence_and_the_bytes_it_always_had() -> None:
    bench = Bench().active()
    report = bench.reports[-1]
    assert (report.since_ns, report.numbers, report.reason) == (0, (), 0)
    stop = stopped(bench, lambda b: b.dropped.add("GuardStat"), Reason.GUARD_LOST)
    assert len(encode(stop.reports[-1])) == len(encode(report)) + 32


def test_a_silent_encoder_shows_its_age_and_that_nothing_was_refused() -> None:
    bench = stopped(Bench().active(), lambda b: b.dropped.add("EncLift"), Reason.ENCODER_LOST)
    age_ms, limit_ms, refused = numbers(bench)
    assert limit_ms == 15.0 < age_ms <= 15.0 + 2 * T / MS and refused == 0
    assert bench.reports[-1].reason >> 8 == Joint.LIFT


def test_a_frozen_encoder_differs_from_a_cut_cable_by_its_refused_frames() -> None:
    bench = stopped(Bench().active(), lambda b: b.frozen.add("EncLift"), Reason.ENCODER_FROZEN)
    commanded, _, refused = numbers(bench)
    assert math.isfinite(commanded) and refused >= 2


def test_of_several_messages_the_lost_one_is_measured() -> None:
    bench = stopped(Bench().active(), lambda b: b.dropped.add("ValveFbB"), Reason.VALVE_FEEDBACK_LOST)
    assert numbers(bench)[0] > 15.0 == numbers(bench)[1]


@pytest.mark.parametrize(
    ("name", "values", "reason", "expected"),
    [
        ("EstopStat", {"ChannelA": 0}, Reason.ESTOP_PRESSED, (0.0, 1.0, 1.0)),
        ("GuardStat", {"Enable": 0, "Verdict": 5, "FaultAxis": 2}, Reason.GUARD_REFUSES, (5.0, math.nan, 2.0)),
        (
            "GuardStat",
            {"Enable": 0xA, "ProfileCheck": OTHER_CHECK},
            Reason.PROFILE_DIFFERS,
            (float(OTHER_CHECK), float(SETTINGS.file_check), math.nan),
        ),
        ("ValveFbA", {"State": 4}, Reason.VALVE_NODE_FAULT, (4.0, math.nan, 0.0)),
        ("PlcStatus", {"FaultBits": 0x21}, Reason.PLC_FAULT, (33.0, math.nan, math.nan)),
        ("EncRot", {"Alarms": 4}, Reason.ENCODER_ALARM, (4.0, math.nan, math.nan)),
        ("EstopStat", {"Person": 1}, Reason.PERSON_IN_ZONE, (math.nan, math.nan, math.nan)),
    ],
)
def test_a_bad_value_is_in_the_evidence(
    name: str, values: dict[str, float], reason: Reason, expected: tuple[float, ...]
) -> None:
    bench = stopped(Bench().active(), lambda b: b.changed.update({name: values}), reason)
    assert numbers(bench) == pytest.approx(expected, nan_ok=True)
    assert bench.reports[-1].since_ns > 0


def test_a_valve_node_that_accepts_nothing_shows_for_how_long_and_why() -> None:
    bench = Bench().active()
    bench.changed["ValveFbB"] = {"EchoCounter": 7, "ExitCode": 4}
    unchanged_ms, limit_ms, exit_code = numbers(stopped(bench, lambda _: None, Reason.VALVE_ECHO_STUCK))
    assert unchanged_ms > limit_ms == 20.0 and exit_code == 4


def test_a_lost_heartbeat_shows_its_age() -> None:
    bench = stopped(Bench().active(), lambda b: b.silent_nodes.add(1), Reason.SAFETY_NODE_LOST)
    assert numbers(bench)[0] == pytest.approx(250.0, abs=2 * T / MS) and numbers(bench)[1] == 250.0


def test_an_emergency_message_shows_its_code() -> None:
    sent = emergency_frame(Emergency(4, 0x6100, 1, b""))
    assert numbers(stopped(Bench().active(), lambda b: b.extra.append(sent), Reason.EMERGENCY_MESSAGE))[0] == 0x6100


def test_a_late_loop_shows_how_late_it_was() -> None:
    bench = Bench().active()
    bench.tick([bench.moving(0, 0.08)], late_ns=2 * T + MS)
    assert bench.run(REPORT_TICKS) is Mode.ACTIVE
    assert numbers(bench) == (pytest.approx(11.0), 10.0, 1.0)
    bench.tick([bench.moving(0, 0.08)], late_ns=61 * MS)
    assert bench.run(REPORT_TICKS) is Mode.STOP
    assert numbers(bench) == (pytest.approx(61.0), 50.0, 2.0)


def test_a_lost_lease_shows_the_age_of_the_setpoint_and_its_lease() -> None:
    bench = Bench().active()
    bench.tick([bench.moving(0, 0.08, lease_ms=100)])
    bench.run(24)
    assert bench.reason == Reason.LEASE_LOST
    age_ms, lease_ms, _ = numbers(bench)
    assert lease_ms == 100.0 <= age_ms <= 105.0


def test_refused_setpoints_show_the_reason_of_the_last_one() -> None:
    bench = Bench().active()
    for _ in range(3):
        bench.tick([b"rubbish"])
    bench.run(REPORT_TICKS)
    assert bench.reason == Reason.SETPOINTS_REFUSED
    refused, _, last = numbers(bench)
    assert refused == bench.reports[-1].refused and last == Reason.DATAGRAM_LENGTH


def test_a_runaway_joint_shows_its_velocity_and_its_command() -> None:
    bench = stopped(Bench().active(), lambda b: b.moves_alone.update({1: 0.2}), Reason.JOINT_RUNAWAY)
    velocity, limit, commanded = numbers(bench)
    assert velocity == pytest.approx(0.2, rel=0.3) and abs(commanded) < 0.05
    assert limit == bench.specs[1].speed_limit and bench.reports[-1].reason >> 8 == 1


def test_a_position_outside_shows_the_limit_that_it_passed() -> None:
    bench = Bench(home=(0.0, 1.356, -1.2, 0.6, 0.0)).armed()
    for _ in range(100):
        bench.q[1] += 0.0001
        bench.tick()
    position, limit, _ = numbers(bench)
    assert bench.reason == Reason.POSITION_OUTSIDE
    assert limit < position < limit + 0.005 and limit == pytest.approx(bench.specs[1].upper + 0.05)


@pytest.mark.parametrize(
    ("measured", "reason", "first"),
    [({"bus_state": 3, "bus_errors": 17}, Reason.BUS_OFF, 17.0), ({"bus_state": 4}, Reason.BUS_DOWN, 0.0)],
)
def test_a_lost_bus_shows_its_counters(measured: dict[str, int], reason: Reason, first: float) -> None:
    bench = stopped(Bench().active(), lambda b: None, reason, **measured)
    assert numbers(bench)[0] == first


def test_the_evidence_stays_until_the_reset_and_tells_when_it_began() -> None:
    bench = Bench().active()
    bench.dropped.add("GuardStat")
    bench.until(Reason.GUARD_LOST)
    began_ns = bench.now_ns
    bench.run(60)
    kept = numbers(bench)
    bench.dropped.clear()
    bench.run(400)
    report = bench.reports[-1]
    assert bench.mode is Mode.FAULT and (report.numbers, report.since_ns) == (kept, began_ns)
    bench.press(OperatorAction.RESET)
    bench.run(REPORT_TICKS)
    assert bench.reports[-1].numbers == () and bench.reports[-1].since_ns == 0


def test_the_second_fault_of_a_stop_has_its_own_evidence() -> None:
    bench = Bench().active()
    bench.press(OperatorAction.STOP)
    bench.run(REPORT_TICKS)
    assert all(map(math.isnan, numbers(bench)))
    bench.dropped.add("EncSlew")
    bench.run(4 + REPORT_TICKS)
    assert bench.reason == Reason.ENCODER_LOST and numbers(bench)[1] == 15.0


SILENT = {reason for reason in EVIDENCE if reason.name.endswith("_LOST") and "NODE" not in reason.name}
"""Reasons whose number is the age of something that is missing: in a good state there is none."""


CRANE_ONLY = {Reason.MOVES_WHILE_STOPPED, Reason.ENCODER_NOISY, Reason.ENCODER_DRIFT, Reason.HOSE_BURST}
"""Findings of `controller.joint_watch`, `controller.valve_watch` and the pressures: not about the articulation."""


@pytest.mark.parametrize("detail", [1, ARTICULATION])
def test_every_other_reason_of_the_table_is_measured_on_a_driving_machine(detail: int) -> None:
    bench = DriveBench().under_way(100)
    evidence, supervisor = bench.controller.evidence, bench.controller.supervisor
    for reason in EVIDENCE.keys() - SILENT:
        of_crane = reason in CRANE_ONLY or reason.name.startswith(("JOINT_", "SPEED_", "SPOOL_", "TEST_"))
        if detail == ARTICULATION and (of_crane or FAULTS[reason].about is not DetailKind.JOINT):
            continue
        supervisor.reason, supervisor.detail = reason, detail
        evidence.update(bench.inputs, bench.now_ns)
        assert len(evidence.numbers) == 3 and math.isfinite(evidence.numbers[0]), reason
        assert evidence.since_ns == bench.now_ns


@pytest.mark.parametrize(
    ("message", "reason"), [("VehStat", Reason.CARRIER_LOST), ("ArmHeightB", Reason.SWING_ARMS_LOST)]
)
def test_a_silent_message_of_the_carrier_shows_its_age(message: str, reason: Reason) -> None:
    bench = DriveBench().under_way(100)
    bench.dropped.add(message)
    count_until(bench.tick, lambda: bench.reason == reason)
    bench.run(REPORT_TICKS)
    age_ms, limit, _ = bench.reports[-1].numbers
    assert bench.reason == reason and age_ms > limit and limit <= 90.0


def test_a_carrier_that_runs_away_shows_its_speed_and_its_command() -> None:
    bench = DriveBench().under_way(250)
    bench.lies["VehStat"] = {"Speed": 1.06}
    for k in range(150):
        bench.go(1, 50.0, 0.0) if k % 10 == 0 and bench.mode is Mode.ACTIVE else bench.run(1)
    assert bench.reason == Reason.CARRIER_RUNAWAY
    speed, _, commanded = bench.reports[-1].numbers
    assert speed == pytest.approx(1.06, abs=0.02) and commanded == pytest.approx(0.6, abs=0.05)
