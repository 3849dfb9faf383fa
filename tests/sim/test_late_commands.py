"""Commands that a node must not execute: late ones in order and with good checksums, repeated, lost, masqueraded.

Catalogue entries 7, 8, 9, 10 and 11 of docs/reference/safety.md section 5, at the nodes that execute commands.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from can_dbc.dbc.codec import Database, load
from can_dbc.protocols.e2e import Sender, frame_crc
from machine.loading.profile_file import load_profile
from sim.nodes.mach0 import ArmNode, ArmState, VehicleFault, VehicleNode
from sim.nodes.valve import ExitCode, ValveInputs, ValveNode, ValveState

MS = 1_000_000
STEP_NS = 2_500_000
ARMED = 0xA
CRANE, MACHINE = load("crane"), load("machine")
CARRIER = load_profile("aoro_fc8").carrier
assert CARRIER is not None
Message = tuple[str, tuple[float, ...]]
ALIVE: list[Message] = [("GuardAlive", (ARMED, 0, 15, 0))]


class Line:
    """A node behind a line that delays the frames of its commander; frames keep their order."""

    def __init__(
        self, node, database: Database, period_ns: int, commands: list[Message], punctual: list[Message]
    ) -> None:
        self.node = node
        self.now_ns = 1_000 * MS
        self.delay_ns = self.age_ns = 0  # of a command sent now; of the newest one received
        self.disarmed = False
        self.damage: Callable[[int, int, bytes], list[bytes]] = lambda n, key, data: [data]
        """What becomes of a commander's frame: its number, key and data in, the frames that arrive out."""
        self._count = 0
        self._database, self._period_ns = database, period_ns
        self._commands, self._punctual = commands, punctual
        self._senders: dict[str, Sender] = {}
        self._travelling: list[tuple[int, int, int, bytes]] = []  # arrival, sent, key, data
        self._due_ns = self.now_ns

    def _frame(self, name: str, values: tuple[float, ...]) -> tuple[int, bytes]:
        codec = self._database.message(name)
        sender = self._senders.setdefault(name, Sender(codec.data_ids or bytes(16)))
        key_at = codec.index.get("ArmKey", -1) - 2
        shown = tuple(0 if self.disarmed and i == key_at else value for i, value in enumerate(values))
        return codec.key, sender.protect(codec.encode(0, 0, *shown))

    def step(self) -> None:
        self.now_ns += STEP_NS
        if self.now_ns >= self._due_ns:
            self._due_ns += self._period_ns
            for name, values in self._punctual:
                self.node.receive(*self._frame(name, values), self.now_ns)
            self._count += 1
            for name, values in self._commands:
                key, data = self._frame(name, values)
                arrives_ns = self.now_ns + self.delay_ns
                for damaged in self.damage(self._count, key, data):
                    self._travelling.append((arrives_ns, self.now_ns, key, damaged))
        while self._travelling and self._travelling[0][0] <= self.now_ns:
            _, sent_ns, key, data = self._travelling.pop(0)
            self.age_ns = self.now_ns - sent_ns
            self.node.receive(key, data, self.now_ns)
        if isinstance(self.node, ValveNode):
            self.node.sync(self.now_ns)
        self.node.decide(self.now_ns)

    def run(self, ms: float, per_ms: float = 0.0) -> None:
        """``per_ms``: by how much the delay grows meanwhile."""
        for _ in range(round(ms * MS / STEP_NS)):
            self.delay_ns += round(per_ms * STEP_NS)
            self.step()


def valve() -> Line:
    node = ValveNode(CRANE, [], lambda: True, ValveInputs)
    commands = [("ValveCmdA", (2, 60.0, 0.0, 0.0, 0.0)), ("ValveCmdB", (ARMED, 0.0, 0.0, 0.0, 0, 1, 100.0))]
    return Line(node, CRANE, 5 * MS, commands, [("GuardStat", (ARMED, 0, 15, 0, 0, 0))])


def vehicle() -> Line:
    return Line(
        VehicleNode(MACHINE, [], CARRIER, lambda: True), MACHINE, 20 * MS, [("VehCmd", (ARMED, 0.0, 0.6, 0.0))], ALIVE
    )


