"""Authority: only who may write to the operator's socket arms; STOP is heard from anyone, the operator's first."""

import tempfile
from pathlib import Path

import pytest

from can_dbc.messages import operator_link
from can_dbc.messages.crane import OperatorAction
from controller.requests.operator_socket import COMMAND_BYTES, OperatorSocket
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import Bench


@pytest.fixture
def path():
    """A place that any user may reach, as pytest's own are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name, "operator")


def received(operator):
    commands = []
    operator.receive(commands)
    return commands


def test_commands_arrive_in_order_and_what_is_too_long_is_cut(path):
    operator = OperatorSocket(path)
    operator_link.send(b"x" * (COMMAND_BYTES + 9), path)
    operator_link.send(b"more", path)
    assert received(operator) == [b"x" * COMMAND_BYTES, b"more"] and received(operator) == []
    operator.close()
    assert not path.exists()


def test_the_whole_queue_is_heard_in_one_tick(path):
    operator, sent = OperatorSocket(path), 0
    with pytest.raises(BlockingIOError):
        for sent in range(1000):
            operator_link.send(b"%d" % sent, path)
    assert len(received(operator)) == sent
    operator.close()


def test_a_restarted_controller_takes_the_path_over(path):
    first = OperatorSocket(path)
    second = OperatorSocket(path)
    first.close()
    operator_link.send(b"hello", path)
    assert received(second) == [b"hello"]
    second.close()
    with pytest.raises(OSError):
        operator_link.send(b"hello", path)


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
