"""The emulated operator: arms, arms again after a stop, resets a fault, and finally gives up."""

from __future__ import annotations

import math

from can_dbc.messages.crane import OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode
from hil.harness.operator import MAX_STOPS, REACTION_NS, REPEAT_NS, Operator
from machine.status.modes import Mode

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
            assert operator.gave_up
            assert action is None
        else:
            assert action is (OperatorAction.RESET if number % 2 else OperatorAction.ARM)
        pressed(operator, Mode.ACTIVE, now_ns + 2 * REACTION_NS)
