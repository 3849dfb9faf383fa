"""The emulated PLC's command arbiter: split writes, sequence, one commander, watchdog, illegal values, datagrams."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.plc.map import Bounds, Command, Fault, Grapple, Mode, WordOrder, command_registers
from can_dbc.plc.modbus import RegisterRefused
from sim.plc.command_arbiter import MAX_DRAFT_COUNT, MS, CommandArbiter

ORDER = WordOrder.HIGH_FIRST
MOVE = Command(Mode.VALVES, True, (0.5, -0.25, 0, 0, 0, 0, 0), grapple=Grapple.HOLD, grapple_pct=20)
US, THEM = 1, 2


def arbiter() -> CommandArbiter:
    return CommandArbiter(Bounds.valves(), ORDER)


@pytest.fixture
def g() -> CommandArbiter:
    return arbiter()


def block(sequence: int, command: Command = MOVE, heartbeat: int | None = None) -> list[int]:
    return command_registers(command, sequence if heartbeat is None else heartbeat, sequence, ORDER)


def state(g: CommandArbiter) -> tuple[object, ...]:
    return g.command, g.sequence, g.accepted, g.command_block(), g.watchdog_ms


def refused(g: CommandArbiter, client: int, address: int, values: list[int], now_ns: int = 0) -> int:
    before = state(g)
    with pytest.raises(RegisterRefused) as refusal:
        g.write(client, address, values, now_ns)
    assert state(g) == before, "a refused write changed something"
    return refusal.value.code


def test_a_whole_block_is_accepted_once_per_sequence_number(g: CommandArbiter) -> None:
    g.write(US, 100, block(7), 0)
    assert (g.command, g.sequence, g.accepted) == (MOVE, 7, 1)
    g.write(US, 100, block(7, Command()), 1)
    g.write(US, 100, block(6, Command()), 2)
    assert (g.command, g.accepted) == (MOVE, 1), "a number that does not advance must not count"
    g.write(US, 100, block(8, Command()), 3)
    assert (g.command, g.accepted) == (Command(), 2)


def test_the_sequence_number_wraps(g: CommandArbiter) -> None:
    g.write(US, 100, block(0xFFFF), 0)
    g.write(US, 100, block(0, Command()), 1)
    assert g.command == Command()


@settings(max_examples=50)
@given(st.lists(st.integers(1, 31), unique=True).map(sorted), st.booleans())
def test_a_split_write_is_accepted_with_its_sequence_number(cuts: list[int], one_by_one: bool) -> None:
    """However a client splits the block, register 101 commits it as a whole."""
    g, words = arbiter(), block(3)
    edges = list(range(33)) if one_by_one else [0, *cuts, 32]
    pieces = [(a, words[a:b]) for a, b in pairwise(edges)]
    later = [(a, w) for a, w in pieces if not a <= 1 < a + len(w)]
    for at, piece in later:
        g.write(US, 100 + at, piece, 0)
        assert g.accepted == 0 and g.command == Command()
    commit = next((a, w) for a, w in pieces if a <= 1 < a + len(w))
    g.write(US, 100 + commit[0], commit[1], 0)
    assert (g.accepted, g.command) == (1, MOVE)


def test_two_clients_do_not_complete_each_others_writes() -> None:
    g, words = arbiter(), block(3)
    g.write(US, 102, words[2:], 0)
    g.write(THEM, 101, [9], 0)
    assert g.command == Command(), "a bare sequence number of a stranger commits the stranger's own neutral block"


@pytest.mark.parametrize(
    ("register", "value"), [(102, 9), (102, 1), (103, 1), (125, 4), (126, 101), (127, 999), (128, 7), (130, 1)]
)
def test_an_illegal_value_is_exception_3_and_changes_nothing(g: CommandArbiter, register: int, value: int) -> None:
    g.write(US, 100, block(1), 0)
    words = block(2)
    words[register - 100] = value
    assert refused(g, US, 100, words) == 3
    assert g.fault is Fault.ILLEGAL_VALUE and g.refused == 1
    g.write(US, 100, block(2), 0)
    assert g.accepted == 2, "the number of a refused command is not used up"
    assert g.fault is Fault.ILLEGAL_VALUE, "the fault stays until a reset"
    g.write(US, 100, block(3, Command(reset=True)), 0)
    assert g.take_reset_edge() and not g.take_reset_edge()
    assert g.fault is Fault.NONE


def test_an_illegal_reference_names_its_axis_at_the_commit(g: CommandArbiter) -> None:
    g.write(US, 100, block(1), 0)
    too_far = block(2, Command(Mode.VALVES, True, (0.0, 0.0, 1.000_001 + 1e-6, 0, 0, 0, 0)))
    g.write(US, 102, too_far[2:], 0)  # unfinished: no harm yet
    assert refused(g, US, 101, [2]) == 3
    assert (g.fault, g.fault_axis) == (Fault.ILLEGAL_VALUE, 2)


@pytest.mark.parametrize(
    ("address", "count"), [(0, 1), (10, 1), (12, 4), (48, 1), (99, 2), (99, 32), (131, 2), (132, 1), (11, 2)]
)
def test_a_write_to_another_address_is_exception_2(g: CommandArbiter, address: int, count: int) -> None:
    assert refused(g, US, address, [0] * count) == 2
    assert g.fault is Fault.NONE


def test_the_commander_keeps_the_command_until_the_watchdog_expires(g: CommandArbiter) -> None:
    g.write(US, 100, block(500), 0)
    assert refused(g, THEM, 100, block(501), 100 * MS) == 6
    assert refused(g, THEM, 125, [1], 100 * MS) == 6
    assert refused(g, THEM, 11, [500], 100 * MS) == 6
    assert g.fault is Fault.NONE, "a stranger cannot set a fault either"
    assert g.commander(300 * MS) == US and g.commander(301 * MS) is None
    g.write(THEM, 100, block(2, Command()), 301 * MS)
    assert (g.commander(301 * MS), g.sequence) == (THEM, 2), "a new commander begins with its own numbers"


def test_a_disconnected_commander_is_replaced_at_once(g: CommandArbiter) -> None:
    g.write(US, 100, block(500), 0)
    g.disconnected(THEM)
    assert refused(g, THEM, 100, block(3), 10 * MS) == 6
    g.disconnected(US)
    assert (g.commander(10 * MS), g.command) == (US, MOVE), "what was commanded stands until the watchdog"
    g.write(THEM, 100, block(3, Command()), 10 * MS)
    assert (g.commander(10 * MS), g.command) == (THEM, Command())
    assert refused(g, US, 100, block(501), 20 * MS) == 6


def test_only_a_changing_heartbeat_feeds_the_watchdog(g: CommandArbiter) -> None:
    g.write(US, 100, block(1, heartbeat=10), 0)
    g.write(US, 100, [11], 250 * MS)
    assert g.commander(500 * MS) == US
    g.write(US, 100, [11], 540 * MS)
    assert g.commander(551 * MS) is None
    assert g.age_ns(500 * MS) == 500 * MS, "a heartbeat makes no command younger"


@pytest.mark.parametrize(("value", "code"), [(49, 3), (2001, 3), (0, 3)])
def test_the_watchdog_register_is_bounded(g: CommandArbiter, value: int, code: int) -> None:
    assert refused(g, US, 11, [value]) == code
    g.write(US, 11, [50], 0)
    g.write(US, 100, block(1), 0)
    assert g.commander(51 * MS) is None


def test_drafts_of_many_clients_use_bounded_memory(g: CommandArbiter) -> None:
    for client in range(1000):
        g.write(client, 127, [50], 0)
    assert len(g._drafts) == MAX_DRAFT_COUNT
