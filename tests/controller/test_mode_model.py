"""The modes of controller, guard and valve node together, every reachable combination of them."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from can_dbc.messages.crane import OperatorAction
from controller.guard.guard import LATCHING, Verdict
from controller.transitions import OPERATING, Event
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason
from sim.nodes.valve import ValveInputs, ValveNode, ValveState
from tests.controller import mode_model
from tests.controller.bench import DATABASE, Bench
from tests.controller.guard_traffic import MOVING, Traffic
from tests.controller.mode_model import Broken, Link, State, after, reachable, settled, transitions, way

FOUND = reachable()


def test_the_model_reaches_every_mode_and_moves() -> None:
    assert {state.mode for state in FOUND} == set(Mode)
    assert any(state.may_move for state in FOUND)
    assert len(FOUND) > 150


def test_nothing_becomes_active_without_an_arm_since_the_last_stop() -> None:
    for before, name, now in transitions(FOUND):
        if now.mode in OPERATING:
            assert now.armed, [*way(FOUND, before), name]
        if now.mode in OPERATING and before.mode not in OPERATING:
            assert name == "ARM", [*way(FOUND, before), name]


def test_nothing_leaves_stop_or_fault_without_a_person() -> None:
    for before, name, now in transitions(FOUND):
        if before.mode in (Mode.STOP, Mode.FAULT) and now.mode not in (Mode.STOP, Mode.FAULT):
            assert name in ("ARM", "RESET", "reset button", "DISARM"), [*way(FOUND, before), name]


def test_a_latched_guard_keeps_the_valve_node_from_following() -> None:
    for state in FOUND:
        if state.latched or state.broken is not Broken.NOTHING or state.pressed:
            assert not state.node_active, way(FOUND, state)


def test_after_a_broken_rule_nothing_moves_before_the_button_and_an_arm() -> None:
    for before, name, now in transitions(FOUND):
        if now.may_move:
            assert now.reset_pressed and (now.armed or now.ramping) and now.pilot_on, [*way(FOUND, before), name]
            assert now.armed or before.may_move, "a ramp goes on and does not begin"
        if not before.reset_pressed and now.reset_pressed:
            assert name == "reset button"


def test_motion_ends_with_every_stop() -> None:
    for state in FOUND:
        for name in ("emergency stop", "silence", "rule broken", "cause CUT"):
            assert not after(state, name).may_move, [*way(FOUND, state), name]
        lost = ["link lost"] if state.link is Link.WATCHED else []
        for name in ("STOP", "DISARM", "cause HOLD", "cause RAMP", *lost):
            ended = after(after(state, name), "time")
            if ended.mode in OPERATING:  # DISARM or a fault's end of a machine that was not moving
                assert (name == "DISARM" and state.ramping) or not state.armed_key, [*way(FOUND, state), name]
            assert not (state.mode is Mode.ACTIVE and ended.may_move)


def test_nothing_works_while_a_watched_link_is_lost_and_its_return_starts_nothing() -> None:
    for before, name, now in transitions(FOUND):
        if now.link is Link.LOST:
            assert now.mode not in OPERATING, [*way(FOUND, before), name]
        if name in ("WATCH", "WATCH_END"):
            assert now.mode is before.mode, [*way(FOUND, before), name]
    assert {state.link for state in FOUND if state.may_move} == {Link.OFF, Link.WATCHED, Link.LOST}, "lost: the ramp"


def test_a_person_gets_from_everywhere_to_armed_once_the_causes_are_gone() -> None:
    for state in FOUND:
        here = settled(replace(state, cause=None, broken=Broken.NOTHING, pressed=False))
        waiting, seen = [here], {here}
        for now in waiting:
            if now.mode is Mode.ARMED and now.node_active:
                break
            for name in (*mode_model.PERSON, "STOP", "time"):
                other = after(now, name)
                if other not in seen:
                    seen.add(other)
                    waiting.append(other)
        else:
            raise AssertionError(f"no way to ARMED from {state}: {way(FOUND, state)}")


def test_the_properties_can_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a table in which a setpoint leaves STOP, the search finds a motion without an ARM."""
    monkeypatch.setitem(mode_model.TRANSITIONS, (Mode.STOP, Event.SETPOINT), Mode.ACTIVE)
    monkeypatch.setitem(mode_model.EVENTS, "setpoint", lambda s: mode_model.applied(s, Event.SETPOINT))
    found = reachable()
    assert any(state.mode is Mode.ACTIVE and not state.armed for state in found)


# -- the model against the real parts ----------------------------------------------------------------------------------


