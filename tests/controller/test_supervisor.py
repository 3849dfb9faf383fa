"""The mode table, exhaustively, and the operator's way through it."""

import pytest

from can_dbc.messages.crane import ModeSwitch, OperatorAction
from controller.requests import RequestGate
from controller.transitions import TRANSITIONS, Event
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason
from tests.controller.bench import MS, OTHER_CHECK, SETTINGS, Bench

B, S, A, X, P, F = Mode.BOOT, Mode.STANDBY, Mode.ARMED, Mode.ACTIVE, Mode.STOP, Mode.FAULT
#                 BOOT STANDBY ARMED ACTIVE STOP FAULT
TABLE = {
    Event.BOOTED: (S, S, A, X, P, F),
    Event.ARM: (B, A, A, X, A, F),
    Event.DISARM: (B, S, S, P, S, F),
    Event.RESET: (B, S, A, X, S, B),
    Event.SETPOINT: (B, S, X, X, P, F),
    Event.DONE: (B, S, A, A, P, F),
    Event.HOLD: (B, P, P, P, P, F),
    Event.RAMP: (B, S, F, P, F, F),
    Event.CUT: (F, F, F, F, F, F),
    Event.LATCHED: (B, S, A, X, F, F),
}


@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("mode", Mode)
def test_every_mode_and_event(mode, event):
    assert TRANSITIONS.get((mode, event), mode) is TABLE[event][mode]
    bench = Bench()
    bench.controller.supervisor.mode = mode
    changed = bench.controller.supervisor.apply(event, Reason.LEASE_LOST, 0, 10**9)
    assert bench.mode is TABLE[event][mode]
    assert changed is (TABLE[event][mode] is not mode)


def test_boot_to_active_and_back():
    bench = Bench().armed()
    assert bench.neutral and bench.commands_b["ArmKey"] == 0xA
    bench.tick([bench.hold(final=True)])
    assert bench.mode is Mode.ACTIVE
    assert bench.run(38) is Mode.ACTIVE
    assert bench.run(2) is Mode.ARMED and bench.reason == Reason.NONE


def test_stop_from_every_mode():
    for prepare in (Bench.boot, Bench.armed, Bench.active):
        bench = prepare(Bench())
        assert bench.press(OperatorAction.STOP) is Mode.STOP and bench.reason == Reason.OPERATOR_STOP
        bench.run(31)
        assert bench.neutral and bench.commands_b["ArmKey"] == 0
        assert bench.run(300) is Mode.STOP


def test_stop_is_accepted_with_a_wrong_profile_and_an_old_stamp():
    bench = Bench().active()
    assert bench.press(OperatorAction.STOP, profile_hash=1, stamp_ns=5, sequence=0) is Mode.STOP


def test_stop_ramps_monotonically_to_neutral_within_150_ms():
    bench = Bench().active(speed=0.12)
    before = abs(bench.commands_a["Slew"])
    assert before > 12.0
    bench.press(OperatorAction.STOP)
    seen = [before, abs(bench.commands_a["Slew"])]
    for _ in range(30):
        bench.tick()
        seen.append(abs(bench.commands_a["Slew"]))
    assert seen == sorted(seen, reverse=True) and seen[10] > 12.0
    assert bench.neutral


def test_setpoints_after_a_stop_do_not_start_it_again():
    bench = Bench().active()
    bench.press(OperatorAction.STOP)
    for _ in range(100):
        bench.tick([bench.hold()])
        assert bench.mode is Mode.STOP
    assert bench.controller.gate.refusal is Reason.NOT_ARMED
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_arm_is_refused_while_still_stopping_and_in_fault():
    bench = Bench().active()
    bench.press(OperatorAction.STOP)
    bench.press(OperatorAction.ARM)
    assert bench.controller.gate.refusal is Reason.STILL_STOPPING
    bench.press(OperatorAction.DISARM)
    assert bench.press(OperatorAction.RESET) is Mode.STOP and bench.controller.supervisor.ramping
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    assert bench.run(3) is Mode.FAULT and bench.reason == Reason.ESTOP_PRESSED
    del bench.changed["EstopStat"]
    bench.run(10)
    assert bench.press(OperatorAction.ARM) is Mode.FAULT and bench.controller.gate.refusal is Reason.FAULT_LATCHED


def test_reset_button_is_an_edge_and_arming_needs_the_operator_as_well():
    bench = Bench().active()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0, "ResetReq": 1}
    bench.run(10)
    bench.changed["EstopStat"] = {"ResetReq": 1}
    assert bench.run(20) is Mode.FAULT, "a button that was already down is no edge"
    bench.changed["EstopStat"] = {"ResetReq": 0}
    bench.run(4)
    bench.changed["EstopStat"] = {"ResetReq": 1}
    assert bench.run(4) is Mode.STANDBY
    assert bench.run(200) is Mode.STANDBY
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_reset_with_the_emergency_stop_still_pressed_stays_in_fault():
    bench = Bench().armed()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    bench.run(3)
    assert bench.press(OperatorAction.RESET) is Mode.FAULT


