"""The supervisor's limits, each at the last value that passes and at the first that does not."""

from __future__ import annotations

from itertools import count
from types import SimpleNamespace

import pytest

from can_dbc.messages.crane import OperatorAction
from controller.supervisor import (
    DEGRADE_NS,
    LATE_NS,
    LATE_WINDOW_NS,
    MAX_ECHO_NS,
    MAX_ECHO_TICKS,
    NO_JOINT,
    PLC_RAMP_NS,
    RAMP_NS,
    RANGE_MARGIN_UNITS,
    STALLED_NS,
)
from controller.transitions import Event
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import AORO, MACHINE, MS, PROFILE, SETTINGS, SPECS, Bench, T, behind_plc

NOW = 100 * 10**9


def supervisor_in(mode: Mode, detail: int = 0, settings=SETTINGS):
    """Its details are those of the time before."""
    made = Bench(settings).controller.supervisor
    made.mode, made.detail, made.worst_detail = mode, detail, detail
    return made


def test_the_limits_are_those_of_the_documentation() -> None:
    assert (RAMP_NS, DEGRADE_NS, LATE_NS, LATE_WINDOW_NS, STALLED_NS) == (50 * MS, 10**9, 10 * MS, 10**9, 50 * MS)
    assert (MAX_ECHO_TICKS, MAX_ECHO_NS, RANGE_MARGIN_UNITS) == (4, 20 * MS, 0.05)


@pytest.mark.parametrize(
    ("period_ms", "late_ns", "found"),
    [
        (1, 10 * MS, Reason.NONE),
        (1, 10 * MS + 1, Reason.LOOP_LATE),
        (5, 10 * MS, Reason.NONE),
        (5, 10 * MS + 1, Reason.LOOP_LATE),
        (20, 40 * MS, Reason.NONE),
        (20, 40 * MS + 1, Reason.LOOP_LATE),
        (5, 50 * MS, Reason.LOOP_LATE),
        (5, 50 * MS + 1, Reason.LOOP_STALLED),
        (5, 0, Reason.NONE),
    ],
)
def test_lateness(period_ms: int, late_ns: int, found: Reason) -> None:
    supervisor = supervisor_in(Mode.STANDBY)
    supervisor.supervise(late_ns, period_ms * MS, NOW)
    assert supervisor.worst is found
    assert supervisor.late == int(found is not Reason.NONE)


