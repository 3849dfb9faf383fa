"""Clients that misbehave: while they do, the rightful one gets an answer to every request, and everything is bounded.

Nothing here looks at a clock but the waits for what has to happen; what is asserted are counts.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator

import pytest

from can_dbc.plc import modbus
from can_dbc.plc.datagram import Header, decode_reply, encode_command
from can_dbc.plc.map import Command, Fault, State
from can_dbc.plc.modbus import MAX_CONNECTIONS, ModbusClient, RegisterRefused
from runtime.errors import LinkError
from sim.plc.command_arbiter import MAX_DRAFT_COUNT
from tests.live.sim.plc_server import LOOPBACK, MOVE, ServedPlc, block

ROUNDS = 60
READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 48)


@pytest.fixture
def plc() -> Iterator[ServedPlc]:
    with ServedPlc() as served:
        yield served


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition; the test's own timeout ends the wait."""
    while not condition():
        time.sleep(0.005)


class Abuser:
    """Raw sockets to a PLC."""

    def __init__(self, plc: ServedPlc) -> None:
        self._port = plc.port
        self.sockets: list[socket.socket] = []

    def connect(self) -> socket.socket:
        made = socket.create_connection((LOOPBACK, self._port), timeout=5.0)
        self.sockets.append(made)
        return made

    def send(self, data: bytes, each: socket.socket) -> None:
        """As much as goes now."""
        each.setblocking(False)
        with contextlib.suppress(OSError):
            each.send(data)


@pytest.fixture
def abuser(plc: ServedPlc) -> Iterator[Abuser]:
    made = Abuser(plc)
    yield made
    for each in made.sockets:
        each.close()


def rightful(plc: ServedPlc, between: Callable[[int], None]) -> int:
    """``ROUNDS`` exchanges, each after an attack; returns how many were answered with their own number."""

    async def run() -> int:
        client, good = ModbusClient(LOOPBACK, plc.port, 5.0), 0
        await client.connect()
        for n in range(1, ROUNDS + 1):
            between(n)
            good += (await client.exchange(block(n)))[9] == n
        client.close()
        return good

    return asyncio.run(run())


def served(plc: ServedPlc, nasty: Callable[[int], None]) -> None:
    """The claim of this file."""
    assert rightful(plc, nasty) == ROUNDS
    assert plc.program.arbiter.accepted == ROUNDS
    assert plc.program.arbiter.fault is Fault.NONE
    assert plc.connections <= MAX_CONNECTIONS
    assert len(plc.program.arbiter._drafts) <= MAX_DRAFT_COUNT


def test_a_cable_cut_in_the_middle_of_a_request(plc: ServedPlc, abuser: Abuser) -> None:
    def nasty(n: int) -> None:
        victim = abuser.connect()
        victim.sendall(READ[: 1 + n % (len(READ) - 1)])
        if n % 2:  # no FIN but a reset
            victim.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        victim.close()

    served(plc, nasty)


def test_greedy_clients_that_flood_and_never_read(plc: ServedPlc, abuser: Abuser) -> None:
    def nasty(n: int) -> None:
        if n <= 20:
            abuser.connect()
        for each in abuser.sockets:
            abuser.send(READ * 100, each)

    served(plc, nasty)
    assert plc.server.counts.evicted >= 20 - MAX_CONNECTIONS


def test_many_half_open_connections(plc: ServedPlc, abuser: Abuser) -> None:
    served(plc, lambda n: None if n > 40 else abuser.connect() and None)
    assert plc.server.counts.evicted >= 40 - MAX_CONNECTIONS


def test_a_slow_client_is_disconnected(plc: ServedPlc, abuser: Abuser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus, "REQUEST_S", 0.3)
    slow = abuser.connect()

    def nasty(n: int) -> None:
        if n <= len(READ) // 2:
            abuser.send(READ[n : n + 1], slow)

    served(plc, nasty)
    until(lambda: plc.server.counts.slow == 1)


def test_an_idle_client_is_disconnected(plc: ServedPlc, abuser: Abuser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus, "IDLE_S", 0.1)
    abuser.connect()
    until(lambda: plc.server.counts.slow == 1)
    assert plc.connections == 0