def test_reactions_and_latching_rules_are_those_of_the_model() -> None:
    assert [Event(Event.HOLD + r - Reaction.HOLD) for r in (Reaction.HOLD, Reaction.RAMP, Reaction.CUT)] == [
        Event.HOLD,
        Event.RAMP,
        Event.CUT,
    ]
    assert FAULTS[Reason.ESTOP_PRESSED].reaction is FAULTS[Reason.GUARD_REFUSES].reaction is Reaction.CUT
    assert FAULTS[Reason.GUARD_LOST].reaction is Reaction.CUT and FAULTS[Reason.ESTOP_PRESSED].always
    assert Verdict.ESTOP in LATCHING and Verdict.RANGE in LATCHING
    assert not {Verdict.NO_COMMAND, Verdict.ESTOP_LOST, Verdict.STALE} & LATCHING


@pytest.mark.parametrize("latching", [False, True])
@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("mode", Mode)
def test_the_supervisor_applies_events_as_the_model(mode: Mode, event: Event, latching: bool) -> None:
    supervisor = Bench().controller.supervisor
    stopping = latching and mode is Mode.STOP
    supervisor.mode, supervisor.latching, supervisor.ramp_ns = mode, stopping, 60_000_000 if stopping else 0
    model = State(mode=mode, ramping=stopping, latching=stopping)
    supervisor.apply(event, Reason.LEASE_LOST, 0, 10**9)
    model = mode_model.applied(model, event)
    assert (supervisor.mode, supervisor.ramping, supervisor.latching) == (model.mode, model.ramping, model.latching)


class Rig:
    """Real guard and valve node on one bus, driven by the events of the model."""

    def __init__(self) -> None:
        self.traffic = Traffic()
        self.pilot_on = True
        self.node = ValveNode(DATABASE, [], lambda: self.pilot_on, ValveInputs)
        self.run(80)

    def run(self, ticks: int) -> None:
        traffic = self.traffic
        inner = traffic.frame
        sent = []

        def frame(name, values):
            made = inner(name, values)
            sent.append(made)
            return made

        traffic.frame = frame
        for _ in range(ticks):
            traffic.tick()
            self.node.sync(traffic.now_ns)
            for made in sent:
                self.node.receive(made.key, made.data, traffic.now_ns)
            for key, data in traffic.sent:
                self.node.receive(key, data, traffic.now_ns)
            sent.clear()
            self.node.decide(traffic.now_ns)
        traffic.frame = inner

    def command(self, state: State) -> None:
        """What the controller of the model sends."""
        traffic = self.traffic
        broken = state.broken is Broken.HEARD
        traffic.a.update(MOVING if state.moving_commands else {"Mode": 0, "Slew": 0.0})
        traffic.b["ArmKey"] = 0xA if state.armed_key else 0
        traffic.b["Aux"] = 1.0 if broken else 0.0
        traffic.estop["ChannelA"] = traffic.estop["ChannelB"] = int(not state.pressed)
        traffic.dropped = {"ValveCmdB"} if state.broken is Broken.SILENCE else set()
        self.pilot_on = state.pilot_on

    def press(self) -> None:
        self.traffic.estop["ResetReq"] = 1
        self.run(6)
        self.traffic.estop["ResetReq"] = 0


@pytest.mark.parametrize("seed", range(12))
def test_guard_and_valve_node_follow_the_model(seed: int) -> None:
    """Random walks: after every event both agree with the model on enable and on following."""
    rng = random.Random(seed)
    rig, state = Rig(), after(after(State(), "time"), "time")
    names: list[str] = []
    for _ in range(14):
        weights = [
            6 if n in ("time", "ARM", "reset button", "rules hold", "release", "setpoint") else 1
            for n in mode_model.EVENTS
        ]
        name = rng.choices(list(mode_model.EVENTS), weights)[0]
        names.append(name)
        if name == "reset button":
            rig.command(replace(state, pilot_on=state.pilot_on or not state.pressed))
            rig.press()
        state = after(state, name)
        if name in OperatorAction.__members__:
            rig.traffic.press(OperatorAction[name])
        if state.mode in OPERATING and name == "time":
            state = after(state, "done")
            names.append("done")
        rig.command(state)
        rig.run(70 if name == "time" else 14)
        assert rig.traffic.guard.enabled == state.enabled or not state.calm, (names, rig.traffic.guard.verdict, state)
        follows = rig.node.valve_state is ValveState.ACTIVE
        assert follows <= (state.node_active or (rig.traffic.guard.enabled and state.armed_key)), (names, state)
        if state.node_active:
            assert follows, (names, rig.node.valve_state, rig.traffic.guard.verdict)
