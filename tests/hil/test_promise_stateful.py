"""Random histories of a whole machine: faults, persons and planners in any order never break the promise."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from can_dbc.messages.crane import OperatorAction
from hil.wire.faults import Kind
from machine.status.modes import Mode
from tests.hil.promised_machine import NEEDED, PromiseBroken, PromisedMachine

pytestmark = pytest.mark.long
MESSAGES = st.sampled_from(sorted(NEEDED))


class AnyHistory(RuleBasedStateMachine):
    """One rule for everything that can happen; the monitor judges every 1.25 ms."""

    @initialize(moving=st.booleans())
    def booted(self, moving: bool) -> None:
        self.machine = PromisedMachine().boot()
        if moving:
            self.machine.start()

    @rule(seconds=st.sampled_from([0.02, 0.1, 0.3, 0.6]))
    def time_passes(self, seconds: float) -> None:
        self.machine.run(seconds)

    @rule(name=MESSAGES)
    def a_message_is_lost(self, name: str) -> None:
        self.machine.damage(Kind.DROP, name, 0.0)
        self.machine.run(0.15)

    @rule(name=MESSAGES, seconds=st.sampled_from([0.01, 0.05, 0.3]), probability=st.sampled_from([0.05, 0.3, 1.0]))
    def frames_are_corrupt(self, name: str, seconds: float, probability: float) -> None:
        self.machine.damage(Kind.CORRUPT, name, seconds, probability)
        self.machine.run(0.05)

    @rule(name=MESSAGES, shift_ms=st.sampled_from([2, 10, 40, 120]), seconds=st.sampled_from([0.05, 0.3]))
    def frames_are_late(self, name: str, shift_ms: int, seconds: float) -> None:
        self.machine.damage(Kind.DELAY, name, seconds, shift_ns=shift_ms * 1_000_000)
        self.machine.run(0.05)

    @rule(name=MESSAGES, shift_ms=st.sampled_from([1, 6]), seconds=st.sampled_from([0.05, 0.3]))
    def frames_are_repeated(self, name: str, shift_ms: int, seconds: float) -> None:
        self.machine.damage(Kind.REPEAT, name, seconds, shift_ns=shift_ms * 1_000_000)
        self.machine.run(0.05)

    @rule(participant=st.sampled_from(["plant", "controller", "guard"]))
    def a_cable_is_cut(self, participant: str) -> None:
        self.machine.cut(participant)
        self.machine.run(0.15)

    @rule()
    def the_bus_is_mended(self) -> None:
        self.machine.heal()
        self.machine.run(0.3)

    @rule()
    def the_emergency_stop_is_pressed(self) -> None:
        self.machine.press_emergency_stop()
        self.machine.run(0.05)

    @rule()
    def the_emergency_stop_is_released(self) -> None:
        self.machine.release_emergency_stop()

    @rule()
    def the_reset_button_is_pressed(self) -> None:
        self.machine.press_reset_button()
        self.machine.run(0.3)

    @rule(action=st.sampled_from(list(OperatorAction)))
    def an_operator_presses(self, action: OperatorAction) -> None:
        self.machine.press(action)
        self.machine.run(0.05)

    @rule(doing=st.sampled_from(["silent", "frozen", "replays", "rubbish", "hold", "moves"]))
    def the_planner_changes(self, doing: str) -> None:
        self.machine.planner.doing = doing
        self.machine.run(0.1)

    @rule(joint=st.integers(0, 4))
    def the_planner_moves_another_joint(self, joint: int) -> None:
        self.machine.planner.doing = "hold"
        self.machine.run(0.2)
        self.machine.planner.joint, self.machine.planner.doing = joint, "moves"
        self.machine.run(0.2)

    @rule(inside=st.booleans())
    def a_person_steps_in_or_out(self, inside: bool) -> None:
        self.machine.step_into_the_zone(inside)
        self.machine.run(0.1)

    @precondition(lambda self: self.machine.mode in (Mode.STANDBY, Mode.STOP, Mode.FAULT))
    @rule()
    def a_person_starts_again(self) -> None:
        """Everything is mended, and the whole way back is gone."""
        machine = self.machine
        machine.heal()
        machine.step_into_the_zone(False)
        machine.release_emergency_stop()
        machine.run(0.4)
        machine.press_reset_button()
        machine.run(0.8)
        machine.press(OperatorAction.RESET)
        machine.run(0.5)
        machine.start()

    @invariant()
    def the_mode_is_known(self) -> None:
        assert self.machine.mode in set(Mode)


AnyHistory.TestCase.settings = settings(
    max_examples=12,
    stateful_step_count=20,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
TestAnyHistory = AnyHistory.TestCase


def test_the_machine_of_the_histories_really_moves_and_starts_again() -> None:
    machine = PromisedMachine().boot()
    machine.start()
    assert machine.mode is Mode.ACTIVE and machine.moved
    machine.press_emergency_stop()
    machine.run(0.3)
    assert machine.mode is Mode.FAULT
    machine.release_emergency_stop()
    machine.press_reset_button()
    machine.run(1.5)
    assert machine.mode is Mode.STANDBY, machine.reason
    machine.moved = False
    machine.start()
    assert machine.mode is Mode.ACTIVE and machine.moved


@pytest.mark.parametrize("name", sorted(NEEDED))
def test_the_monitor_sees_a_valve_node_that_goes_on(name: str) -> None:
    """A node that keeps its spools open in spite of everything breaks the promise, whatever is lost."""
    machine = PromisedMachine().boot()
    machine.start()
    kept = list(machine.plant.valve.outputs_pct)
    assert any(kept[:5])
    decide = machine.plant.valve.decide

    def stubborn(now_ns: int) -> None:
        decide(now_ns)
        machine.plant.valve.outputs_pct = list(kept)

    machine.plant.valve.decide = stubborn  # type: ignore[method-assign]
    machine.damage(Kind.DROP, name, 0.0)
    with pytest.raises(PromiseBroken):
        machine.run(0.5)
