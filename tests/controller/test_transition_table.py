"""The transition table by properties: what may lead where, whoever changes the table."""

from __future__ import annotations

import itertools

import pytest

from controller.transitions import OPERATING, TRANSITIONS, Event
from machine.status.modes import Mode

PERSON = (Event.ARM, Event.RESET, Event.DISARM)
"""Events that only a person causes."""
FAULT_EVENTS = (Event.HOLD, Event.RAMP, Event.CUT, Event.LATCHED)
PAIRS = list(itertools.product(Mode, Event))


def after(mode: Mode, event: Event) -> Mode:
    return TRANSITIONS.get((mode, event), mode)


def test_the_table_lists_only_changes_of_known_modes_and_events() -> None:
    assert set(TRANSITIONS) <= set(PAIRS)
    assert all(before is not now for (before, _), now in TRANSITIONS.items())


@pytest.mark.parametrize(("mode", "event"), PAIRS)
def test_every_pair(mode: Mode, event: Event) -> None:
    now = after(mode, event)
    if mode in (Mode.STOP, Mode.FAULT) and now not in (Mode.STOP, Mode.FAULT):
        assert event in PERSON, "nothing leaves a stop without a person"
    if mode is Mode.FAULT:
        assert now is (Mode.BOOT if event is Event.RESET else Mode.FAULT)
    if now is Mode.ARMED and mode is not Mode.ARMED:
        assert event is Event.ARM or (mode is Mode.ACTIVE and event is Event.DONE)
    if now is Mode.ACTIVE and mode is not Mode.ACTIVE:
        assert (mode, event) == (Mode.ARMED, Event.SETPOINT)
    if event is Event.CUT:
        assert now is Mode.FAULT
    if event in FAULT_EVENTS and event is not Event.LATCHED and mode in OPERATING:
        assert now in (Mode.STOP, Mode.FAULT)
    if event in (Event.HOLD, Event.RAMP):
        assert now in (Mode.STOP, Mode.FAULT) or mode in (Mode.BOOT, Mode.STANDBY)
    if event is Event.LATCHED:
        assert now is (Mode.FAULT if mode in (Mode.STOP, Mode.FAULT) else mode)
    if event is Event.ARM and mode in (Mode.BOOT, Mode.FAULT):
        assert now is mode


def test_no_event_but_arm_and_then_a_setpoint_makes_a_stopped_machine_move() -> None:
    """Breadth first over the table: without ARM, ACTIVE cannot be reached from any mode but itself and ARMED."""
    for start in Mode:
        found, waiting = {start}, [start]
        for mode in waiting:
            for event in Event:
                now = after(mode, event)
                if event is not Event.ARM and now not in found:
                    found.add(now)
                    waiting.append(now)
        assert (Mode.ACTIVE in found) is (start in OPERATING)


def test_every_mode_can_be_left_towards_armed_and_towards_fault() -> None:
    for goal in (Mode.ARMED, Mode.FAULT):
        for start in Mode:
            found, waiting = {start}, [start]
            for mode in waiting:
                for event in Event:
                    if (now := after(mode, event)) not in found:
                        found.add(now)
                        waiting.append(now)
            assert goal in found
