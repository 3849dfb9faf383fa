"""The operator's mode switch, position by position: what starts, and what holds by which code."""

from __future__ import annotations

from dataclasses import replace

import pytest

from autonomy.manager.operator_switch import OperatorSwitch
from can_dbc.messages.crane import ModeSwitch
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import StandIn

REPORT = StandIn(load_profile("palms_471"), []).report()
NONE, IDLE, AUTO, FAULTY = ModeSwitch
START = "start"


@pytest.mark.parametrize(
    ("positions", "told"),
    [
        ((NONE, NONE), ("", "")),
        ((NONE, AUTO, AUTO), ("", "", "")),
        ((IDLE, AUTO, AUTO), ("switch.idle", START, "")),
        ((IDLE, FAULTY, AUTO), ("switch.idle", "switch.faulty", "")),
        ((FAULTY, IDLE, AUTO), ("switch.faulty", "switch.idle", START)),
        ((AUTO, NONE, AUTO), ("", "", "")),
        ((IDLE, NONE, AUTO), ("switch.idle", "switch.faulty", "")),
        ((FAULTY, NONE, NONE, IDLE), ("switch.faulty", "switch.faulty", "switch.faulty", "switch.idle")),
    ],
)
def test_only_the_turn_from_idle_to_auto_starts(positions: tuple[ModeSwitch, ...], told: tuple[str, ...]) -> None:
    switch, found = OperatorSwitch(), []
    for position in positions:
        switch.take(replace(REPORT, mode_switch=int(position)))
        found.append(START if switch.started else switch.hold.code if switch.hold else "")
        before = switch.hold
        switch.take(None)
        assert not switch.started and switch.hold is before, "without a report nothing changes"
    assert tuple(found) == told
