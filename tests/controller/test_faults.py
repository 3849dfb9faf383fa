"""Loss and fault of every input: reaction, detection time and neutral commands in time, in virtual time."""

import pytest

from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.canopen import Emergency, emergency_frame, heartbeat_frame
from machine.joints import Joint
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason
from tests.controller.bench import MS, OTHER_CHECK, Bench, T, count_until

PROMISE_NS = 100 * MS


def ticks_to_neutral(bench: Bench, limit: int = 100) -> int:
    for k in range(limit):
        if bench.neutral:
            return k
        bench.tick()
    raise AssertionError("not neutral")


LOSSES = [
    ("EstopStat", Reason.ESTOP_LOST),
    ("GuardStat", Reason.GUARD_LOST),
    ("EncSlew", Reason.ENCODER_LOST),
    ("EncLift", Reason.ENCODER_LOST),
    ("EncTilt", Reason.ENCODER_LOST),
    ("EncExt", Reason.ENCODER_LOST),
    ("EncRot", Reason.ENCODER_LOST),
    ("ValveFbA", Reason.VALVE_FEEDBACK_LOST),
    ("ValveFbB", Reason.VALVE_FEEDBACK_LOST),
    ("PlcStatus", Reason.PLC_LOST),
]
CASES = [
    (name, Reason.ENCODER_FROZEN if name.startswith("Enc") and how == "frozen" else reason, how)
    for name, reason in LOSSES
    for how in ("dropped", "corrupt", "frozen")
    # An encoder frame has no checksum, and the linear one no time stamp that could stand still.
    if not (name.startswith("Enc") and how == "corrupt") and (name, how) != ("EncExt", "frozen")
]


@pytest.mark.parametrize(("name", "reason", "how"), CASES)
def test_loss_of_each_needed_input_is_neutral_in_time(name, reason, how):
    bench = Bench().active()
    getattr(bench, how).add(name)
    ticks = bench.until(reason)
    assert ticks * T <= FAULTS[reason].bound_ms * MS + T
    ticks += ticks_to_neutral(bench)
    assert ticks * T <= PROMISE_NS
    assert bench.run(20) is Mode.FAULT and bench.neutral and bench.commands_b["ArmKey"] == 0
    getattr(bench, how).clear()
    assert bench.run(400) is Mode.FAULT, "a fault stays until a human resets it"


@pytest.mark.parametrize("name", ["PressA", "PressB", "PressC", "GrappleStat"])
def test_loss_of_an_optional_input_halves_the_speed(name):
    bench = Bench().active()
    bench.dropped.add(name)
    reason = Reason.GRAPPLE_STATUS_LOST if name == "GrappleStat" else Reason.PRESSURE_LOST
    assert bench.until(reason) * T <= FAULTS[reason].bound_ms * MS
    assert bench.mode is Mode.ACTIVE and bench.controller.supervisor.half_speed
    bench.dropped.clear()
    bench.drive(0, 0.08, 230)
    assert not bench.controller.supervisor.half_speed and bench.reason == Reason.NONE


def test_one_lost_frame_and_one_bad_checksum_do_not_trip():
    bench = Bench().active()
    for name in ("EncSlew", "ValveFbA", "EstopStat"):
        for what in (bench.dropped, bench.corrupt):
            what.add(name)
            bench.tick([bench.moving(0, 0.08)])
            what.clear()
            assert bench.drive(0, 0.08, 8) is Mode.ACTIVE


VALUES = [
    ("EstopStat", {"ChannelA": 0, "ChannelB": 0}, Reason.ESTOP_PRESSED),
    ("EstopStat", {"ChannelA": 0}, Reason.ESTOP_PRESSED),
    ("EstopStat", {"ChannelB": 2}, Reason.ESTOP_CHANNELS),
    ("EstopStat", {"ChannelB": 3}, Reason.ESTOP_CHANNELS),
    ("EstopStat", {"Person": 1}, Reason.PERSON_IN_ZONE),
    ("GuardStat", {"Enable": 0}, Reason.GUARD_REFUSES),
    ("GuardStat", {"Enable": 0xA, "ProfileCheck": OTHER_CHECK}, Reason.PROFILE_DIFFERS),
    ("ValveFbA", {"State": 4}, Reason.VALVE_NODE_FAULT),
    ("ValveFbA", {"State": None}, Reason.VALVE_NODE_FAULT),
    ("ValveFbA", {"State": 3}, Reason.VALVE_NODE_FAULT),
    ("ValveFbB", {"EchoCounter": 7}, Reason.VALVE_ECHO_STUCK),
    ("PlcStatus", {"FaultBits": 1}, Reason.PLC_FAULT),
    ("EncRot", {"Alarms": 4}, Reason.ENCODER_ALARM),
]


