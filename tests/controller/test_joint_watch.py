"""Joints that move without a command in every mode, frozen and noisy encoders: reaction, bound, and who may go on."""

import random

import pytest

from can_dbc.messages.crane import GrappleCommand, OperatorAction
from controller.laws.grapple import GrappleLaw
from machine.joints import Joint
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, SPECS, Bench, T, behind_plc, count_until

SHARES = (0.03, 0.1, 0.25)
SLOW_MS = 600
JOINTS = [Joint.SLEW, Joint.LIFT, Joint.TILT, Joint.EXT, Joint.ROT]


def dithering(bench: Bench) -> Bench:
    """Live encoders: their counts flicker, a moving joint's too."""
    bench.dither = random.Random(1)
    return bench


def drifts(bench: Bench, j: int, share: float) -> None:
    bench.moves_alone[j] = share * SPECS[j].speed_limit


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("j", JOINTS)
def test_slow_motion_without_a_command_cuts_while_armed(j, share):
    bench = dithering(Bench()).armed()
    bench.run(500)
    drifts(bench, j, share)
    if j == Joint.ROT and share <= 0.25:  # as slowly as tongs that close about logs turn it
        assert bench.run(100) is Mode.ARMED
        return
    k = count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 200)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.JOINT_RUNAWAY, j)
    assert k * T <= (SLOW_MS if share < 0.25 else 150) * MS
    assert bench.neutral and bench.commands_b["ArmKey"] == 0


def test_jaws_that_press_move_a_joint_and_a_valve_that_stuck_open_moves_it_on(monkeypatch):
    """Measured on a forwarder: closing in a heap turned the slew by the way of 0.04 s at its limit."""
    monkeypatch.setattr(GrappleLaw, "presses", lambda law, now_ns: True)
    bench = dithering(Bench()).armed()
    bench.run(500)
    drifts(bench, Joint.SLEW, 0.1)
    assert bench.run(80) is Mode.ARMED
    assert count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 250) * T >= 500 * MS
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.JOINT_RUNAWAY, Joint.SLEW)


@pytest.mark.parametrize(("output_pct", "cut"), [(9.0, False), (0.0, True)])
def test_slow_motion_is_a_correction_where_a_plc_closes_the_loop_and_says_that_it_does_something(output_pct, cut):
    """Our own law rests then: its reference stands, and the joint is within its stop band."""
    bench = dithering(Bench(behind_plc("references"))).armed()
    bench.run(500)
    bench.plc_output[0] = output_pct / 100.0
    drifts(bench, 0, 0.03)
    bench.run(150)
    assert (bench.reason is Reason.JOINT_RUNAWAY) is cut


@pytest.mark.parametrize("share", [0.03, 0.5, 1.0])
def test_motion_in_stop_latches_and_cuts_whoever_causes_it(share):
    bench = dithering(Bench()).active()
    bench.press(OperatorAction.STOP)
    assert bench.run(600) is Mode.STOP
    drifts(bench, 0, share)
    k = count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 200)
    assert bench.reason == Reason.MOVES_WHILE_STOPPED and bench.controller.supervisor.detail == 0
    assert k * T <= FAULTS[Reason.MOVES_WHILE_STOPPED].bound_ms * MS


@pytest.mark.parametrize("end", [OperatorAction.STOP, OperatorAction.DISARM])
def test_a_joint_that_does_not_come_to_rest_after_the_end_latches(end):
    bench = dithering(Bench()).active()
    drifts(bench, 0, 0.3)
    bench.press(end)
    count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 300)
    assert bench.reason in (Reason.MOVES_WHILE_STOPPED, Reason.JOINT_RUNAWAY)


def test_a_fault_that_left_the_supply_on_is_raised_by_motion_that_goes_on():
    bench = dithering(Bench()).active()
    drifts(bench, 1, 0.2)
    bench.dropped.add("EncSlew")
    count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 60)
    assert FAULTS[Reason(bench.reason)].reaction < FAULTS[Reason.MOVES_WHILE_STOPPED].reaction
    count_until(bench.tick, lambda: bench.reason == Reason.MOVES_WHILE_STOPPED, 300)
    assert bench.controller.supervisor.detail == 1