def test_disarm():
    bench = Bench().armed()
    assert bench.press(OperatorAction.DISARM) is Mode.STANDBY and bench.commands_b["ArmKey"] == 0
    bench = Bench().active()
    assert bench.press(OperatorAction.DISARM) is Mode.STOP and bench.reason == Reason.OPERATOR_DISARM


ARMING = [
    ("EstopStat dropped", {"dropped": {"EstopStat"}}, Reason.INPUT_MISSING),
    ("encoder dropped", {"dropped": {"EncTilt"}}, Reason.INPUT_MISSING),
    ("valve feedback dropped", {"dropped": {"ValveFbB"}}, Reason.INPUT_MISSING),
    ("guard dropped", {"dropped": {"GuardStat"}}, Reason.INPUT_MISSING),
    ("PLC dropped", {"dropped": {"PlcStatus"}}, Reason.INPUT_MISSING),
    ("guard disables", {"changed": {"GuardStat": {"Enable": 0}}}, Reason.GUARD_NOT_READY),
    ("guard nearly enables", {"changed": {"GuardStat": {"Enable": 0xB}}}, Reason.GUARD_NOT_READY),
    ("valve fault", {"changed": {"ValveFbA": {"State": 4}}}, Reason.VALVE_NODE_NOT_READY),
    ("PLC fault", {"changed": {"PlcStatus": {"FaultBits": 2}}}, Reason.PLC_FAULT),
    ("person", {"changed": {"EstopStat": {"Person": 1}}}, Reason.PERSON_IN_ZONE),
    ("failed detector of persons", {"changed": {"EstopStat": {"Person": 2}}}, Reason.PERSON_IN_ZONE),
    ("hand lever", {"changed": {"EstopStat": {"Lever": 1}}}, Reason.LEVER_MOVED),
    ("hand lever's switch", {"changed": {"EstopStat": {"Lever": 2}}}, Reason.LEVER_MOVED),
    ("valve node silent", {"silent_nodes": {0x10}}, Reason.NODE_NOT_OPERATIONAL),
    ("guard node silent", {"silent_nodes": {0x7D}}, Reason.NODE_NOT_OPERATIONAL),
    ("encoder alarm", {"changed": {"EncLift": {"Alarms": 1}}}, Reason.ENCODER_ALARM),
    ("telescope alarm", {"changed": {"EncExt": {"SystemReg": 1}}}, Reason.ENCODER_ALARM),
]


@pytest.mark.parametrize(("what", "fault", "reason"), ARMING, ids=[a[0] for a in ARMING])
def test_arming_is_refused(what, fault, reason):
    bench = Bench().boot()
    for name, value in fault.items():
        getattr(bench, name).update(value)
    assert bench.run(60) is Mode.STANDBY
    assert bench.press(OperatorAction.ARM) is Mode.STANDBY
    assert bench.controller.gate.refusal is reason
    for name, value in fault.items():
        for key in value:
            getattr(bench, name).pop(key) if name == "changed" else getattr(bench, name).discard(key)
    bench.run(60)
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


@pytest.mark.parametrize("value", [1, 2])
def test_a_moved_hand_lever_ends_automatic_work_at_once_and_for_good(value):
    """The person wins: no ramp, and no work after the lever is back."""
    bench = Bench().active()
    assert not bench.neutral
    bench.changed["EstopStat"] = {"Lever": value}
    assert bench.run(2) is Mode.STOP and bench.reason == Reason.LEVER_MOVED, "within the period of EstopStat"
    assert bench.neutral and bench.commands_b["ArmKey"] == 0 and not bench.controller.supervisor.ramping
    del bench.changed["EstopStat"]
    for _ in range(40):
        bench.tick([bench.hold()])
        assert bench.mode is Mode.STOP and bench.neutral
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_a_moved_hand_lever_disarms_a_machine_that_stands():
    bench = Bench().armed()
    bench.changed["EstopStat"] = {"Lever": 1}
    assert bench.run(2) is Mode.STOP and bench.reason == Reason.LEVER_MOVED


@pytest.mark.parametrize("value", [0, None])
def test_a_machine_that_does_not_tell_about_its_levers_works_as_before(value):
    bench = Bench()
    bench.changed["EstopStat"] = {"Lever": value}
    bench.active()
    assert bench.run(10) is Mode.ACTIVE and bench.reason == Reason.NONE


