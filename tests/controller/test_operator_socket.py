"""Authority: only who may write to the operator's socket and holds its credential arms; STOP is heard from anyone."""

import os
import socket
import stat
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest

from can_dbc.messages import operator_link
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import signed
from can_dbc.messages.operator_link import CREDENTIAL_BYTES
from controller.process.operator_socket import COMMAND_BYTES, OperatorSocket
from controller.process.setpoint_port import MAX_DATAGRAMS, SetpointPort, listen
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import LinkError
from tests.codes import coded, numbers_in
from tests.controller.bench import Bench


@pytest.fixture
def path():
    """A place that any user may reach, as pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name, "operator")


@pytest.fixture
def operator(path):
    made = OperatorSocket(path)
    yield made
    made.close()


ARM = encode(OperatorCommand(1, 2, 3, OperatorAction.ARM))
STOP = encode(OperatorCommand(1, 2, 3, OperatorAction.STOP))
KEY = b"0123456789abcdef"


def received(operator):
    """The commands that were heard, and what else there was."""
    commands, others = [], []
    operator.receive(commands, others)
    return commands, others


def send_as_it_is(data, path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.sendto(data, str(path))


def command(k):
    return encode(OperatorCommand(k, 2, 3, OperatorAction.ARM))


def test_commands_arrive_in_order_without_their_authenticator(path):
    operator = OperatorSocket(path)
    for k in range(3):
        operator_link.send(command(k), path)
    assert received(operator) == ([command(k) for k in range(3)], []) and received(operator) == ([], [])
    operator.close()
    assert not path.exists() and not operator_link.credential_path(path).exists()


@pytest.mark.parametrize("action", [a for a in OperatorAction if a is not OperatorAction.STOP])
def test_without_the_credential_nothing_but_stop_is_heard(path, operator, action):
    """Bare, with another key, with a key of the services, and what is too long."""
    data = encode(OperatorCommand(1, 2, 3, action))
    tried = [data, signed(data, KEY), signed(data, bytes(CREDENTIAL_BYTES)), data + data, b"x" * (COMMAND_BYTES + 9)]
    for each in tried:
        send_as_it_is(each, path)
    assert received(operator) == ([], [b""] * len(tried))
    operator_link.send(data, path)
    assert received(operator) == ([data], [])


def test_stop_is_heard_with_any_key_or_none(path, operator):
    for data in (STOP, signed(STOP, KEY), signed(STOP, operator_link.credential_path(path).read_bytes())):
        send_as_it_is(data, path)
    operator_link.credential_path(path).unlink()
    operator_link.send(STOP, path)
    assert received(operator) == ([STOP] * 4, [])
    send_as_it_is(STOP[:-1] + b"?", path)
    send_as_it_is(STOP + b"?", path)
    assert received(operator) == ([], [b""] * 2)


def test_what_was_sent_before_a_restart_is_worth_nothing_after_it(path):
    first = OperatorSocket(path)
    yesterday = signed(ARM, operator_link.credential_path(path).read_bytes())
    send_as_it_is(yesterday, path)
    assert received(first) == ([ARM], [])
    second = OperatorSocket(path)
    send_as_it_is(yesterday, path)
    assert received(second) == ([], [b""])
    first.close()
    second.close()


def test_only_owner_and_group_can_read_the_credential(path):
    before = os.umask(0)
    operator = OperatorSocket(path)
    os.umask(before)
    assert stat.S_IMODE(operator_link.credential_path(path).stat().st_mode) == 0o640
    assert len(operator_link.credential_path(path).read_bytes()) == CREDENTIAL_BYTES
    assert {each.name for each in path.parent.iterdir()} == {"operator", "operator.key"}
    operator.close()


def test_the_whole_queue_is_heard_in_one_tick(path, operator):
    sent = 0
    with pytest.raises(BlockingIOError):
        for sent in range(1000):
            operator_link.send(command(sent), path)
    assert len(received(operator)[0]) == sent


def test_a_restarted_controller_takes_the_path_over(path):
    first = OperatorSocket(path)
    second = OperatorSocket(path)
    first.close()
    operator_link.send(ARM, path)
    assert received(second) == ([ARM], [])
    second.close()
    with pytest.raises(OSError):
        operator_link.send(ARM, path)


@pytest.mark.parametrize("action", [OperatorAction.ARM, OperatorAction.DISARM, OperatorAction.RESET])
def test_a_planner_cannot_arm_disarm_or_reset(action):
    bench = Bench().boot() if action is OperatorAction.ARM else Bench().armed()
    before = bench.mode
    bench.tick_with(planner=[bench.operator(action)])
    assert bench.mode is before and bench.controller.gate.refusal is Reason.NO_AUTHORITY


def test_a_planner_can_stop():
    bench = Bench().armed()
    bench.tick_with(planner=[bench.operator(OperatorAction.STOP)])
    assert bench.mode is Mode.STOP


def test_an_operator_sends_no_setpoints():
    bench = Bench().armed()
    bench.tick_with(operator=[bench.hold()])
    assert bench.mode is Mode.ARMED and bench.controller.gate.refusal is Reason.DATAGRAM_KIND


def test_the_operator_is_heard_before_the_planner():
    """A setpoint of the same tick does not set a machine in motion that a person stops."""
    bench = Bench().armed()
    bench.tick_with(planner=[bench.moving(0, 0.05)], operator=[bench.operator(OperatorAction.STOP)])
    assert bench.mode is Mode.STOP and bench.controller.gate.refusal is Reason.NOT_ARMED


# -- the setpoint port in a flood: sockets on loopback; nothing waits for a clock

FLOOD = 400
"""Datagrams that fill the receive buffer of a socket, 212992 bytes by default; small ones leave no gap for others."""
HOLD = Bench().armed().hold()


class Sender(socket.socket):
    """Someone who sends to the port; the kernel gives him a port of his own."""

    def __init__(self, to):
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self.connect(to.address)


@pytest.fixture
def port():
    made = SetpointPort(listen(0), KEY)
    yield made
    made.close()


@pytest.fixture
def planner(port):
    """One whose first setpoint was heard."""
    with Sender(port) as made:
        made.send(setpoint(1))
        assert heard(port) == [setpoint(1, None)]
        yield made


@pytest.fixture
def stranger(port):
    with Sender(port) as made:
        yield made


def setpoint(sequence: int, key: bytes | None = KEY) -> bytes:
    """A setpoint that the key's holder sends."""
    return encode(replace(decode(HOLD), sequence=sequence), key)