@pytest.mark.parametrize(("name", "values", "reason"), VALUES)
def test_bad_value_is_detected_in_time(name, values, reason):
    bench = Bench().active()
    bench.changed[name] = values
    assert bench.until(reason) * T <= FAULTS[reason].bound_ms * MS
    bench.run(32)
    assert bench.neutral
    latched = FAULTS[reason].reaction >= Reaction.RAMP
    assert bench.mode is (Mode.FAULT if latched else Mode.STOP)


def test_encoder_jump_single_is_refused_and_the_third_stops():
    bench = Bench().active()
    refused = bench.controller.estimators[Joint.SLEW].refused
    home = bench.q[0]
    for k in range(3):
        bench.q[0] = bench.q[0] + 0.2
        bench.tick()
        bench.q[0] -= 0.2
        assert bench.controller.estimators[0].refused == refused + k + 1
        if k == 0:
            assert bench.mode is Mode.ACTIVE
            assert abs(bench.controller.estimators[0].position - home) < 0.01
            bench.tick([bench.moving(0, 0.08)])
    bench.tick()
    assert bench.reason == Reason.ENCODER_JUMP and bench.mode is Mode.STOP


def test_position_outside_the_range_stops():
    bench = Bench(home=(0.0, 1.356, -1.2, 0.6, 0.0)).armed()
    for _ in range(100):
        bench.q[1] += 0.0001
        bench.tick()
    assert bench.mode is Mode.FAULT and bench.reason == Reason.POSITION_OUTSIDE
    assert bench.controller.supervisor.detail == Joint.LIFT


@pytest.mark.parametrize(
    ("node", "reason"),
    [
        (1, Reason.SAFETY_NODE_LOST),
        (0x10, Reason.SAFETY_NODE_LOST),
        (0x7D, Reason.SAFETY_NODE_LOST),
        (2, Reason.ENCODER_NODE_LOST),
        (6, Reason.ENCODER_NODE_LOST),
        (0x20, Reason.PRESSURE_NODE_LOST),
    ],
)
def test_heartbeat_lost(node, reason):
    bench = Bench().active()
    bench.silent_nodes.add(node)
    while bench.count % 20 != 1:
        bench.tick([bench.moving(0, 0.08)])
    assert bench.until(reason) * T <= FAULTS[reason].bound_ms * MS
    assert bench.controller.supervisor.detail == node


@pytest.mark.parametrize("state", [0x00, 0x04, 0x7F])
@pytest.mark.parametrize("node", [1, 0x10, 3])
def test_restart_or_leaving_operational(node, state):
    bench = Bench().active()
    bench.extra.append(heartbeat_frame(node, state))
    bench.tick()
    assert bench.reason == Reason.NODE_RESTARTED and bench.mode is Mode.STOP
    assert bench.run(13) is Mode.FAULT


def test_restarted_encoder_is_set_up_again_before_arming():
    bench = Bench().active()
    bench.encoders[3].state = 0x7F
    bench.encoders[3].writes.clear()
    bench.extra.append(heartbeat_frame(3, 0))
    assert bench.run(100) is Mode.FAULT and bench.encoders[3].state == 0x05
    assert (0x1800, 2, 1) in bench.encoders[3].writes
    bench.press(OperatorAction.RESET)
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (0x5000, Reason.EMERGENCY_MESSAGE),
        (0x6100, Reason.EMERGENCY_MESSAGE),
        (0xFF01, Reason.EMERGENCY_MESSAGE),
        (0x4200, Reason.EMERGENCY_WARNING),
        (0x1000, Reason.EMERGENCY_WARNING),
    ],
)
def test_emergency_messages(code, reason):
    bench = Bench().active()
    bench.extra.append(emergency_frame(Emergency(4, code, 1, b"")))
    bench.tick()
    assert bench.reason == reason and bench.controller.supervisor.detail == 4
    bench.extra.append(emergency_frame(Emergency(4, 0, 0, b"")))
    bench.tick()
    assert not bench.controller.crane_inputs.nodes.by_number[4].emergency
    assert not bench.controller.crane_inputs.nodes.by_number[4].warning


def test_three_communication_emergencies_in_ten_seconds_stop():
    bench = Bench().active()
    for k in range(3):
        assert bench.mode is Mode.ACTIVE, k
        bench.extra.append(emergency_frame(Emergency(4, 0x8100, 1, b"")))
        bench.drive(0, 0.08, 10)
    assert bench.reason == Reason.EMERGENCY_MESSAGE


def test_three_refused_sends_in_a_row_stop_and_two_do_not():
    bench = Bench().active()
    for refused in (1, 2, 2, 3, 4):
        bench.tick(bus_refused=refused)
    assert bench.mode is Mode.ACTIVE
    bench.tick(bus_refused=5)
    assert bench.reason == Reason.SEND_REFUSED and bench.mode is Mode.STOP


def test_frames_of_an_overflowed_tick_are_not_used():
    bench = Bench().active()
    count = bench.controller.crane_inputs.count
    bench.tick([bench.moving(0, 0.08)], bus_dropped=3)
    assert bench.controller.crane_inputs.count == count
    bench.tick(bus_dropped=3)
    assert bench.controller.crane_inputs.count > count and bench.mode is Mode.ACTIVE