def test_the_mode_switch_is_reported_and_stops_nothing():
    bench = Bench().active()
    assert bench.reports[-1].mode_switch == ModeSwitch.NOT_FITTED
    for position in (ModeSwitch.AUTO, ModeSwitch.IDLE, ModeSwitch.FAULTY):
        bench.changed["EstopStat"] = {"ModeSwitch": position}
        bench.drive(0, 0.08, 10)
        assert bench.reports[-1].mode_switch == position
        assert bench.mode is Mode.ACTIVE and bench.reason == Reason.NONE and not bench.neutral
    bench.dropped.add("EstopStat")
    bench.run(20)
    assert bench.reports[-1].mode_switch == ModeSwitch.NOT_FITTED, "it is not known"


def test_an_emergency_stop_in_error_is_a_fault_before_anybody_arms():
    bench = Bench().boot()
    bench.changed["EstopStat"] = {"ChannelA": 2}
    assert bench.run(3) is Mode.FAULT and bench.reason == Reason.ESTOP_CHANNELS


def test_arming_outside_the_range_is_refused():
    bench = Bench(home=(0.0, 1.40, -1.2, 0.6, 0.0))
    assert bench.run(400) is Mode.STANDBY and bench.reason == Reason.POSITION_OUTSIDE
    assert bench.press(OperatorAction.ARM) is Mode.STANDBY and bench.controller.gate.refusal is Reason.POSITION_OUTSIDE


def test_operator_commands_are_refused_replayed_old_or_for_another_profile():
    bench = Bench().boot()
    arm = bench.operator(OperatorAction.ARM)
    bench.tick([arm])
    bench.press(OperatorAction.STOP)
    bench.tick([arm])
    assert bench.mode is Mode.STOP and bench.controller.gate.refusal is Reason.OUT_OF_ORDER
    assert bench.press(OperatorAction.DISARM) is Mode.STANDBY
    for data, reason in (
        (arm, Reason.OUT_OF_ORDER),
        (bench.operator(OperatorAction.ARM, profile_hash=3), Reason.WRONG_PROFILE),
        (bench.operator(OperatorAction.ARM, profile_check=OTHER_CHECK), Reason.WRONG_PROFILE),
        (bench.operator(OperatorAction.ARM, stamp_ns=bench.now_ns + 100 * MS), Reason.STAMP_FUTURE),
    ):
        bench.tick([data])
        assert bench.mode is Mode.STANDBY and bench.controller.gate.refusal is reason
    late = bench.operator(OperatorAction.ARM)
    bench.run(202)
    bench.tick([late])
    assert bench.mode is Mode.STANDBY and bench.controller.gate.refusal is Reason.STAMP_OLD


def test_an_arm_for_the_file_of_the_controllers_profile_arms_and_what_enables_nothing_is_heard_for_any():
    bench = Bench().boot()
    assert bench.press(OperatorAction.ARM, profile_check=SETTINGS.file_check) is Mode.ARMED
    assert bench.press(OperatorAction.DISARM, profile_check=OTHER_CHECK) is Mode.STANDBY
    without_a_file = RequestGate(SETTINGS.profile, SETTINGS.profile_hash)
    arm = bench.operator(OperatorAction.ARM, profile_check=OTHER_CHECK)
    assert without_a_file.accept(arm, bench.now_ns, 0, operator=True) is OperatorAction.ARM


def test_neutral_in_every_mode_but_active_and_the_ramp():
    bench = Bench().boot()
    assert bench.neutral and bench.commands_b["ArmKey"] == 0 and bench.commands_b["PumpReq"] == 0
    bench = Bench().active()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    assert bench.run(3) is Mode.FAULT and bench.neutral
    assert bench.commands_b["ArmKey"] == 0 and bench.commands_b["PumpReq"] == 0


def test_every_reason_is_described():
    assert set(FAULTS) == set(Reason)
    assert all(fault.sentence and fault.advice for fault in FAULTS.values())
    on_request = (Reason.OPERATOR_STOP, Reason.OPERATOR_DISARM)
    assert all(
        fault.bound_ms > 0
        for reason, fault in FAULTS.items()
        if fault.reaction > Reaction.DEGRADE and reason not in on_request
    )


def test_a_guard_with_another_profile_is_not_armed_with():
    bench = Bench().boot()
    bench.changed["GuardStat"] = {"Enable": 0xA, "ProfileCheck": OTHER_CHECK}
    bench.run(10)
    assert bench.press(OperatorAction.ARM) is Mode.STANDBY
    assert bench.controller.gate.refusal is Reason.PROFILE_DIFFERS
    for check in (SETTINGS.file_check, 0):
        bench = Bench().boot()
        bench.changed["GuardStat"] = {"Enable": 0xA, "ProfileCheck": check}
        assert bench.armed().mode is Mode.ARMED