def heard(port) -> list[bytes]:
    """What one tick takes."""
    found: list[bytes] = []
    port.receive(found)
    return found


def test_a_flood_takes_nothing_from_a_planner_that_was_heard(port, planner, stranger):
    for sequence in range(2, 12):
        for _ in range(FLOOD):
            stranger.send(b"x")
        planner.send(setpoint(sequence))
        taken = heard(port)
        assert taken == [setpoint(sequence, None)] + [b""] * MAX_DATAGRAMS


def test_one_tick_takes_no_more_than_twice_its_share(port, planner, stranger):
    for _ in range(2 * MAX_DATAGRAMS):
        planner.send(setpoint(2))
        stranger.send(b"x")
    assert len(heard(port)) == 2 * MAX_DATAGRAMS


def test_another_planner_with_the_key_takes_its_place(port, planner, stranger):
    with Sender(port) as successor:
        successor.send(setpoint(2))
        assert heard(port) == [setpoint(2, None)]
        for _ in range(FLOOD):
            stranger.send(b"x")
        successor.send(setpoint(3))
        assert heard(port)[0] == setpoint(3, None)


@pytest.mark.parametrize("key", [None, KEY, KEY[::-1]])
def test_stop_is_heard_from_anyone_and_moves_no_planner_from_its_place(port, planner, stranger, key: bytes | None):
    stranger.send(encode(decode(STOP), key))
    assert heard(port) == [STOP]
    for _ in range(FLOOD):
        stranger.send(b"x")
    planner.send(setpoint(2))
    assert heard(port)[0] == setpoint(2, None)


def test_who_sends_without_the_key_is_counted_and_named(port, planner, stranger):
    assert port.strangers_text() == ""
    for _ in range(3):
        stranger.send(setpoint(2, KEY[::-1]))
    heard(port)
    assert numbers_in(port.strangers_text()) == [3.0, stranger.getsockname()[1]]


def test_nobody_else_may_listen_there(port):
    with pytest.raises(LinkError, check=coded("udp.port-in-use")):
        listen(port.address[1])
    for option in (socket.SO_REUSEPORT, socket.SO_REUSEADDR):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
            thief.setsockopt(socket.SOL_SOCKET, option, 1)
            with pytest.raises(OSError, match="in use"):
                thief.bind(port.address)
