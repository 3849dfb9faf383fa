"""Authority: only operators arm, and the kernel says who sent a command; STOP is heard from anyone."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from can_dbc.messages import operator_link
from can_dbc.messages.crane import OperatorAction
from controller.requests.operator_socket import COMMAND_BYTES, MAX_COMMANDS, OperatorSocket
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import Bench

NOBODY = 65534
SEND_AS = (
    "import os, socket, sys\n"
    "os.setuid(int(sys.argv[1]))\n"
    "socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(bytes.fromhex(sys.argv[2]), sys.argv[3])\n"
)


@pytest.fixture
def path():
    """A place that any user may reach, as pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name, "operator")


def received(operator):
    commands, others = [], []
    operator.receive(commands, others)
    return commands, others


def test_the_own_user_is_an_operator_and_another_is_not(path):
    operator = OperatorSocket(path)
    operator_link.send(b"mine", path)
    assert received(operator) == ([b"mine"], [])
    if os.getuid() == 0:
        subprocess.run([sys.executable, "-c", SEND_AS, str(NOBODY), b"theirs".hex(), path], check=True)
        assert received(operator) == ([], [b"theirs"])
    operator.close()
    assert not path.exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can send as another user")
def test_a_user_that_was_named_is_an_operator(path):
    operator = OperatorSocket(path, frozenset({NOBODY}))
    subprocess.run([sys.executable, "-c", SEND_AS, str(NOBODY), b"theirs".hex(), path], check=True)
    assert received(operator) == ([b"theirs"], [])
    operator.close()


def test_a_tick_takes_a_few_commands_and_cuts_what_is_too_long(path):
    operator = OperatorSocket(path)
    operator_link.send(b"x" * (COMMAND_BYTES + 9), path)
    for _ in range(MAX_COMMANDS):
        operator_link.send(b"more", path)
    commands, _ = received(operator)
    assert len(commands) == MAX_COMMANDS and commands[0] == b"x" * COMMAND_BYTES
    assert received(operator) == ([b"more"], []) and received(operator) == ([], [])
    operator.close()


def test_a_restarted_controller_takes_the_path_over(path):
    first = OperatorSocket(path)
    second = OperatorSocket(path)
    first.close()
    operator_link.send(b"hello", path)
    assert received(second) == ([b"hello"], [])
    second.close()
    with pytest.raises(OSError):
        operator_link.send(b"hello", path)


@pytest.mark.parametrize("action", [OperatorAction.ARM, OperatorAction.DISARM, OperatorAction.RESET])
def test_a_planner_cannot_arm_disarm_or_reset(action):
    bench = Bench().boot() if action is OperatorAction.ARM else Bench().armed()
    before = bench.mode
    bench.inputs.operator = []
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
