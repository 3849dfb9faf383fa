"""The setpoint port in a flood: what a tick takes is bounded, the planner is heard, and who floods it is named.

Sockets on loopback; nothing waits for a clock.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace

import pytest

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode, encode
from controller.process.setpoint_port import MAX_DATAGRAMS, SetpointPort, listen
from runtime.errors import LinkError
from tests.codes import coded
from tests.controller.bench import Bench

KEY = b"0123456789abcdef"
FLOOD = 400
"""Datagrams that fill the receive buffer of a socket, 212992 bytes by default; small ones leave no gap for others."""
HOLD = Bench().armed().hold()
STOP = OperatorCommand(1, 0, 1, OperatorAction.STOP)


class Sender(socket.socket):
    """Someone who sends to the port; the kernel gives him a port of his own."""

    def __init__(self, to: SetpointPort) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self.connect(to.address)


@pytest.fixture
def port() -> Iterator[SetpointPort]:
    made = SetpointPort(listen(0), KEY)
    yield made
    made.close()


@pytest.fixture
def planner(port: SetpointPort) -> Iterator[Sender]:
    with Sender(port) as made:
        yield made


@pytest.fixture
def stranger(port: SetpointPort) -> Iterator[Sender]:
    with Sender(port) as made:
        yield made


def setpoint(sequence: int, key: bytes | None = KEY) -> bytes:
    """A setpoint that the key's holder sends."""
    return encode(replace(decode(HOLD), sequence=sequence), key)


def heard(port: SetpointPort) -> list[bytes]:
    """What one tick takes."""
    found: list[bytes] = []
    port.receive(found)
    return found


def test_a_flood_takes_nothing_from_a_planner_that_was_heard(
    port: SetpointPort, planner: Sender, stranger: Sender
) -> None:
    planner.send(setpoint(1))
    assert heard(port) == [setpoint(1, None)]
    for sequence in range(2, 12):
        for _ in range(FLOOD):
            stranger.send(b"x")
        planner.send(setpoint(sequence))
        taken = heard(port)
        assert taken == [setpoint(sequence, None)] + [b""] * MAX_DATAGRAMS


def test_one_tick_takes_no_more_than_twice_its_share(port: SetpointPort, planner: Sender, stranger: Sender) -> None:
    planner.send(setpoint(1))
    heard(port)
    for _ in range(2 * MAX_DATAGRAMS):
        planner.send(setpoint(2))
        stranger.send(b"x")
    assert len(heard(port)) == 2 * MAX_DATAGRAMS


def test_another_planner_with_the_key_takes_its_place(port: SetpointPort, planner: Sender, stranger: Sender) -> None:
    planner.send(setpoint(1))
    heard(port)
    with Sender(port) as successor:
        successor.send(setpoint(2))
        assert heard(port) == [setpoint(2, None)]
        for _ in range(FLOOD):
            stranger.send(b"x")
        successor.send(setpoint(3))
        assert heard(port)[0] == setpoint(3, None)


@pytest.mark.parametrize("key", [None, KEY, KEY[::-1]])
def test_stop_is_heard_from_anyone_and_moves_no_planner_from_its_place(
    port: SetpointPort, planner: Sender, stranger: Sender, key: bytes | None
) -> None:
    planner.send(setpoint(1))
    heard(port)
    stranger.send(encode(STOP, key))
    assert heard(port) == [encode(STOP)]
    for _ in range(FLOOD):
        stranger.send(b"x")
    planner.send(setpoint(2))
    assert heard(port)[0] == setpoint(2, None)


def test_who_sends_without_the_key_is_counted_and_named(port: SetpointPort, planner: Sender, stranger: Sender) -> None:
    planner.send(setpoint(1))
    heard(port)
    assert port.strangers_text() == ""
    for _ in range(3):
        stranger.send(setpoint(2, KEY[::-1]))
    heard(port)
    assert port.strangers_text() == (
        f"Datagrams without the right key: 3, the last from UDP port {stranger.getsockname()[1]}. "
    )


def test_nobody_else_may_listen_there(port: SetpointPort) -> None:
    with pytest.raises(LinkError, check=coded("udp.port-in-use")):
        listen(port.address[1])
    for option in (socket.SO_REUSEPORT, socket.SO_REUSEADDR):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
            thief.setsockopt(socket.SOL_SOCKET, option, 1)
            with pytest.raises(OSError, match="in use"):
                thief.bind(port.address)
