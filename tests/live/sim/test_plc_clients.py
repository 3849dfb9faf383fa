"""Independent clients against our PLC, and our client against independent servers: nobody's own misreading is shared.

mbpoll and libmodbus are C (Debian packages mbpoll, libmodbus5), pyModbusTCP is another Python implementation.
"""

from __future__ import annotations

import asyncio
import ctypes
import ctypes.util
import re
import shutil
import subprocess
from collections.abc import Iterator

import pytest
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pyModbusTCP.client import ModbusClient as OtherClient
from pyModbusTCP.server import ModbusServer as OtherServer

from can_dbc.plc.map import MAGIC, MAP_VERSION, STATUS_COUNT, Feedback, State, WordOrder, read_status, status_registers
from can_dbc.plc.modbus import ModbusClient, RegisterRefused
from runtime.errors import LinkError
from tests.codes import coded
from tests.live.sim.plc_server import LOOPBACK, MOVE, ServedPlc, block

IDENTITY = [MAGIC, MAP_VERSION, 0x0102, 0x0304]


@pytest.fixture
def plc() -> Iterator[ServedPlc]:
    with ServedPlc() as served:
        yield served


def test_pymodbus_with_every_function_code(plc: ServedPlc) -> None:
    with ModbusTcpClient(LOOPBACK, port=plc.port) as client:
        holding = client.read_holding_registers(0, count=STATUS_COUNT, device_id=1).registers
        assert holding[:4] == IDENTITY
        assert client.read_input_registers(0, count=4, device_id=1).registers == IDENTITY
        answer = client.readwrite_registers(
            read_address=0, read_count=STATUS_COUNT, write_address=100, values=block(1), device_id=1
        )
        assert answer.registers[9] == 1
        assert not client.write_registers(100, block(2), device_id=1).isError()
        assert not client.write_register(11, 200, device_id=1).isError()
        assert client.write_register(11, 20, device_id=1).exception_code == 3
        assert client.write_register(5, 2, device_id=1).exception_code == 2
        assert client.read_holding_registers(STATUS_COUNT - 1, count=2, device_id=1).exception_code == 2
        assert client.read_coils(0, count=1, device_id=1).exception_code == 1
        assert client.read_holding_registers(0, count=4, device_id=9).exception_code == 11
        assert client.read_holding_registers(100, count=32, device_id=1).registers == block(2)
    assert plc.program.arbiter.command == MOVE


def test_pymodbustcp_splits_the_block_and_commits(plc: ServedPlc) -> None:
    client, words = OtherClient(LOOPBACK, plc.port, unit_id=1), block(5)
    assert client.read_holding_registers(0, 4) == IDENTITY
    assert client.write_multiple_registers(102, words[2:])
    assert client.write_single_register(100, 77)
    assert plc.program.arbiter.accepted == 0
    assert client.write_single_register(101, 5)
    assert (plc.program.arbiter.accepted, plc.program.arbiter.command) == (1, MOVE)
    assert not client.write_single_register(102, 9) and client.last_except == 3
    assert plc.program.arbiter.accepted == 1 and client.read_holding_registers(6, 1) is not None
    assert client.write_read_multiple_registers(100, block(6), 0, STATUS_COUNT)[9] == 6  # type: ignore[index]
    client.close()