@pytest.mark.parametrize("mode", [Mode.STANDBY, Mode.FAULT])
def test_hand_levers_are_not_punished_but_prevent_arming(mode):
    bench = dithering(Bench())
    if mode is Mode.FAULT:
        bench.active()
        bench.dropped.add("EncRot")
        bench.run(60)
        bench.dropped.clear()
    else:
        bench.boot()
    bench.run(600)
    before = bench.reason
    bench.moves_alone[2] = 0.3
    assert bench.run(200) is mode
    if mode is Mode.FAULT:
        assert bench.reason == before, "its cause stays to be read"
        bench.moves_alone.clear()
        bench.run(300)
        bench.press(OperatorAction.RESET)
        assert bench.run(10) is Mode.STANDBY
        return
    assert bench.reason == Reason.JOINT_MOVES and bench.controller.supervisor.detail == 2
    assert bench.press(OperatorAction.ARM) is Mode.STANDBY and bench.controller.gate.refusal is Reason.JOINT_MOVES
    bench.moves_alone.clear()
    bench.run(300)
    assert bench.reason == Reason.NONE
    bench.press(OperatorAction.ARM)
    assert bench.run(300) is Mode.ARMED, "what the lever did before does not count"


def test_reset_while_it_still_moves_latches_again_and_afterwards_frees():
    bench = dithering(Bench()).active()
    bench.press(OperatorAction.STOP)
    bench.run(400)
    drifts(bench, 0, 0.2)
    count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 200)
    bench.press(OperatorAction.RESET)
    count_until(bench.tick, lambda: bench.mode is Mode.FAULT, 400)
    assert bench.reason == Reason.MOVES_WHILE_STOPPED
    bench.moves_alone.clear()
    bench.run(200)
    bench.press(OperatorAction.RESET)
    assert bench.run(600) is Mode.STANDBY
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def move(bench: Bench, j: int, share: float, ticks: int, until=lambda: False) -> int:
    """The planner moves one joint; ticks until the condition holds or the mode is left."""
    for k in range(1, ticks + 1):
        v = bench.controller.crane.governor.velocity[j]
        wanted = share * SPECS[j].speed_limit
        v += max(-0.02, min(0.02, wanted - v))
        bench.tick([bench.moving(j, v)] if k % 10 == 1 and bench.mode in (Mode.ARMED, Mode.ACTIVE) else ())
        if until() or bench.mode is Mode.STOP:
            return k
    return ticks


@pytest.mark.parametrize("j", [Joint.SLEW, Joint.EXT])
def test_an_encoder_that_stands_still_to_the_count_is_frozen_and_not_a_stuck_valve(j):
    bench = dithering(Bench()).armed()
    move(bench, j, 0.4, 100)
    assert bench.mode is Mode.ACTIVE
    bench.frozen_counts.add(j)
    k = move(bench, j, 0.4, 200)
    assert (bench.reason, bench.controller.supervisor.detail) == (Reason.ENCODER_FROZEN, j)
    assert k * T <= FAULTS[Reason.ENCODER_FROZEN].bound_ms * MS


def test_behind_a_plc_the_same_count_is_no_evidence():
    bench = dithering(Bench(behind_plc("valves"))).armed()
    move(bench, 0, 0.4, 100)
    bench.frozen_counts.add(0)
    move(bench, 0, 0.4, 400)
    assert bench.reason == Reason.JOINT_STUCK


def test_a_stuck_valve_under_a_live_encoder_stays_a_stuck_valve():
    bench = dithering(Bench()).armed()
    move(bench, 0, 0.7, 150)
    bench.stuck.add(0)
    move(bench, 0, 0.7, 200)
    assert bench.reason == Reason.JOINT_STUCK


