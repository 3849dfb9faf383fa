"""What the supervisor leaves beside its decisions: details of reasons, findings of a tick, the ends of a ramp."""

from __future__ import annotations

import msgspec
import pytest

from controller.config import Settings
from controller.supervisor import NO_JOINT
from controller.transitions import Event
from machine.loading.profile_file import profile_hash
from machine.profile import Plc, Profile
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import PROFILE, Bench, T

NOW = 100 * 10**9
STALE = 7
"""A detail of the time before."""


def supervisor_in(mode: Mode, profile: Profile = PROFILE):
    made = Bench(Settings(profile, profile_hash(profile), profile.rate_hz)).controller.supervisor
    made.mode, made.detail, made.worst_detail = mode, STALE, STALE
    return made


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
    supervisor = supervisor_in(mode)
    getattr(supervisor, request_name)(NOW)
    assert (supervisor.mode, supervisor.detail) == (after, 0)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"dropped": {"EncTilt"}}, Reason.INPUT_MISSING),
        ({"changed": {"GuardStat": {"Enable": 0}}}, Reason.GUARD_NOT_READY),
        ({"changed": {"ValveFbA": {"State": 4}}}, Reason.VALVE_NODE_NOT_READY),
    ],
)
def test_what_prevents_arming_without_a_part_of_its_own_has_no_detail(fault, reason: Reason) -> None:
    bench = Bench().boot()
    for name, value in fault.items():
        getattr(bench, name).update(value)
    bench.run(60)
    assert bench.controller.supervisor.arming_blocker(bench.now_ns) == (reason, 0)


def test_an_emergency_stop_that_is_not_released_has_no_detail() -> None:
    bench = Bench().boot()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    bench.run(4)
    assert bench.controller.supervisor.arming_blocker(bench.now_ns) == (Reason.ESTOP_NOT_RELEASED, 0)


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
    supervisor = supervisor_in(mode)
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
    profile = msgspec.structs.replace(PROFILE, plc=Plc("references"))
    bench = Bench(Settings(profile, profile_hash(profile), profile.rate_hz)).armed()
    bench.dropped.add(lost)
    bench.run(30)
    assert bench.mode is Mode.FAULT and bench.reason is Reason.PLC_LOST


def test_a_pilot_supply_that_is_off_is_a_fault_of_a_moving_machine_only() -> None:
    bench = Bench().armed()
    bench.changed["ValveFbA"] = {"State": 3}
    bench.run(20)
    assert bench.mode is Mode.ARMED
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
