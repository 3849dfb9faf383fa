"""Datagrams at the PLC: sessions, numbers that never come again, stale echoes, strangers, keys, illegal values."""

from __future__ import annotations

from itertools import count

import pytest

from can_dbc.plc.datagram import Header, encode_command
from can_dbc.plc.map import Bounds, Command, Fault, Grapple, Mode, WordOrder
from sim.plc.command_arbiter import MS, CommandArbiter

MOVE = Command(Mode.VALVES, True, (0.5, -0.25, 0, 0, 0, 0, 0), grapple=Grapple.HOLD, grapple_pct=20)
ILLEGAL = Command(Mode.REFERENCES, True)
US, THEM = ("127.0.0.1", 5), ("127.0.0.1", 6)
KEY = b"a key of sixteen"
FIRST = 1_000


class Bridge:
    """The other end: numbers its datagrams, echoes the PLC's, and remembers all of them."""

    def __init__(self, arbiter: CommandArbiter, client: tuple[str, int] = US, key: bytes | None = None) -> None:
        self.arbiter, self.client, self.key = arbiter, client, key
        self.session = self.echo = 0
        self.sequence = FIRST
        self.sent: list[bytes] = []

    def hello(self, now_ns: int) -> Header | None:
        self.session = self.echo = 0
        offer = self.send(Command(), now_ns)
        if offer is not None:
            assert offer.echo == self.sequence
            self.session, self.echo = offer.session, offer.sequence
        return offer

    def send(self, command: Command, now_ns: int) -> Header | None:
        self.sequence += 1
        data = encode_command(Header(self.session, self.sequence, 0, self.echo), command, self.key)
        self.sent.append(data)
        return self.arbiter.datagram(self.client, data, now_ns)

    def exchange(self, command: Command, now_ns: int) -> bool:
        """Whether the command is accepted; then the PLC's next reply arrives."""
        before = self.arbiter.accepted
        self.send(command, now_ns)
        if self.arbiter.accepted == before:
            return False
        self.echo = self.arbiter.session.reply_header(now_ns).sequence
        return True


def arbiter(key: bytes | None = None) -> CommandArbiter:
    numbers = count(500)
    return CommandArbiter(Bounds.valves(), WordOrder.HIGH_FIRST, lambda: next(numbers), key)


def moving() -> tuple[CommandArbiter, Bridge]:
    """A PLC that follows commands until 100 ms."""
    plc = arbiter()
    bridge = Bridge(plc)
    bridge.hello(0)
    for ms in range(10, 101, 10):
        assert bridge.exchange(Command() if ms == 10 else MOVE, ms * MS)
    return plc, bridge


def test_a_hello_gets_a_session_and_moves_nothing() -> None:
    plc = arbiter()
    bridge = Bridge(plc)
    offer = bridge.hello(0)
    assert offer is not None and offer.session == 500 and plc.session.number == 0 and plc.accepted == 0
    assert bridge.exchange(Command(), 10 * MS)
    assert plc.session.number == 500 and plc.commander(10 * MS) == US
    assert bridge.exchange(MOVE, 20 * MS) and plc.command == MOVE


def test_a_session_does_not_begin_with_an_armed_command() -> None:
    plc = arbiter()
    bridge = Bridge(plc)
    bridge.hello(0)
    assert not bridge.exchange(MOVE, 10 * MS)
    assert not bridge.exchange(Command(reset=True), 20 * MS)
    assert plc.session.number == 0 and plc.command == Command()


@pytest.mark.parametrize("silence_ms", [10, 51, 5_000])
def test_a_recorded_datagram_is_refused_after_any_silence(silence_ms: int) -> None:
    """After 50 ms a client used to begin with any number."""
    plc, bridge = moving()
    now_ns = (100 + silence_ms) * MS
    if silence_ms > 300:  # the program ends the command then
        plc.release()
    accepted, command = plc.accepted, plc.command
    for n, data in enumerate(bridge.sent):
        offer = plc.datagram(US, data, now_ns)
        assert (offer is None) is (n > 0), "the first one was a hello: it gets an offer, which commands nothing"
    assert (plc.accepted, plc.command) == (accepted, command)
    assert plc.replayed == len(bridge.sent) - 1