def arms() -> Line:
    commands = [("ArmCmdA", (ARMED, 50.0, 0.0, 0.0, 0.0)), ("ArmCmdB", (ARMED, 0, 0))]
    return Line(ArmNode(MACHINE, [], lambda: True), MACHINE, 20 * MS, commands, ALIVE)


@pytest.fixture(params=[valve, vehicle, arms])
def line(request: pytest.FixtureRequest) -> Line:
    """Each node, which its commander has moved for 200 ms."""
    made: Line = request.param()
    made.run(200)
    assert moves(made)
    return made


def moves(line: Line) -> bool:
    node = line.node
    if isinstance(node, ValveNode):
        return any(node.outputs_pct)
    return node.drive_m_s != 0.0 if isinstance(node, VehicleNode) else any(node.spools)


def timed_out(line: Line) -> bool:
    node = line.node
    if isinstance(node, ValveNode):
        return (node.exit, node.valve_state) == (ExitCode.COMMAND_TIMEOUT, ValveState.FAULT)
    return node.fault is VehicleFault.COMMAND_TIMEOUT if isinstance(node, VehicleNode) else node.state is ArmState.FAULT


def test_commands_that_are_delayed_by_60_ms_in_order_are_not_executed(line: Line) -> None:
    """The delay grows slowly, as behind a queue that fills; no gap is long enough to be a time-out."""
    line.run(300, per_ms=0.2)
    line.run(100)
    assert line.delay_ns == 60 * MS and not moves(line) and timed_out(line)
    line.run(500)
    assert not moves(line)


def test_a_node_is_neutral_within_100_ms_of_the_command_that_came_too_late(line: Line) -> None:
    while line.age_ns <= 40 * MS:
        line.run(2.5, per_ms=0.5)
        assert moves(line) or line.age_ns > 40 * MS
    began_ns = line.now_ns
    while moves(line):
        line.run(2.5, per_ms=0.5)
    assert line.now_ns - began_ns <= 100 * MS


def test_commands_that_are_delayed_by_30_ms_are_executed(line: Line) -> None:
    line.run(300, per_ms=0.1)
    line.run(1000)
    assert moves(line)


def test_punctual_commands_move_again_only_after_a_disarm(line: Line) -> None:
    line.run(300, per_ms=0.2)
    line.delay_ns = 0
    line.run(1000)
    assert not moves(line)
    line.disarmed = True
    line.run(100)
    line.disarmed = False
    line.run(100)
    assert moves(line)


def test_repeated_commands_only_grow_old(line: Line) -> None:
    """The same counter again, with a good checksum."""
    kept: dict[int, bytes] = {}
    line.damage = lambda n, key, data: [kept.setdefault(key, data)]
    began_ns = line.now_ns
    while moves(line) and line.now_ns < began_ns + 1_000 * MS:
        line.run(2.5)
    assert line.now_ns - began_ns <= 125 * MS, "the first of them was new, one period after the begin"
    line.run(500)
    assert not moves(line)


def test_a_single_lost_or_corrupt_command_is_tolerated(line: Line) -> None:
    line.damage = lambda n, key, data: [] if n % 40 == 0 else [data[:-1] + b"\xff"] if n % 40 == 20 else [data]
    for _ in range(800):
        line.step()
        assert moves(line)


def with_checksum(data: bytes, data_ids: bytes) -> bytes:
    return bytes((frame_crc(data, data_ids),)) + data[1:]


FOREIGN = CRANE.message("EstopStat").data_ids or b""


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda n, key, data: [data] if n % 4 == 0 else [], id="three of four lost"),
        pytest.param(lambda n, key, data: [with_checksum(data, FOREIGN)], id="the data id of another message"),
        pytest.param(lambda n, key, data: [bytes((data[0] ^ 0x40,)) + data[1:]], id="a wrong checksum"),
        pytest.param(lambda n, key, data: [data[:5]], id="cut short"),
    ],
)
def test_damaged_commands_are_not_executed(line: Line, damage: Callable[[int, int, bytes], list[bytes]]) -> None:
    line.damage = damage
    for ms in (200, 500):
        line.run(ms)
        assert not moves(line)