def test_late_loop_degrades_and_stalled_loop_stops():
    bench = Bench().active()
    bench.tick(late_ns=2 * T)
    assert bench.mode is Mode.ACTIVE and bench.reason == Reason.NONE, "two periods late is tolerated"
    bench.tick([bench.moving(0, 0.08)], late_ns=2 * T + 1)
    assert bench.mode is Mode.ACTIVE and bench.reason == Reason.LOOP_LATE
    bench.tick([bench.moving(0, 0.08)], late_ns=50 * MS + 1)
    assert bench.mode is Mode.STOP and bench.reason == Reason.LOOP_STALLED
    bench.run(31)
    assert bench.neutral


def test_second_fault_while_stopping_is_neutral_at_once():
    bench = Bench().active()
    bench.press(OperatorAction.STOP)
    bench.run(3)
    assert not bench.neutral
    bench.dropped.add("EncSlew")
    assert bench.run(4) is Mode.FAULT and bench.neutral


def test_lease_lost_while_moving_slows_down_and_stops():
    bench = Bench().active()
    bench.tick([bench.moving(0, 0.08, lease_ms=100)])
    k = count_until(bench.tick, lambda: bench.mode is Mode.STOP)
    assert bench.reason == Reason.LEASE_LOST and k * T <= 110 * MS
    bench.run(30)
    assert bench.neutral and bench.mode is Mode.STOP


def test_trajectory_that_ends_in_motion_ends_its_lease():
    bench = Bench().active()
    start = list(bench.controller.reference_position)
    speed = [0.08, 0.0, 0.0, 0.0, 0.0]
    bench.tick([bench.setpoint([(0, start, speed), (50, [start[0] + 0.004, *start[1:]], speed)])])
    assert bench.run(12) is Mode.STOP and bench.reason == Reason.LEASE_LOST


def test_three_refused_setpoints_in_a_second_stop():
    bench = Bench().active()
    for _ in range(2):
        bench.tick([b"rubbish"])
        assert bench.drive(0, 0.08, 20) is Mode.ACTIVE
    bench.tick([b"rubbish"])
    assert bench.mode is Mode.STOP and bench.reason == Reason.SETPOINTS_REFUSED


def test_refusals_before_a_motion_do_not_stop_it():
    bench = Bench().armed()
    bench.tick([b"rubbish"] * 5)
    bench.tick([bench.hold()])
    assert bench.drive(0, 0.08, 20) is Mode.ACTIVE


def test_stuck_joint_holds_within_400_ms():
    bench = Bench().active(speed=0.13)
    for _ in range(15):
        bench.drive(0, bench.controller.crane.governor.velocity[0] + 0.02, 10)
        if bench.controller.crane.governor.velocity[0] > 0.25:
            break
    bench.stuck.add(0)
    for k in range(1, 81):
        bench.tick([bench.moving(0, 0.28)] if k % 10 == 1 else ())
        if bench.mode is not Mode.ACTIVE:
            break
    assert bench.reason == Reason.JOINT_STUCK and bench.controller.supervisor.detail == Joint.SLEW
    assert k * T <= FAULTS[Reason.JOINT_STUCK].bound_ms * MS


def test_uncommanded_motion_cuts_within_150_ms():
    bench = Bench().armed()
    bench.tick([bench.hold()])
    bench.moves_alone[0] = 0.4
    k = count_until(bench.tick, lambda: bench.mode is Mode.FAULT)
    assert bench.reason == Reason.JOINT_RUNAWAY
    assert k * T <= FAULTS[Reason.JOINT_RUNAWAY].bound_ms * MS


def test_motion_against_the_command_stops():
    bench = Bench().armed()
    bench.backward.add(0)
    moving_ticks = 0
    for k in range(100):
        bench.tick([bench.moving(0, 0.13)] if k % 10 == 0 and bench.mode is not Mode.STOP else ())
        moving_ticks += bench.v[0] != 0.0
        if bench.mode is Mode.STOP:
            break
    assert bench.reason == Reason.JOINT_REVERSED and bench.controller.supervisor.detail == Joint.SLEW
    assert bench.run(13) is Mode.FAULT and bench.neutral and bench.reason == Reason.JOINT_REVERSED
    assert moving_ticks * T <= FAULTS[Reason.JOINT_REVERSED].bound_ms * MS


def test_final_setpoint_whose_lease_ends_too_early_stops():
    bench = Bench().armed()
    start = list(bench.controller.reference_position)
    end = [start[0] + 0.1, *start[1:]]
    bench.tick([bench.setpoint([(0, start, [0.0] * 5), (1500, end, [0.0] * 5)], final=True, lease_ms=200)])
    assert bench.run(62) is Mode.STOP and bench.reason == Reason.LEASE_LOST
