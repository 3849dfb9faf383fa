"""A crane at full speed in lockstep when its planner freezes, when it is stopped hard, when a valve sticks open."""

from __future__ import annotations

import math

import pytest

from can_dbc.dbc.codec import load
from can_dbc.messages.crane import OperatorAction
from hil.harness.lockstep import SLICE_NS
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.hil.stand_ins import Idle, press
from tests.hil.sweep import LEASE_NS, Hold, Sweep, Watched, watched

pytestmark = pytest.mark.long
MS = 1_000_000
NAMES = ("palms_471", "aoro_fc8")


def full_speed(run: Watched, planner: Sweep) -> bool:
    """Whether the joint has come to 95 % of its speed limit."""
    spec = joint(planner.profile, planner.j)
    return bool(run.reports) and abs(run.reports[-1].velocity[planner.j]) > 0.95 * spec.speed_limit


@pytest.mark.parametrize("name", NAMES)
def test_a_planner_that_freezes_at_full_speed_costs_its_lease_and_a_ramp(name):
    planner = Sweep(load_profile(name), Joint.SLEW)
    with watched(name, planner) as run:
        assert run.run(20.0, lambda: full_speed(run, planner))
        planner.silent_s = 0.0
        run.run(0.06)
        begin, turned = run.tip(), run.reports[-1].position[Joint.SLEW]
        assert run.run(2.0, lambda: run.mode == Mode.STOP) and run.reason == Reason.LEASE_LOST
        run.run(0.6, lambda: run.neutral_since_ns)
        ramp_ns = planner.profile.timeouts.stop_ramp_ms * MS
        neutral_ns = run.neutral_since_ns - planner.last_ns
        assert LEASE_NS + ramp_ns // 2 < neutral_ns <= LEASE_NS + ramp_ns + 10 * MS
        run.run(4.0)
        travel_rad = abs(run.reports[-1].position[Joint.SLEW] - turned)
        spec = joint(planner.profile, Joint.SLEW)
        print(name, run.reports[-1].mode, neutral_ns / MS, math.dist(begin, run.tip()), travel_rad)
        still_s = (LEASE_NS + ramp_ns) * 1e-9 + spec.valve.delay_s + spec.valve.lag_s + spec.valve.oil_s
        assert travel_rad < spec.speed_limit * still_s
        assert (run.mode, run.reason) == (Mode.STOP, Reason.LEASE_LOST), "and nothing is said to run away"


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("j", [Joint.SLEW, Joint.LIFT, Joint.TILT, Joint.EXT])
def test_a_hard_stop_at_full_speed_rings_and_nothing_is_said_to_run_away_nor_cut(name, j):
    planner = Sweep(load_profile(name), j, silent_s=20.0)
    with watched(name, planner, seed=2 + j) as run:
        assert run.run(20.0, lambda: full_speed(run, planner)), run.reports[-1]
        press(run.system, OperatorAction.STOP)
        assert not run.run(1.0, lambda: not run.system.guard.enabled), run.system.guard.verdict
        run.run(7.0)
        assert (run.mode, run.reason) == (Mode.STOP, Reason.OPERATOR_STOP)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("share", [0.04, 0.3, 1.0])
def test_a_valve_stuck_open_is_cut_while_armed_and_while_stopped(name, share):
    with watched(name, Idle(), seed=4, blind=True) as run:
        spec = joint(run.plant.profile, Joint.SLEW)
        assert run.run(20.0, lambda: run.mode == Mode.ARMED)
        run.run(3.0)
        assert run.mode == Mode.ARMED
        deadband = 0.01 * spec.valve.deadband_plus_pct
        opening = deadband + (1.0 - deadband) * share * spec.speed_limit / spec.valve.full_speed_plus
        begin, since_ns = run.tip(), run.system.now_ns
        run.plant.spool_faults.stuck["slew"] = opening
        assert run.run(3.0, lambda: run.mode == Mode.FAULT) and run.reason == Reason.SPOOL_OPEN
        found_ms = (run.system.now_ns - since_ns) / MS
        travel_m = math.dist(begin, run.tip())
        print(name, share, found_ms, travel_m)
        assert travel_m < 0.20


@pytest.mark.parametrize("blind", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_hand_levers_move_a_machine_in_standby_without_a_fault(name, blind):
    """The levers work although the guard, which sees them too, has taken its part of the pilot supply away."""
    with watched(name, Idle(), seed=5, blind=blind) as run:
        assert run.run(20.0, lambda: run.mode == Mode.ARMED)
        press(run.system, OperatorAction.DISARM)
        run.system.operator._max_stops = -1  # nobody arms it again
        run.run(2.5)
        assert run.mode == Mode.STANDBY
        begin = run.reports[-1].position[Joint.SLEW]
        seen = set()
        for _ in range(10):
            run.plant.lever("slew", 0.4)
            run.run(0.25)
            seen |= {r.reason & 0xFF for r in run.reports[-10:]}
        assert abs(run.reports[-1].position[Joint.SLEW] - begin) > 0.1
        assert run.mode == Mode.STANDBY and (Reason.JOINT_MOVES if blind else Reason.GUARD_NOT_READY) in seen
        run.run(4.0)
        assert run.reason == (Reason.NONE if blind else Reason.GUARD_NOT_READY)
        run.plant.estop.reset()
        run.run(1.0)
        assert run.reason == Reason.NONE


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("j", [Joint.SLEW, Joint.LIFT, Joint.TILT])
def test_an_encoder_that_drifts_half_a_degree_a_second_holds_before_the_tip_wanders(name, j):
    with watched(name, Hold(load_profile(name)), seed=3) as run:
        assert run.run(20.0, lambda: run.mode == Mode.ACTIVE)
        run.run(4.0)
        assert run.mode == Mode.ACTIVE
        begin, since_ns = run.tip(), run.system.now_ns
        node = run.plant.encoders[j.name.lower()]
        observe = node.observe
        node.observe = lambda now_ns, position, speed: observe(
            now_ns, position + math.radians(0.5) * (now_ns - since_ns) * 1e-9, speed
        )
        assert run.run(3.0, lambda: run.mode in (Mode.STOP, Mode.FAULT))
        assert run.reason in (Reason.ENCODER_DRIFT, Reason.JOINT_RUNAWAY)
        print(name, j.name, run.reason, (run.system.now_ns - since_ns) / MS, math.dist(begin, run.tip()))
        assert math.dist(begin, run.tip()) < 0.02


@pytest.mark.parametrize("lost", ["ValveCmdA", "ValveCmdB"])
def test_neutral_within_100_ms_of_losing_half_a_command(lost: str) -> None:
    """Of every spool, whichever of the two valve commands is gone."""
    with watched("palms_471", Sweep(load_profile("palms_471"), Joint.SLEW), truth="nominal") as run:
        key, gone = load("crane").message(lost).key, []
        assert run.run(8.0, lambda: abs(run.plant.valve.outputs_pct[0]) > 30.0)
        run.system._observer.on_outputs.append(
            lambda outputs, now_ns: outputs.frames.__setitem__(
                slice(None), [frame for frame in outputs.frames if frame[0] != key]
            )
        )
        lost_ns = run.system.now_ns
        for _ in range(200_000_000 // SLICE_NS):
            run.system.advance()
            gone.append(any(run.plant.valve.outputs_pct))
        neutral_ms = (gone.index(False) + 1) * SLICE_NS / 1e6
        assert not any(gone[gone.index(False) :]) and run.system.now_ns > lost_ns
        assert neutral_ms < 100.0