@pytest.mark.parametrize("name", ["EncSlew", "EncTilt"])
def test_a_time_stamp_that_stands_still_is_a_frozen_encoder_and_no_cut_cable(name):
    bench = Bench().active()
    bench.frozen.add(name)
    k = count_until(bench.tick, lambda: bench.mode is Mode.STOP)
    assert bench.reason == Reason.ENCODER_FROZEN and k * T <= 20 * MS + T


def test_one_repeated_frame_is_no_frozen_encoder():
    bench = Bench().active()
    for _ in range(5):
        bench.frozen.add("EncSlew")
        bench.tick()
        bench.frozen.clear()
        assert bench.drive(0, 0.08, 10) is Mode.ACTIVE


def test_an_encoder_at_rest_may_give_the_same_count_for_ever():
    bench = Bench().armed()
    assert bench.keep(1000) is Mode.ACTIVE and bench.reason == Reason.NONE


def test_ten_times_the_noise_halves_the_speed_in_time():
    bench = dithering(Bench()).active()
    bench.noise_factor[2] = 10.0
    assert bench.until(Reason.ENCODER_NOISY) * T <= FAULTS[Reason.ENCODER_NOISY].bound_ms * MS
    assert bench.controller.supervisor.half_speed and bench.controller.supervisor.detail == 2


@pytest.mark.parametrize("changes", [False, True])
def test_a_drift_is_not_judged_while_a_load_comes_and_goes(changes):
    """Each change moves the joint, and the law answers it by the pulses that tell a drift."""
    bench = dithering(Bench()).armed()
    hold(bench, 400)
    bench.encoder_drift[Joint.SLEW] = 0.00873
    for k in range(14):
        bench.changed["GrappleStat"] = {"Load": 120.0 if changes and k % 2 else 20.0}
        hold(bench, 50)
    assert (bench.reason in (Reason.ENCODER_DRIFT, Reason.JOINT_RUNAWAY)) is not changes


@pytest.mark.parametrize(
    ("load_kg_s", "share", "told"),
    [(-210.0, 0.012, False), (0.0, 0.012, True), (-210.0, 0.1, True)],
    ids=["logs come to rest", "a load hangs", "a valve is open"],
)
def test_a_shut_lift_sinks_with_a_load_that_comes_to_rest(load_kg_s, share, told):
    """Measured on a sampled forwarder: 784 to 165 kg within 3 s sank the lift by 5 mrad."""
    bench = dithering(Bench()).armed()
    bench.changed["GrappleStat"] = {"Load": 784.0}
    bench.run(1400)
    drifts(bench, Joint.LIFT, -share)
    for k in range(600):
        bench.changed["GrappleStat"] = {"Load": max(0.0, 784.0 + load_kg_s * k * T * 1e-9)}
        bench.tick()
    assert ((bench.reason, bench.controller.supervisor.detail) == (Reason.JOINT_RUNAWAY, Joint.LIFT)) is told


@pytest.mark.parametrize("j", [Joint.SLEW, Joint.TILT])
def test_a_drifting_encoder_holds_although_the_law_follows_it(j):
    """Half a degree per second, while the crane holds its place."""
    bench = dithering(Bench()).armed()
    hold(bench, 400)
    assert bench.mode is Mode.ACTIVE
    bench.encoder_drift[j] = 0.00873
    k = hold(bench, 700)
    # The tilt's limit is lower: its drift is more than 3 % of it, a runaway while the valve is shut.
    assert bench.reason in (Reason.ENCODER_DRIFT, Reason.JOINT_RUNAWAY) and bench.controller.supervisor.detail == j
    assert j != Joint.SLEW or bench.reason == Reason.ENCODER_DRIFT
    assert k * T <= FAULTS[Reason.ENCODER_DRIFT].bound_ms * MS


