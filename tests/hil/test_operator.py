"""The emulated operator: arms, arms again after a stop, resets a fault, and finally gives up."""

from __future__ import annotations

import math

import pytest

from can_dbc.messages.crane import WATCH_PERIOD_NS, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode
from hil.harness.operator import MAX_PRESSES, MAX_STOPS, REACTION_NS, REPEAT_NS, Operator
from machine.status.modes import Mode
from tests.codes import numbers_in

UNKNOWN = (math.nan,) * 5


def report(mode: Mode, stamp_ns: int) -> StateReport:
    return StateReport(1, 7, stamp_ns, mode, 0, 0, 0, 0, 0, 0, UNKNOWN, UNKNOWN, UNKNOWN, 0.0, 0.0, 0.0, 0, 0, 0, 0)


def pressed(operator: Operator, mode: Mode, stamp_ns: int) -> OperatorAction | None:
    data = operator.step(report(mode, stamp_ns))
    if data is None:
        return None
    command = decode(data)
    assert isinstance(command, OperatorCommand)
    assert command.profile_hash == 7
    return command.action


def test_the_operator_waits_before_arming_and_between_presses() -> None:
    seen: list[OperatorAction] = []
    operator = Operator(7, lambda action, _: seen.append(action))
    assert pressed(operator, Mode.STANDBY, 10 * REACTION_NS) is None
    assert pressed(operator, Mode.STANDBY, 11 * REACTION_NS) is OperatorAction.ARM
    assert pressed(operator, Mode.STANDBY, 11 * REACTION_NS + REPEAT_NS - 1) is None
    assert pressed(operator, Mode.STANDBY, 11 * REACTION_NS + REPEAT_NS) is OperatorAction.ARM
    assert seen == [OperatorAction.ARM, OperatorAction.ARM]


def test_its_arm_is_meant_for_the_file_of_its_profile() -> None:
    operator = Operator(7, lambda *_: None, profile_check=0xABCDEF)
    operator.step(report(Mode.STANDBY, 10 * REACTION_NS))
    command = decode(operator.step(report(Mode.STANDBY, 11 * REACTION_NS)) or b"")
    assert isinstance(command, OperatorCommand)
    assert (command.action, command.profile_check) == (OperatorAction.ARM, 0xABCDEF)


def test_the_operator_does_nothing_while_the_machine_works() -> None:
    operator = Operator(7, lambda *_: None)
    for mode in (Mode.BOOT, Mode.ARMED, Mode.ACTIVE):
        assert pressed(operator, mode, 10 * REACTION_NS) is None
        assert pressed(operator, mode, 20 * REACTION_NS) is None


def test_the_operator_resets_and_rearms_until_there_are_too_many_stops() -> None:
    operator = Operator(7, lambda *_: None)
    now_ns = 0
    for number in range(1, MAX_STOPS + 2):
        now_ns += 10 * REPEAT_NS
        pressed(operator, Mode.FAULT if number % 2 else Mode.STOP, now_ns)
        action = pressed(operator, Mode.FAULT if number % 2 else Mode.STOP, now_ns + REACTION_NS)
        assert operator.stops == number
        if number > MAX_STOPS:
            assert operator.gave_up and MAX_STOPS + 1 in numbers_in(operator.complaint)
            assert action is None
        else:
            assert action is (OperatorAction.RESET if number % 2 else OperatorAction.ARM)
        pressed(operator, Mode.ACTIVE, now_ns + 2 * REACTION_NS)


@pytest.mark.parametrize(("mode", "button"), [(Mode.STANDBY, OperatorAction.ARM), (Mode.FAULT, OperatorAction.RESET)])
def test_the_operator_gives_up_presses_without_effect(mode: Mode, button: OperatorAction) -> None:
    """A latched guard refuses every ARM until a person presses the safety module's reset: a run would never end."""
    operator = Operator(7, lambda *_: None)
    pressed(operator, mode, REPEAT_NS)
    for number in range(2, MAX_PRESSES + 2):
        assert pressed(operator, mode, number * REPEAT_NS) is button and not operator.gave_up
    pressed(operator, Mode.ARMED, (MAX_PRESSES + 2) * REPEAT_NS)
    last = MAX_PRESSES + 3
    for number in range(last, last + MAX_PRESSES + 1):
        assert not operator.gave_up, "armed in between: counted anew"
        pressed(operator, mode, number * REPEAT_NS)
    assert pressed(operator, mode, (last + MAX_PRESSES + 1) * REPEAT_NS) is None
    assert operator.gave_up and mode.name in operator.complaint and button.name in operator.complaint
    assert numbers_in(operator.complaint) == [90]


def test_an_operator_who_watches_sends_heartbeats_and_still_presses() -> None:
    operator = Operator(7, lambda *_: None, watches=True)
    start_ns, found = 10 * REACTION_NS, []
    for k in range(101):
        found.append(pressed(operator, Mode.STANDBY if k > 90 else Mode.ACTIVE, start_ns + k * WATCH_PERIOD_NS // 10))
    assert [k for k, action in enumerate(found) if action is OperatorAction.WATCH] == list(range(0, 101, 10))
    late_ns = start_ns + 101 * WATCH_PERIOD_NS // 10 + REACTION_NS
    assert pressed(operator, Mode.STANDBY, late_ns) is OperatorAction.ARM, "a button before a heartbeat"
    assert pressed(operator, Mode.STANDBY, late_ns + 1) is OperatorAction.WATCH


def test_of_an_operator_whose_link_is_cut_nothing_arrives() -> None:
    operator = Operator(7, lambda *_: None, watches=True)
    operator.cut = True
    assert pressed(operator, Mode.ACTIVE, 10 * REACTION_NS) is None
    operator.cut = False
    assert pressed(operator, Mode.ACTIVE, 11 * REACTION_NS) is OperatorAction.WATCH