MALFORMED = [
    struct.pack(">HHHB", 1, 7, 6, 1) + bytes(5),  # another protocol
    struct.pack(">HHHB", 1, 0, 0, 1) + bytes(5),  # no length
    struct.pack(">HHHB", 1, 0, 300, 1) + bytes(300),  # too long
    b"GET / HTTP/1.1\r\nHost: plc\r\n\r\n",
]
ANSWERED = [
    (b"\x5b", 0xDB, 1),  # an unknown function
    (b"\x2b\x0e\x01\x00", 0xAB, 1),
    (b"\x10\x00\x64\x00\x02\x02\x00\x01", 0x90, 3),  # byte count and register count disagree
    (b"\x10\x00\x64\x00\x7c\xf8" + bytes(244), 0x90, 3),  # cut short
    (b"\x03\x00\x00\x00\x7e", 0x83, 3),  # 126 registers
    (b"\x03\x00", 0x83, 3),
    (b"\x17" + bytes(9), 0x97, 3),
    (b"\x83\x02", 0x83, 1),  # an answer, not a request
]


@pytest.mark.parametrize("data", MALFORMED)
def test_bytes_that_are_not_modbus_end_the_connection(plc: ServedPlc, abuser: Abuser, data: bytes) -> None:
    stranger = abuser.connect()
    stranger.sendall(data)
    with contextlib.suppress(ConnectionResetError):
        assert stranger.recv(100) == b""
    assert plc.server.counts.malformed == 1


def test_a_malformed_request_gets_its_exception(plc: ServedPlc, abuser: Abuser) -> None:
    stranger = abuser.connect()
    for pdu, function, code in ANSWERED:
        stranger.sendall(struct.pack(">HHHB", 9, 0, len(pdu) + 1, 1) + pdu)
        assert stranger.recv(100) == struct.pack(">HHHBBB", 9, 0, 3, 1, function, code), pdu.hex()
    served(plc, lambda n: None)


def test_noise_is_survived(plc: ServedPlc, abuser: Abuser) -> None:
    chance = random.Random(4)

    def nasty(n: int) -> None:
        length = chance.randrange(2, 255)
        body = chance.randbytes(length - 1)
        head = struct.pack(">HHHB", n, 0, length, 1) if n % 3 else chance.randbytes(7)
        abuser.send(head + body, abuser.connect())

    served(plc, nasty)


def test_other_clients_may_read_but_not_write_while_one_commands(plc: ServedPlc) -> None:
    async def run() -> None:
        ours, theirs = (ModbusClient(LOOPBACK, plc.port, 5.0) for _ in range(2))
        await ours.connect()
        await theirs.connect()
        for n in range(1, ROUNDS + 1):
            assert (await ours.exchange(block(n)))[9] == n
            with pytest.raises(RegisterRefused) as refused:
                await theirs.exchange(block(n + 1000))
            assert refused.value.code == RegisterRefused.BUSY
            assert (await theirs.status())[9] == n
        ours.close()
        theirs.close()

    asyncio.run(run())
    assert plc.program.arbiter.accepted == ROUNDS and plc.program.arbiter.fault is Fault.NONE