@pytest.mark.parametrize("grapple", [GrappleCommand.NEUTRAL, GrappleCommand.CLOSE])
def test_a_rotator_that_logs_between_the_tongs_turn_back_is_not_reversed(grapple):
    bench = dithering(Bench()).armed()
    bench.tick([bench.hold(grapple=grapple)])
    bench.backward.add(4)
    for k in range(60):
        at_work = bench.mode in (Mode.ARMED, Mode.ACTIVE)
        bench.tick([bench.moving(4, 0.4, grapple=grapple)] if k % 10 == 0 and at_work else ())
    told = bench.reason == Reason.JOINT_REVERSED
    assert told is (grapple is GrappleCommand.NEUTRAL)
    assert bench.mode is (Mode.FAULT if told else Mode.ACTIVE)


@pytest.mark.parametrize("grapple", [GrappleCommand.NEUTRAL, GrappleCommand.HOLD])
def test_a_rotator_that_its_load_swings_runs_away_by_more(grapple):
    """Behind a PLC a log that came free of a stake let the rotator ring by 7 degrees, at most at 77 deg/s."""
    bench = dithering(Bench()).armed()
    bench.tick([bench.hold(grapple=grapple)])
    bench.moves_alone[4] = 0.5
    for k in range(100):
        at_work = bench.mode in (Mode.ARMED, Mode.ACTIVE)
        bench.tick([bench.hold(grapple=grapple)] if k % 10 == 0 and at_work else ())
    runs_away = (bench.reason, bench.controller.supervisor.detail) == (Reason.JOINT_RUNAWAY, Joint.ROT)
    assert runs_away is (grapple is GrappleCommand.NEUTRAL)


def hold(bench: Bench, ticks: int) -> int:
    """The planner keeps the crane where it is; ticks until the machine stops."""
    start = list(bench.controller.reference_position)
    for k in range(1, ticks + 1):
        setpoint = bench.setpoint([(0, start, [0.0] * 5), (400, start, [0.0] * 5)])
        bench.tick([setpoint] if k % 10 == 1 and bench.mode in (Mode.ARMED, Mode.ACTIVE) else ())
        if bench.mode in (Mode.STOP, Mode.FAULT):
            return k
    return ticks


@pytest.mark.parametrize("after", ["", "disarm"])
def test_a_person_who_took_over_by_hand_lever_moves_the_machine(after):
    """Levers need the pilot supply: a motion that the machine explains is shown, and cuts nothing."""
    bench = dithering(Bench()).active()
    bench.changed["EstopStat"] = {"Lever": 1}
    bench.run(2)
    if after:
        bench.press(OperatorAction.DISARM)
    bench.moves_alone[0] = 0.15
    assert bench.run(200) is (Mode.STANDBY if after else Mode.STOP)
    assert bench.controller.supervisor.moving_joint == 0
    del bench.changed["EstopStat"]
    bench.run(60)  # the oil moves on for a while
    assert bench.mode is (Mode.STANDBY if after else Mode.STOP)
    bench.press(OperatorAction.ARM)
    assert bench.controller.gate.refusal is Reason.JOINT_MOVES


def test_motion_in_a_stop_that_no_lever_explains_is_cut():
    bench = dithering(Bench()).active()
    bench.press(OperatorAction.STOP)
    bench.moves_alone[0] = 0.15
    assert bench.run(200) is Mode.FAULT and bench.reason == Reason.MOVES_WHILE_STOPPED


@pytest.mark.parametrize(
    ("slew_a_bar", "slew_b_bar", "cut"), [(2.0, 140.0, False), (140.0, 2.0, True), (20.0, 50.0, True)]
)
def test_a_column_that_is_turned_against_its_oil_is_pushed_and_one_that_its_oil_turns_runs_away(
    slew_a_bar, slew_b_bar, cut
):
    """A jaw that opens between a stake and a pile pushes it for 0.5 s; a valve has the pressure on the other side."""
    bench = Bench().armed()
    bench.tick([bench.hold()])
    bench.changed["PressB"] = {"SlewA": slew_a_bar, "SlewB": slew_b_bar}
    for k in range(100):
        bench.moves_alone[Joint.SLEW] = 0.45 * SPECS[0].speed_limit
        bench.tick([bench.hold()] if k % 10 == 0 else ())
    assert (bench.reason is Reason.JOINT_RUNAWAY) is cut, bench.reason