@pytest.mark.parametrize(
    ("apart_ns", "found"), [(LATE_WINDOW_NS // 2, Reason.LOOP_LATE), (LATE_WINDOW_NS // 2 - 1, Reason.LOOP_STALLED)]
)
def test_three_late_ticks_within_a_second(apart_ns: int, found: Reason) -> None:
    supervisor = supervisor_in(Mode.STANDBY)
    for k in range(3):
        assert k == 0 or supervisor.worst is Reason.LOOP_LATE
        supervisor.supervise(10 * MS + 1, T, NOW + k * apart_ns)
    assert supervisor.worst is found
    supervisor.supervise(10 * MS + 1, T, NOW + 10 * LATE_WINDOW_NS)
    assert supervisor.worst is Reason.LOOP_LATE, "the old ones are forgotten"
    assert supervisor.late == 4


def test_half_speed_lasts_a_second() -> None:
    supervisor = supervisor_in(Mode.ACTIVE)
    supervisor.react_to(Reason.BUS_PASSIVE, 1, NOW)
    assert supervisor.half_speed and (supervisor.mode, supervisor.reason) == (Mode.ACTIVE, Reason.BUS_PASSIVE)
    assert supervisor.detail == 1
    supervisor.react_to(Reason.NONE, 0, NOW + DEGRADE_NS - 1)
    assert supervisor.half_speed
    supervisor.react_to(Reason.NONE, 0, NOW + DEGRADE_NS)
    assert not supervisor.half_speed


@pytest.mark.parametrize("mode", [Mode.STANDBY, Mode.STOP, Mode.FAULT, Mode.BOOT])
def test_half_speed_is_no_reason_while_nothing_is_armed(mode: Mode) -> None:
    supervisor = supervisor_in(mode)
    supervisor.react_to(Reason.BUS_PASSIVE, 1, NOW)
    assert supervisor.half_speed and supervisor.reason is Reason.NONE and supervisor.mode is mode


@pytest.mark.parametrize(
    ("reason", "mode", "after"),
    [
        (Reason.ESTOP_PRESSED, Mode.STANDBY, Mode.FAULT),
        (Reason.GUARD_REFUSES, Mode.STANDBY, Mode.STANDBY),
        (Reason.GUARD_REFUSES, Mode.ARMED, Mode.FAULT),
        (Reason.ENCODER_LOST, Mode.ARMED, Mode.FAULT),
        (Reason.PERSON_IN_ZONE, Mode.ARMED, Mode.STOP),
        (Reason.PERSON_IN_ZONE, Mode.STANDBY, Mode.STANDBY),
        (Reason.ENCODER_LOST, Mode.ACTIVE, Mode.STOP),
        (Reason.INPUT_MISSING, Mode.ACTIVE, Mode.ACTIVE),
    ],
)
def test_a_finding_reacts_only_while_armed_unless_it_always_does(reason: Reason, mode: Mode, after: Mode) -> None:
    supervisor = supervisor_in(mode)
    supervisor.react_to(reason, 3, NOW)
    assert supervisor.mode is after
    if after is not mode:
        assert (supervisor.reason, supervisor.detail) == (reason, 3)


def test_before_a_plc_which_adds_its_own_ramp_the_latched_one_is_short() -> None:
    supervisor = supervisor_in(Mode.ACTIVE, settings=behind_plc("valves"))
    supervisor.apply(Event.RAMP, Reason.ENCODER_LOST, 2, NOW)
    assert supervisor.ramp_ns == PLC_RAMP_NS == 10 * MS


def blind(supervisor):
    """From now on nothing is found: no input is checked, only time passes."""
    nothing, unknown = SimpleNamespace(values=None), SimpleNamespace(value=lambda: None)
    nodes = SimpleNamespace(worst_finding=lambda _now_ns: (Reason.NONE, 0))
    supervisor.crane_inputs = SimpleNamespace(
        foreign=False, stale_mask=0, estop=nothing, guard=nothing, valve_a=nothing, nodes=nodes
    )
    for name in ("_person", "_valve_state", "_plc_faults", "_enable"):
        setattr(supervisor, name, unknown)
    supervisor._alarms = supervisor._axes = ()
    supervisor._echo_counter = SimpleNamespace(value=count().__next__)
    return supervisor


@pytest.mark.parametrize(
    ("event", "ramp_ns"), [(Event.HOLD, PROFILE.timeouts.stop_ramp_ms * MS), (Event.RAMP, RAMP_NS)]
)
@pytest.mark.parametrize("coast_ns", [0, 700 * MS])
def test_a_ramp_begins_and_ends_to_the_nanosecond(event: Event, ramp_ns: int, coast_ns: int) -> None:
    supervisor = blind(supervisor_in(Mode.ACTIVE))
    supervisor.coast_ns = coast_ns
    assert supervisor.apply(event, Reason.ENCODER_LOST, 2, NOW) is True
    latches = event is Event.RAMP
    assert (supervisor.mode, supervisor.ramping, supervisor.latching) == (Mode.STOP, True, latches)
    assert (supervisor.ramp_ns, supervisor.ramp_end_ns) == (ramp_ns, NOW + ramp_ns)
    end_ns = NOW + (ramp_ns if latches else max(ramp_ns, coast_ns))
    assert supervisor.apply(event, Reason.LEASE_LOST, 0, NOW) is False, "a second one changes nothing"
    for ask in (supervisor.request_disarm, supervisor.request_reset):
        ask(end_ns - 1)
    assert supervisor.request_arm(end_ns - 1) == (Reason.STILL_STOPPING, 0)
    assert (supervisor.mode, supervisor.ramping) == (Mode.STOP, True)
    for at_ns in (end_ns - 1, end_ns):
        assert supervisor.ramping and supervisor.mode is Mode.STOP
        supervisor.supervise(0, T, at_ns)
    assert not supervisor.ramping
    assert supervisor.mode is (Mode.FAULT if latches else Mode.STOP)
    assert (supervisor.reason, supervisor.detail) == (Reason.ENCODER_LOST, 2)


@pytest.mark.parametrize(("period_ms", "ticks"), [(5, 5), (1, 21), (10, 5)])
def test_an_echo_that_stays_is_found_after_ticks_and_time(period_ms: int, ticks: int) -> None:
    supervisor = supervisor_in(Mode.ACTIVE)
    supervisor._echo_counter = SimpleNamespace(value=lambda: 7)
    supervisor._check_echo(period_ms * MS)  # a new value
    for k in range(1, ticks + 1):
        assert supervisor.worst is Reason.NONE, k
        supervisor._check_echo(period_ms * MS)
    assert supervisor.worst is Reason.VALVE_ECHO_STUCK
    supervisor.worst = Reason.NONE
    supervisor._echo_counter = SimpleNamespace(value=lambda: 8)
    supervisor._check_echo(period_ms * MS)
    assert supervisor.worst is Reason.NONE


def test_a_harder_finding_replaces_a_milder_one_and_never_the_other_way_round() -> None:
    supervisor = supervisor_in(Mode.ACTIVE)
    for reason, detail, kept in (
        (Reason.NONE, 9, Reason.NONE),
        (Reason.PRESSURE_LOST, 1, Reason.PRESSURE_LOST),
        (Reason.BUS_PASSIVE, 2, Reason.PRESSURE_LOST),
        (Reason.PERSON_IN_ZONE, 3, Reason.PERSON_IN_ZONE),
        (Reason.ENCODER_LOST, 4, Reason.ENCODER_LOST),
        (Reason.PLC_FAULT, 5, Reason.ENCODER_LOST),
        (Reason.ESTOP_PRESSED, 6, Reason.ESTOP_PRESSED),
        (Reason.GUARD_LOST, 7, Reason.ESTOP_PRESSED),
    ):
        supervisor._collect(reason, detail)
        assert supervisor.worst is kept
    assert supervisor.worst_detail == 6


def test_the_reset_button_counts_at_its_edge_only() -> None:
    supervisor = supervisor_in(Mode.FAULT)
    seen = []
    for value in (None, 1, 1, 0, 1, 1, None, 1, 0, None, 1):
        supervisor._reset_button = SimpleNamespace(value=lambda value=value: value)
        seen.append(supervisor.reset_button_pressed())
    assert [k for k, pressed in enumerate(seen) if pressed] == [4, 10]
    assert set(seen) == {True, False}


@pytest.mark.parametrize("j", range(5))
def test_the_range_ends_with_its_margin(j: int) -> None:
    bench = Bench().boot()
    supervisor, spec = bench.controller.supervisor, SPECS[j]
    place = [axis for axis in supervisor._axes if axis[0] == j]
    (_, estimator, lower, upper) = place[0]
    assert (lower, upper) == (spec.lower - RANGE_MARGIN_UNITS, spec.upper + RANGE_MARGIN_UNITS)
    for position, found in ((lower, False), (lower - 1e-9, True), (upper, False), (upper + 1e-9, True)):
        estimator.position = position
        supervisor.worst = Reason.NONE
        supervisor._check_values(bench.now_ns)
        assert (supervisor.worst is Reason.POSITION_OUTSIDE) is found, (position, supervisor.worst)
        assert not found or supervisor.worst_detail == j


def test_a_second_arm_is_no_refusal() -> None:
    bench = Bench().armed()
    refused = bench.controller.gate.refused
    assert bench.press(OperatorAction.ARM) is Mode.ARMED and bench.controller.gate.refused == refused


def test_arm_in_the_tick_in_which_the_emergency_stop_opens_is_refused() -> None:
    bench = Bench().boot()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    bench.run(bench.count % 2)  # the frame is due in the next tick
    bench.press(OperatorAction.ARM)
    assert bench.controller.gate.refusal is Reason.ESTOP_NOT_RELEASED and bench.mode is Mode.FAULT


def test_a_reset_claims_a_lost_address_again() -> None:
    bench = Bench(AORO).boot()
    claim = MACHINE.message("AddressClaim")
    bench.machine_extra.append((claim.key, bytes(8)))  # the name 0 wins against every other
    bench.run(2)
    address = bench.controller.carrier_bus.inputs.address
    assert address.lost
    bench.press(OperatorAction.ARM)
    assert bench.controller.gate.refusal is Reason.ADDRESS_LOST
    bench.press(OperatorAction.RESET)
    assert not address.lost


def test_a_new_supervisor_has_found_nothing() -> None:
    new = Bench().controller.supervisor
    assert (new.mode, new.reason, new.worst) == (Mode.BOOT, Reason.NONE, Reason.NONE)
    assert (new.detail, new.worst_detail, new.late, new.coast_ns) == (0, 0, 0, 0)
    assert (new.ramp_ns, new.ramp_end_ns, new._slow_end_ns, new._degraded_until_ns) == (0, 0, 0, 0)
    assert (new._echo, new._echo_ticks, new.moving_joint) == (None, 0, NO_JOINT)
    assert not any((new.half_speed, new.latching, new.ramping, new.armed)) and new._reset_pressed


@pytest.mark.parametrize(
    ("mode", "ramp_ns", "answer"),
    [
        (Mode.ARMED, 0, Reason.NONE),
        (Mode.ACTIVE, 0, Reason.NONE),
        (Mode.FAULT, 0, Reason.FAULT_LATCHED),
        (Mode.STOP, 1, Reason.STILL_STOPPING),
    ],
)
def test_the_answer_to_an_arm_has_no_detail(mode: Mode, ramp_ns: int, answer: Reason) -> None:
    supervisor = supervisor_in(mode)
    supervisor.ramp_ns = ramp_ns
    assert supervisor.request_arm(NOW) == (answer, 0)


def test_arming_forgets_the_echo_and_the_detail_of_the_time_before() -> None:
    bench = Bench().boot()
    supervisor = bench.controller.supervisor
    supervisor._echo_ticks, supervisor.detail = 3, 9
    assert supervisor.request_arm(bench.now_ns) == (Reason.NONE, 0) and supervisor.mode is Mode.ARMED
    assert (supervisor._echo_ticks, supervisor.reason, supervisor.detail) == (0, Reason.NONE, 0)


@pytest.mark.parametrize(("mode", "ramp"), [(Mode.ARMED, False), (Mode.ACTIVE, True)])
def test_only_a_stop_of_a_moving_machine_has_a_ramp(mode: Mode, ramp: bool) -> None:
    supervisor = supervisor_in(mode)
    assert supervisor.apply(Event.HOLD, Reason.OPERATOR_STOP, 0, NOW) and supervisor.mode is Mode.STOP
    assert supervisor.ramping is ramp


# -- what is left beside its decisions: details of reasons, findings of a tick, the ends of a ramp

STALE = 7
"""A detail of the time before."""


def test_the_numbers_of_events_are_those_of_recordings_and_no_joint_is_none() -> None:
    assert [event.value for event in Event] == list(range(10))
    assert NO_JOINT == -1


def test_a_link_that_nobody_watches_is_lost_at_no_time_a_register_can_hold() -> None:
    link = supervisor_in(Mode.BOOT).operator_link
    assert (link.stamp_ns, link.lost_from_ns) == (0, 1 << 61)


@pytest.mark.parametrize(
    ("mode", "request_name", "after"),
    [(Mode.FAULT, "request_reset", Mode.BOOT), (Mode.ARMED, "request_disarm", Mode.STANDBY)],
)
def test_what_a_person_asked_for_has_no_detail(mode: Mode, request_name: str, after: Mode) -> None:
    supervisor = supervisor_in(mode, STALE)
    getattr(supervisor, request_name)(NOW)
    assert (supervisor.mode, supervisor.detail) == (after, 0)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"dropped": {"EncTilt"}}, Reason.INPUT_MISSING),
        ({"changed": {"GuardStat": {"Enable": 0}}}, Reason.GUARD_NOT_READY),
        ({"changed": {"ValveFbA": {"State": 4}}}, Reason.VALVE_NODE_NOT_READY),
        ({"changed": {"EstopStat": {"ChannelA": 0, "ChannelB": 0}}}, Reason.ESTOP_NOT_RELEASED),
    ],
)
def test_what_prevents_arming_without_a_part_of_its_own_has_no_detail(fault, reason: Reason) -> None:
    bench = Bench().boot()
    for name, value in fault.items():
        getattr(bench, name).update(value)
    bench.run(60)
    assert bench.controller.supervisor.arming_blocker(bench.now_ns) == (reason, 0)