def test_a_session_goes_on_after_a_short_silence_with_greater_numbers() -> None:
    plc, bridge = moving()
    bridge.echo = plc.session.reply_header(200 * MS).sequence
    assert bridge.exchange(MOVE, 210 * MS)
    bridge.sequence -= 2
    assert not bridge.exchange(MOVE, 220 * MS) and plc.replayed == 1


def test_a_command_that_echoes_an_old_reply_is_old_itself() -> None:
    """A queue on the way delays commands in order, and their numbers are new."""
    plc, bridge = moving()
    for ms in range(110, 161, 10):
        plc.session.reply_header(ms * MS)  # on their way
    assert bridge.exchange(MOVE, 150 * MS)
    bridge.echo -= 7
    assert not bridge.exchange(MOVE, 160 * MS) and plc.replayed == 1
    bridge.echo = 10_000
    assert not bridge.exchange(MOVE, 161 * MS), "a reply that was never sent"


def test_another_session_begins_only_with_a_new_number() -> None:
    plc, bridge = moving()
    plc.release()
    assert plc.session.number == 0 and not bridge.exchange(Command(), 450 * MS)
    first = bridge.sent[:]
    assert bridge.hello(460 * MS) is not None and bridge.session == 501
    assert bridge.exchange(Command(), 470 * MS) and bridge.exchange(MOVE, 480 * MS)
    for data in first:
        plc.datagram(US, data, 490 * MS)
    assert plc.command == MOVE and plc.session.number == 501, "offers do not end the open session"
    assert bridge.exchange(MOVE, 490 * MS)


def test_a_restarted_bridge_and_a_restarted_plc_need_a_new_session() -> None:
    plc, bridge = moving()
    again = Bridge(plc)
    again.session, again.sequence = bridge.session, bridge.sequence  # it would have to guess both, and a fresh echo
    assert not again.exchange(MOVE, 110 * MS)
    restarted = arbiter()
    restarted.session.greet(THEM, Header(0, 1, 0, 0), 0)
    for data in bridge.sent:
        restarted.datagram(US, data, 110 * MS)
    assert restarted.accepted == 0


def test_strangers_get_neither_a_session_nor_a_fault_while_one_commands() -> None:
    plc, bridge = moving()
    stranger = Bridge(plc, THEM)
    assert stranger.hello(110 * MS) is None
    stranger.session, stranger.echo, stranger.sequence = bridge.session, bridge.echo, bridge.sequence
    assert not stranger.exchange(Command(), 111 * MS)
    stranger.send(ILLEGAL, 112 * MS)
    assert plc.fault is Fault.NONE and plc.command == MOVE and plc.dropped == 3
    assert plc.replayed == 0


def test_damaged_datagrams_are_dropped_and_illegal_values_are_a_fault() -> None:
    plc, bridge = moving()
    data = encode_command(Header(bridge.session, bridge.sequence + 1, 0, bridge.echo), Command())
    for damaged in (data[:-1], bytes((*data[:-1], data[-1] ^ 1)), b""):
        assert plc.datagram(US, damaged, 110 * MS) is None
    assert (plc.dropped, plc.fault, plc.command) == (3, Fault.NONE, MOVE)
    bridge.send(ILLEGAL, 111 * MS)
    assert plc.fault is Fault.ILLEGAL_VALUE and plc.refused == 1
    assert bridge.exchange(MOVE, 112 * MS)


def test_without_the_key_nothing_is_accepted() -> None:
    plc = arbiter(KEY)
    assert Bridge(plc).hello(0) is None and plc.dropped == 1
    assert Bridge(plc, key=b"another key of 16").hello(0) is None and plc.dropped == 2
    ours = Bridge(plc, key=KEY)
    assert ours.hello(0) is not None and ours.exchange(Command(), 10 * MS) and ours.exchange(MOVE, 20 * MS)
