"""Operator commands to the mission: only fresh, ordered and signed ones for this machine are accepted."""

from __future__ import annotations

from dataclasses import replace

import pytest

from autonomy.process.operator_commands import MAX_AGE_NS, CommandReceiver, CommandRefused
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import MissionAction, MissionCommand, encode_mission_command
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


def test_old_commands_and_commands_from_the_future_are_refused() -> None:
    receiver = CommandReceiver(77)
    with pytest.raises(CommandRefused, check=coded("command.too-old")):
        receiver.accept(encode_mission_command(PAUSE), NOW_NS + 1_500_000_000)
    with pytest.raises(CommandRefused, check=coded("command.future")):
        receiver.accept(encode_mission_command(PAUSE), NOW_NS - 1)
    assert receiver.accept(encode_mission_command(PAUSE), NOW_NS + MAX_AGE_NS) == PAUSE, (
        "a refused command does not count as the last one"
    )


def test_a_command_for_another_profile_is_refused() -> None:
    with pytest.raises(CommandRefused, check=coded("command.other-profile")):
        CommandReceiver(78).accept(encode_mission_command(PAUSE), NOW_NS)


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