def test_what_an_earlier_check_found_does_not_prevent_arming() -> None:
    bench = Bench().boot()
    supervisor = bench.controller.supervisor
    supervisor.worst, supervisor.worst_detail = Reason.ENCODER_LOST, 3
    assert supervisor.arming_blocker(bench.now_ns) == (Reason.NONE, 0)
    assert (supervisor.worst, supervisor.worst_detail) == (Reason.NONE, 0)


def test_a_good_tick_forgets_the_finding_of_the_one_before() -> None:
    bench = Bench().active()
    supervisor = bench.controller.supervisor
    supervisor.worst, supervisor.worst_detail = Reason.NONE, 3
    bench.tick([bench.hold()])
    assert (supervisor.worst, supervisor.worst_detail) == (Reason.NONE, 0)


@pytest.mark.parametrize("mode", [Mode.ARMED, Mode.ACTIVE])
def test_a_foreign_controller_on_the_crane_bus_is_number_0(mode: Mode) -> None:
    supervisor = supervisor_in(mode, STALE)
    supervisor.crane_inputs.foreign = True
    supervisor.supervise(0, T, NOW)
    assert (supervisor.reason, supervisor.detail) == (Reason.FOREIGN_CONTROLLER, 0)


def test_a_finding_without_a_part_has_the_detail_0() -> None:
    bench = Bench().armed()
    bench.changed["EstopStat"] = {"Person": 1}
    bench.run(4)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.PERSON_IN_ZONE, 0)


