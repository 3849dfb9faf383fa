"""What the operator tells the mission: commands, fresh, ordered and signed, and the positions of the mode switch."""

from __future__ import annotations

from dataclasses import replace

import pytest

from autonomy.manager.operator_switch import OperatorSwitch
from autonomy.process.operator_commands import MAX_AGE_NS, CommandReceiver, CommandRefused
from can_dbc.messages.crane import ModeSwitch, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import MissionAction, MissionCommand, encode_mission_command
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import StandIn
from tests.codes import coded

NOW_NS = 10**12
PAUSE = MissionCommand(5, 77, NOW_NS, MissionAction.PAUSE)


def test_a_command_is_accepted_once() -> None:
    receiver = CommandReceiver(77)
    assert receiver.accept(encode_mission_command(PAUSE), NOW_NS) == PAUSE
    with pytest.raises(CommandRefused, check=coded("command.repeated")):
        receiver.accept(encode_mission_command(PAUSE), NOW_NS)
    later = replace(PAUSE, sequence=6, action=MissionAction.AUTO)
    assert receiver.accept(encode_mission_command(later), NOW_NS) == later
    with pytest.raises(CommandRefused, check=coded("command.repeated")):
        receiver.accept(encode_mission_command(PAUSE), NOW_NS)


def test_commands_that_are_old_from_the_future_or_for_another_profile_are_refused() -> None:
    receiver, data = CommandReceiver(77), encode_mission_command(PAUSE)
    for refusing, now_ns, code in (
        (receiver, NOW_NS + 1_500_000_000, "command.too-old"),
        (receiver, NOW_NS - 1, "command.future"),
        (CommandReceiver(78), NOW_NS, "command.other-profile"),
    ):
        with pytest.raises(CommandRefused, check=coded(code)):
            refusing.accept(data, now_ns)
    assert receiver.accept(data, NOW_NS + MAX_AGE_NS) == PAUSE, "a refused command does not count as the last one"


def test_with_a_key_only_signed_commands_are_accepted() -> None:
    receiver = CommandReceiver(77, b"right")
    for wrong in (encode_mission_command(PAUSE), encode_mission_command(PAUSE, b"wrong")):
        with pytest.raises(CommandRefused, check=coded("command.datagram")):
            receiver.accept(wrong, NOW_NS)
    assert receiver.accept(encode_mission_command(PAUSE, b"right"), NOW_NS) == PAUSE


@pytest.mark.parametrize("data", [b"", b"pause", encode(OperatorCommand(1, 77, NOW_NS, OperatorAction.ARM))])
def test_other_datagrams_are_refused(data: bytes) -> None:
    with pytest.raises(CommandRefused):
        CommandReceiver(77).accept(data, NOW_NS)


# -- the mode switch
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