class Cable:
    """A proxy between client and PLC that can stop forwarding silently."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.whole = True
        self.held = 0

    async def start(self) -> int:
        self._server = await asyncio.start_server(self._plugged, LOOPBACK, 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def _plugged(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection(LOOPBACK, self._port)
        await asyncio.gather(self._carry(reader, far_writer), self._carry(far_reader, writer))

    async def _carry(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        try:
            while data := await source.read(4096):
                if self.whole:
                    sink.write(data)
                else:
                    self.held += len(data)
        except OSError:
            pass
        if self.whole:
            sink.close()


def test_a_half_open_connection_is_detected_and_abandoned(plc: ServedPlc) -> None:
    """The far end of a dead connection still commands until the watchdog; the PLC is then SAFE, and latched."""

    async def run() -> None:
        cable = Cable(plc.port)
        client = ModbusClient(LOOPBACK, await cable.start(), 0.2)
        await client.connect()
        assert (await client.exchange(block(1)))[9] == 1
        cable.whole = False
        with pytest.raises(LinkError):
            await client.exchange(block(2))
        assert not client.connected and cable.held > 0
        cable.whole = True
        await client.connect()
        status = await client.status()
        while status[5] != State.SAFE:
            status = await client.status()
        assert (status[6], status[9]) == (Fault.WATCHDOG, 1)
        assert (await client.exchange(block(1)))[9] == 1, "a new conversation begins with its own numbers"
        client.close()

    asyncio.run(run())
    assert plc.program.arbiter.accepted == 2


def test_closing_discards_the_kernels_buffer(plc: ServedPlc) -> None:
    async def run() -> bytes:
        client = ModbusClient(LOOPBACK, plc.port, 1.0)
        await client.connect()
        assert client._client is not None
        sock = client._client.ctx.transport.get_extra_info("socket")
        option: bytes = sock.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)
        client.close()
        return option

    assert struct.unpack("ii", asyncio.run(run())) == (1, 0)


class Datagrams:
    """A bridge's end of the datagrams: asks for a session, and echoes the PLC's numbers."""

    def __init__(self, plc: ServedPlc) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(5.0)
        self.socket.connect((LOOPBACK, plc.udp_port))
        self.number = 100
        self.session = self.echo = 0
        self.sent: list[bytes] = []

    def send(self, command: Command) -> None:
        self.number += 1
        self.sent.append(encode_command(Header(self.session, self.number, 0, self.echo), command))
        self.socket.send(self.sent[-1])

    def answered(self) -> None:
        """Wait for the answer to the newest command."""
        while (header := decode_reply(self.socket.recv(200))[0]).echo != self.number:
            pass
        self.session, self.echo = header.session, header.sequence

    def begin(self) -> None:
        """A session, and its first command."""
        for _ in range(2):
            self.send(Command())
            self.answered()


@pytest.fixture
def bridge(plc: ServedPlc) -> Iterator[Datagrams]:
    made = Datagrams(plc)
    yield made
    made.socket.close()


def test_datagrams_from_everywhere_do_not_disturb_the_commander(plc: ServedPlc, bridge: Datagrams) -> None:
    bridge.begin()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs:
        theirs.connect((LOOPBACK, plc.udp_port))
        chance = random.Random(5)
        for n in range(1, ROUNDS + 1):
            theirs.send(encode_command(Header(bridge.session, bridge.number + 1, 0, bridge.echo), Command()))
            theirs.send(encode_command(Header(0, n, 0, 0), Command()))
            theirs.send(chance.randbytes(100))
            theirs.send(bridge.sent[-1][:-1])
            bridge.send(MOVE)
            bridge.answered()
    arbiter = plc.program.arbiter
    assert arbiter.accepted == ROUNDS + 1 and arbiter.fault is Fault.NONE and arbiter.command == MOVE
    assert arbiter.dropped == 4 * ROUNDS and arbiter.replayed == 0


def test_recorded_datagrams_are_refused_and_counted_after_a_silence(plc: ServedPlc, bridge: Datagrams) -> None:
    """From the same address: 60 ms later in the open session, and after the PLC has ended it."""
    bridge.begin()
    for _ in range(ROUNDS):
        bridge.send(MOVE)
        bridge.answered()
    arbiter, recorded = plc.program.arbiter, bridge.sent[1:]  # without the hello
    time.sleep(0.06)
    for data in recorded:
        bridge.socket.send(data)
    until(lambda: arbiter.replayed == len(recorded))
    assert arbiter.accepted == ROUNDS + 1
    until(lambda: plc.program.state is State.SAFE)
    for data in recorded:
        bridge.socket.send(data)
    until(lambda: arbiter.replayed == 2 * len(recorded))
    assert arbiter.accepted == ROUNDS + 1 and arbiter.command == Command() and arbiter.dropped == 0
    bridge.session = bridge.echo = 0
    bridge.begin()
    assert arbiter.accepted == ROUNDS + 2