def mbpoll(plc: ServedPlc, *arguments: str) -> str:
    program = shutil.which("mbpoll")
    if program is None:
        pytest.skip("mbpoll is not installed (Debian package mbpoll)")
    command = [program, "-m", "tcp", "-p", str(plc.port), "-a", "1", "-0", "-1", "-q", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    return done.stdout + done.stderr


def test_mbpoll_reads_and_writes(plc: ServedPlc) -> None:
    shown = mbpoll(plc, "-r", "0", "-c", str(STATUS_COUNT), "-t", "4", LOOPBACK)
    registers = {int(a): int(v) for a, v in re.findall(r"\[(\d+)\]:\s+(\d+)", shown)}
    assert [registers[i] for i in range(4)] == IDENTITY and len(registers) == STATUS_COUNT
    assert "17234" in mbpoll(plc, "-r", "0", "-c", "1", "-t", "3", LOOPBACK)
    assert "Written 32" in mbpoll(plc, "-r", "100", "-t", "4", LOOPBACK, *map(str, block(1)))
    assert plc.program.arbiter.command == MOVE
    assert "Illegal data value" in mbpoll(plc, "-r", "102", "-t", "4", LOOPBACK, "9")


def libmodbus() -> ctypes.CDLL:
    name = ctypes.util.find_library("modbus")
    if name is None:
        pytest.skip("libmodbus is not installed (Debian package libmodbus5)")
    library = ctypes.CDLL(name, use_errno=True)
    library.modbus_new_tcp.restype = ctypes.c_void_p
    return library


def test_libmodbus_exchanges_in_one_request(plc: ServedPlc) -> None:
    library = libmodbus()
    context = ctypes.c_void_p(library.modbus_new_tcp(LOOPBACK.encode(), plc.port))
    try:
        assert library.modbus_set_slave(context, 1) == 0 and library.modbus_connect(context) == 0
        status = (ctypes.c_uint16 * STATUS_COUNT)()
        for sequence in range(1, 21):
            words = (ctypes.c_uint16 * 32)(*block(sequence))
            assert (
                library.modbus_write_and_read_registers(context, 100, 32, words, 0, STATUS_COUNT, status)
                == STATUS_COUNT
            )
            assert status[9] == sequence
        words[2] = 9
        words[1] = 21
        assert library.modbus_write_registers(context, 100, 32, words) == -1
        assert ctypes.get_errno() == 112345678 + 3, "illegal data value"
        assert library.modbus_read_input_registers(context, 0, STATUS_COUNT, status) == STATUS_COUNT
        assert status[9] == 20
    finally:
        library.modbus_close(context)
        library.modbus_free(context)
    assert plc.program.arbiter.accepted == 20


def test_low_word_first_is_a_setting() -> None:
    with ServedPlc(WordOrder.LOW_FIRST) as plc, ModbusTcpClient(LOOPBACK, port=plc.port) as client:
        registers = client.read_holding_registers(0, count=STATUS_COUNT, device_id=1).registers
        assert registers[2:4] == [0x0304, 0x0102]
        assert read_status(registers, WordOrder.LOW_FIRST)[0].position[2] == pytest.approx(-1.6, abs=1e-3)
        client.write_registers(100, block(1, MOVE, WordOrder.LOW_FIRST), device_id=1)
        assert plc.program.arbiter.command == MOVE


STATUS = status_registers(Feedback(heartbeat=9, state=State.HOLD, accepted=4), 300, WordOrder.HIGH_FIRST)


async def converse(port: int) -> None:
    """Our client against any server that holds a status block."""
    client = ModbusClient(LOOPBACK, port, 1.0)
    with pytest.raises(LinkError):
        await client.status()
    await client.connect()
    assert await client.status() == STATUS
    assert await client.exchange(block(3)) == STATUS
    client.close()
    assert not client.connected


def test_our_client_with_pymodbustcp_as_server() -> None:
    server = OtherServer(LOOPBACK, 0, no_block=True)
    server.start()
    try:
        server.data_bank.set_holding_registers(0, STATUS)
        port = server._service.server_address[1]
        asyncio.run(converse(port))
        assert server.data_bank.get_holding_registers(100, 32) == block(3)
    finally:
        server.stop()


def test_our_client_with_pymodbus_own_server() -> None:
    async def run() -> None:
        data = [
            SimData(0, values=STATUS, datatype=DataType.REGISTERS),
            SimData(STATUS_COUNT, count=148 - STATUS_COUNT, values=0, datatype=DataType.REGISTERS),
        ]
        server = ModbusTcpServer(SimDevice(1, data), address=(LOOPBACK, 0))
        await server.serve_forever(background=True)
        port = server.transport.sockets[0].getsockname()[1]  # type: ignore[attr-defined]
        try:
            await converse(port)
        finally:
            await server.shutdown()

    asyncio.run(run())


def test_our_client_distinguishes_a_refusal_from_a_lost_link(plc: ServedPlc) -> None:
    async def run() -> None:
        client = ModbusClient(LOOPBACK, plc.port, 1.0)
        await client.connect()
        wrong = block(1)
        wrong[2] = 9
        with pytest.raises(RegisterRefused) as refused:
            await client.exchange(wrong)
        assert refused.value.code == 3 and client.connected
        assert (await client.exchange(block(1)))[9] == 1
        client.close()
        with pytest.raises(LinkError):
            await client.exchange(block(2))

    asyncio.run(run())


def test_a_missing_server_is_a_link_error() -> None:
    async def run() -> None:
        with pytest.raises(LinkError, check=coded("plc-link.no-answer")):
            await ModbusClient(LOOPBACK, 1, 0.5).connect()

    asyncio.run(run())
