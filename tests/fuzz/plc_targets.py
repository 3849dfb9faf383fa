"""The PLC path: datagrams and Modbus in both directions."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Hashable
from typing import Any

from pymodbus.client import AsyncModbusTcpClient

from can_dbc.plc import map as plc
from can_dbc.plc import modbus
from can_dbc.plc.datagram import Header, decode_command, decode_reply, encode_command, encode_reply
from can_dbc.plc.map import COMMAND_COUNT, STATUS_COUNT, Bounds, Command, Feedback, MapError, Mode, State, WordOrder
from can_dbc.plc.modbus import ModbusClient, RegisterRefused
from controller.plc.handshake import Handshake
from runtime.errors import InputRefused, LinkError
from sim.plc.command_arbiter import CommandArbiter
from tests.fuzz.engine import Run, Target, coded, outcome
from tests.fuzz.message_targets import with_crc

MS = 1_000_000
ORDER = WordOrder.HIGH_FIRST
FEEDBACK = Feedback(7, State.EXECUTE, estop=7, position=(0.1,) * 7, velocity=(0.2,) * 7, pressure_bar=(100.0,) * 8)
COMMAND = Command(Mode.VALVES, True, (0.5,) * 5 + (0.0, 0.0))


def datagrams() -> list[bytes]:
    """Replies of a PLC and commands to it, numbered."""
    return [
        *(encode_reply(Header(7, n, 1000 * n & 0xFFFF_FFFF, n), FEEDBACK) for n in (1, 2, 3, 0xFFFF_FFFF)),
        *(encode_command(Header(7, n, 1000 * n, n), COMMAND) for n in (1, 2, 3)),
        encode_command(Header(7, 9, 1, 1), Command()),
    ]


def start_datagrams() -> Run:
    shake, arbiter = Handshake(ORDER), CommandArbiter(Bounds.valves(), ORDER)
    now_ns = 10**9

    def run(data: bytes) -> Hashable:
        nonlocal now_ns
        now_ns += 10 * MS
        refusals = (InputRefused, MapError)
        found = [outcome(refusals, what, data) for what in (decode_reply, decode_command)]
        shake.datagram(COMMAND, now_ns)
        found.append(shake.accept_datagram(data, now_ns))
        arbiter.datagram("bridge", data, now_ns)
        found.append(arbiter.fault)
        if arbiter.accepted:
            Bounds.valves().check(arbiter.command)
        return tuple(found)

    return run


def block(registers: list[int]) -> bytes:
    """Registers as on the wire."""
    return struct.pack(f">{len(registers)}H", *registers)


def answers() -> list[bytes]:
    """Modbus/TCP answers: FC 23 and FC 3 with the status block, exceptions, and one in two pieces."""
    status = block(plc.status_registers(FEEDBACK, 300, ORDER))
    pdus = [bytes((code, len(status))) + status for code in (23, 3)]
    pdus += [bytes((0x80 | code, exception)) for code in (23, 3) for exception in (1, 2, 3, 6, 11)]
    pdus += [b"\x17\x02\x00\x00", b"\x01\x01\x00", b"\x2b\x0e\x01\x01\x00\x00\x00"]
    return [struct.pack(">HHHB", 1, 0, len(pdu) + 1, modbus.UNIT) + pdu for pdu in pdus]


class _Wire(asyncio.Transport):
    """A transport that answers each request with given bytes, as the event loop would deliver them."""

    def __init__(self, protocol: Any) -> None:
        super().__init__()
        self._protocol = protocol
        self.answer = b""
        self.failed = False

    def write(self, data: Any) -> None:
        try:
            self._protocol.data_received(self.answer)
        except Exception:  # noqa: BLE001 - asyncio closes a connection whose protocol raises, whatever it raises
            self.failed = True

    def is_closing(self) -> bool:
        return False

    def close(self) -> None:
        pass

    abort = close


def start_answers() -> Run:
    """The real client; an answer that does not complete the request is a time-out, without the waiting."""
    loop = asyncio.new_event_loop()
    shake = Handshake(ORDER)
    now_ns = 10**9
    made: list[Any] = []

    async def connect() -> None:
        inner = AsyncModbusTcpClient("127.0.0.1", port=1, timeout=0, retries=0, reconnect_delay=0)
        inner.ctx.comm_params.timeout_connect = 0.0
        wire = _Wire(inner.ctx)
        inner.ctx.transport = wire
        client = ModbusClient("127.0.0.1", 1, 0.1)
        client._client = inner
        made[:] = client, inner, wire

    async def exchange(data: bytes) -> Hashable:
        nonlocal now_ns
        now_ns += 10 * MS
        if not made or not made[0].connected:
            await connect()
        client, inner, wire = made
        inner.ctx.next_tid = 0
        wire.answer = data
        try:
            registers = await client.exchange(shake.registers(COMMAND, now_ns))
        except LinkError as error:
            made.clear()
            return coded(error)
        except RegisterRefused as refused:
            assert 0 <= refused.code <= 255 and str(refused)
            shake.command_refused(refused.code)
            return refused.code
        assert len(registers) == STATUS_COUNT and all(0 <= r <= 0xFFFF for r in registers)
        if shake.accept_registers(registers, now_ns):
            assert shake.feedback is not None
            return shake.feedback.state
        return shake.problem.split(" ")[0]

    return lambda data: loop.run_until_complete(exchange(data))


class _Registers:
    """The registers of an emulated PLC, with a commander that changes."""

    def __init__(self) -> None:
        self.arbiter = CommandArbiter(Bounds.valves(), ORDER)
        self.now_ns = 10**9

    def read(self, address: int, count: int) -> list[int]:
        status = plc.status_registers(FEEDBACK, self.arbiter.watchdog_ms, ORDER)
        whole = status + [0] * (plc.COMMAND_AT - len(status)) + self.arbiter.command_block()
        if count < 1 or address + count > len(whole):
            raise RegisterRefused(RegisterRefused.ADDRESS)
        return whole[address : address + count]

    def write(self, client: int, address: int, values: Any) -> None:
        self.arbiter.write(client, address, list(values), self.now_ns)

    def commands(self, client: int) -> bool:
        return self.arbiter.commander(self.now_ns) == client

    def closed(self, client: int) -> None:
        self.arbiter.disconnected(client)


def requests() -> list[bytes]:
    """Request PDUs: unit and PDU."""
    values = block(plc.command_registers(COMMAND, 1, 1, ORDER))
    write = struct.pack(">HHB", plc.COMMAND_AT, COMMAND_COUNT, len(values)) + values
    both = struct.pack(">HH", 0, STATUS_COUNT) + write
    pdus = [
        b"\x17" + both,
        b"\x10" + write,
        b"\x03" + struct.pack(">HH", 0, STATUS_COUNT),
        b"\x04\x00\x00\x00\x38",
        b"\x06" + struct.pack(">HH", plc.WATCHDOG_AT, 300),
        b"\x06" + struct.pack(">HH", plc.SEQUENCE_AT, 9),
        b"\x2b\x0e\x01\x00",
    ]
    return [bytes((modbus.UNIT,)) + pdu for pdu in pdus]


def start_requests() -> Run:
    """The real server's answer to a request, without its socket."""
    registers = _Registers()
    connection = modbus._Connection(1, registers, None)  # type: ignore[arg-type]

    def run(data: bytes) -> Hashable:
        if not 2 <= len(data) <= 254:
            return "length"  # `ModbusServer` ends such a connection before it reads the request
        registers.now_ns += MS
        work = connection.answer(1, data[0], data[1:])
        try:
            work.send(None)
        except StopIteration as done:
            answer, refused = done.value
        else:
            raise AssertionError("the answer waits for something")
        assert 8 <= len(answer) <= 7 + 253, len(answer)
        Bounds.valves().check(registers.arbiter.command)
        return answer[7], answer[8] if refused else len(answer)

    return run


def status_blocks() -> list[bytes]:
    """Status and command blocks."""
    return [block(plc.status_registers(FEEDBACK, 300, order)) for order in WordOrder] + [
        block(plc.command_registers(COMMAND, 1, 1, ORDER))
    ]


def blocks(data: bytes) -> Hashable:
    registers = list(struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2]))
    return tuple(
        outcome(MapError, what, registers, order)
        for what in (plc.read_status, plc.read_command, plc.check_identity)
        for order in WordOrder
    )


PLC = (
    Target("plc-datagrams", "datagrams", start_datagrams, datagrams, mend=with_crc, runs_per_state=2000),
    Target("modbus-answers", "answers", start_answers, answers, runs_per_state=5000),
    Target("modbus-requests", "requests", start_requests, requests, runs_per_state=2000, max_bytes=254),
    Target("plc-registers", "blocks", lambda: blocks, status_blocks, max_bytes=200),
)