@pytest.mark.parametrize("lost", ["PlcStatus", "PlcOut"])
def test_either_message_of_a_plc_is_its_loss(lost: str) -> None:
    bench = Bench(behind_plc("references")).armed()
    bench.dropped.add(lost)
    assert bench.run(30) is Mode.FAULT and bench.reason is Reason.PLC_LOST


def test_a_pilot_supply_that_is_off_is_a_fault_of_a_moving_machine_only() -> None:
    bench = Bench().armed()
    bench.changed["ValveFbA"] = {"State": 3}
    assert bench.run(20) is Mode.ARMED
    bench = Bench().active()
    bench.changed["ValveFbA"] = {"State": 3}
    bench.run(20)
    assert bench.reason is Reason.VALVE_NODE_FAULT


@pytest.mark.parametrize(
    ("mode", "event", "reason"),
    [
        (Mode.ARMED, Event.HOLD, Reason.OPERATOR_STOP),
        (Mode.ACTIVE, Event.CUT, Reason.ESTOP_PRESSED),
        (Mode.ACTIVE, Event.DONE, Reason.NONE),
    ],
)
def test_no_ramp_is_left_where_there_is_none(mode: Mode, event: Event, reason: Reason) -> None:
    supervisor = supervisor_in(mode)
    supervisor.ramp_ns = 5
    assert supervisor.apply(event, reason, 0, NOW)
    assert supervisor.ramp_ns == 0


def test_a_hand_lever_ends_the_motion_at_once_and_the_end_of_a_ramp_leaves_none() -> None:
    supervisor = supervisor_in(Mode.ACTIVE)
    supervisor.apply(Event.HOLD, Reason.LEVER_MOVED, 0, NOW)
    assert supervisor.ramp_end_ns == NOW
    supervisor.supervise(0, T, NOW)
    assert supervisor.ramp_ns == 0 and not supervisor.ramping
