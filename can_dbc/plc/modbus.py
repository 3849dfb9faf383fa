"""Modbus/TCP: a client for one PLC and a server for an emulated one; the only module that touches pymodbus (pinned).

pymodbus speaks the protocol (frames, function codes, exceptions); what a register means is the business of the caller's
`Registers`.  Both ends live in one asyncio loop and hold bounded memory whatever the other side does.  The server keeps
at most `MAX_CONNECTIONS`, takes one request at a time from each of them in turn, at most one per `PACE_S`, and ends a
connection that is idle, half open or slow; who commands is never evicted for somebody new.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

from pymodbus import ModbusException
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU

from can_dbc.plc.map import COMMAND_AT, STATUS_AT, STATUS_COUNT
from runtime.errors import CodedError

UNIT: Final = 1
MAX_CONNECTIONS: Final = 8
PACE_S: Final = 0.001
IDLE_S: Final = 10.0
REQUEST_S: Final = 2.0
"""A request, once begun, is to be complete within this time, and its answer taken."""
_FUNCTIONS: Final = frozenset((3, 4, 6, 16, 23))
_WRITE_SINGLE: Final = 6
_MBAP: Final = struct.Struct(">HHHB")
_MAX_PDU: Final = 253
_RESET_ON_CLOSE: Final = struct.pack("ii", 1, 0)
_REFUSED: Final = (ModbusException, ValueError, OSError, TimeoutError)

# Whoever uses this module is told by exceptions and counters; the library's own log would repeat them on stderr.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class LinkError(CodedError):
    """The PLC cannot be reached or does not answer as it should; the text says what happened."""


class RegisterRefused(Exception):
    """A request that the registers refuse, by Modbus exception code (2 address, 3 value, 6 busy)."""

    ADDRESS, VALUE, BUSY = ExcCodes.ILLEGAL_ADDRESS, ExcCodes.ILLEGAL_VALUE, ExcCodes.DEVICE_BUSY

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {int(code)}")
        self.code = int(code)


class Registers(Protocol):
    """What a server serves; both raise RegisterRefused and then have changed nothing."""

    def read(self, address: int, count: int) -> list[int]:
        """Registers from ``address`` on."""

    def write(self, client: int, address: int, values: Sequence[int]) -> None:
        """A write by the connection with this number."""

    def commands(self, client: int) -> bool:
        """Whether this connection is the one that commands now."""

    def closed(self, client: int) -> None:
        """This connection has ended."""


# -- client ------------------------------------------------------------------------------------------------------------


class ModbusClient:
    """One connection to a PLC.  A connection that misbehaves is closed at once, and what waits in it is thrown away."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self._host, self._port, self._timeout_s = host, port, timeout_s
        self._client: AsyncModbusTcpClient | None = None

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._client is not None and self._client.connected

    async def connect(self) -> None:
        """Connects anew; raises LinkError."""
        self.close()
        client = AsyncModbusTcpClient(
            self._host, port=self._port, timeout=self._timeout_s, retries=0, reconnect_delay=0
        )
        try:
            connected = await client.connect()
        except _REFUSED as error:
            raise LinkError("plc-link.connect", f"{self._host}:{self._port}: {error}") from error
        if not connected:
            raise LinkError(
                "plc-link.no-answer", f"no PLC answers at {self._host}:{self._port}; check its address, port and cable"
            )
        sock = client.ctx.transport.get_extra_info("socket")
        # Closing discards what the kernel still holds: no old command arrives when a cut cable is whole again.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
        self._client = client

    async def exchange(self, command: Sequence[int]) -> list[int]:
        """Writes the command block and reads the status block in one request (FC 23).

        Raises:
            RegisterRefused: the PLC refused the write; the connection stays.
            LinkError: anything else; the connection is closed.
        """
        return await self._ask(
            lambda client: client.readwrite_registers(
                read_address=STATUS_AT, read_count=STATUS_COUNT, write_address=COMMAND_AT, values=list(command),
                device_id=UNIT,
            )
        )  # fmt: skip

    async def status(self) -> list[int]:
        """Reads the status block (FC 3); raises as `exchange` does."""
        return await self._ask(lambda c: c.read_holding_registers(STATUS_AT, count=STATUS_COUNT, device_id=UNIT))

    async def _ask(self, request: Any) -> list[int]:
        client = self._client
        if client is None or not client.connected:
            raise LinkError("plc-link.not-connected", "not connected")
        try:
            response = await request(client)
        except _REFUSED as error:
            self.close()
            raise LinkError("plc-link.request", str(error) or type(error).__name__) from error
        if isinstance(response, ExceptionResponse):
            raise RegisterRefused(response.exception_code)
        if len(response.registers) != STATUS_COUNT:
            self.close()
            raise LinkError(
                "plc-link.answer", f"the PLC answered {len(response.registers)} registers, not {STATUS_COUNT}"
            )
        return list(response.registers)

    def close(self) -> None:
        """Ends the connection; closing twice is fine."""
        if self._client is not None:
            self._client.close()
            self._client = None


# -- server ------------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class ServerCounts:
    """Totals since start."""

    connections: int = 0
    evicted: int = 0
    """Connections ended because there were too many."""
    requests: int = 0
    refused: int = 0
    """Requests answered with an exception."""
    malformed: int = 0
    """Connections ended because what came was no Modbus/TCP."""
    slow: int = 0
    """Connections ended because they were idle, or did not complete a request or take its answer."""


class _Context:
    """What pymodbus' requests ask for values; one per connection, so that a write has an author."""

    def __init__(self, registers: Registers, client: int) -> None:
        self._registers, self._client = registers, client
        self._written: list[int] = []

    async def async_getValues(self, _unit: int, function: int, address: int, count: int = 1) -> Any:
        if function == _WRITE_SINGLE:  # its answer repeats the request; what is read back may not be accepted yet
            return self._written
        try:
            return self._registers.read(address, count)
        except RegisterRefused as refused:
            return ExcCodes(refused.code)

    async def async_setValues(self, _unit: int, _function: int, address: int, values: Any) -> Any:
        try:
            self._registers.write(self._client, address, values)
            self._written = list(values)
        except RegisterRefused as refused:
            return ExcCodes(refused.code)
        return None


class _Connection:
    """One client of the server."""

    def __init__(self, number: int, registers: Registers, writer: asyncio.StreamWriter) -> None:
        self.number, self.writer = number, writer
        self.active = 0
        """Number of its last complete request among all; 0 before the first."""
        self._context = _Context(registers, number)
        self._decoder = DecodePDU(True)
        self._framer = FramerSocket(self._decoder)

    async def answer(self, transaction: int, unit: int, pdu: bytes) -> tuple[bytes, bool]:
        """The answer to a request, and whether it is a refusal."""
        response = await self._respond(unit, pdu)
        response.transaction_id, response.dev_id = transaction, unit
        return self._framer.buildFrame(response), isinstance(response, ExceptionResponse)

    async def _respond(self, unit: int, pdu: bytes) -> ModbusPDU:
        function = pdu[0] & 0x7F
        if unit != UNIT:
            return ExceptionResponse(function, ExcCodes.GATEWAY_NO_RESPONSE)
        if pdu[0] not in _FUNCTIONS:
            return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
        request = self._decoder.decode(pdu)
        if request is None:
            return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)
        request.dev_id = unit
        response: ModbusPDU = await request.datastore_update(self._context, unit)  # type: ignore[arg-type]
        return response


class ModbusServer:
    """Serves registers on one address; `start`, then it runs in the loop until `close`."""

    def __init__(self, registers: Registers, host: str, port: int) -> None:
        self.counts = ServerCounts()
        self._registers, self._host, self.port = registers, host, port
        self._server: asyncio.Server | None = None
        self._connections: dict[int, _Connection] = {}

    async def start(self) -> None:
        """Listens; raises LinkError.  ``port`` is then the port in use (0 took a free one)."""
        try:
            self._server = await asyncio.start_server(
                self._serve, self._host, self.port, limit=2 * _MAX_PDU, backlog=MAX_CONNECTIONS
            )
        except OSError as error:
            raise LinkError(
                "plc-link.listen", f"cannot listen on {self._host}:{self.port}: {error.strerror}"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]

    def close(self) -> None:
        """Ends listening and every connection."""
        if self._server is not None:
            self._server.close()
        for connection in list(self._connections.values()):
            connection.writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.counts.connections += 1
        connection = _Connection(self.counts.connections, self._registers, writer)
        if len(self._connections) >= MAX_CONNECTIONS:
            self._evict()
        self._connections[connection.number] = connection
        writer.transport.set_write_buffer_limits(high=4 * _MAX_PDU)
        try:
            await self._converse(connection, reader)
        except TimeoutError:
            self.counts.slow += 1
        except (asyncio.IncompleteReadError, OSError):
            pass  # the client has gone
        finally:
            self._connections.pop(connection.number, None)
            self._registers.closed(connection.number)
            writer.transport.abort()

    def _evict(self) -> None:
        """Ends the connection that has been useless for longest; never the one that commands."""
        others = [c for c in self._connections.values() if not self._registers.commands(c.number)]
        victim = min(others, key=lambda c: (c.active, c.number))
        self.counts.evicted += 1
        self._connections.pop(victim.number)
        victim.writer.transport.abort()

    async def _converse(self, connection: _Connection, reader: asyncio.StreamReader) -> None:
        clock, writer = asyncio.get_running_loop().time, connection.writer
        while True:
            async with asyncio.timeout(IDLE_S):
                first = await reader.readexactly(1)
            begun = clock()
            async with asyncio.timeout(REQUEST_S):
                transaction, protocol, length, unit = _MBAP.unpack(first + await reader.readexactly(_MBAP.size - 1))
                if protocol != 0 or not 2 <= length <= _MAX_PDU + 1:
                    self.counts.malformed += 1
                    return
                pdu = await reader.readexactly(length - 1)
            self.counts.requests += 1
            connection.active = self.counts.requests
            answer, refused = await connection.answer(transaction, unit, pdu)
            self.counts.refused += refused
            writer.write(answer)
            async with asyncio.timeout(REQUEST_S):
                await writer.drain()
            # Even a client that sends without waiting gets its turn only so often, and lets everybody else have one.
            await asyncio.sleep(max(0.0, begun + PACE_S - clock()))


def is_loopback(host: str) -> bool:
    """Whether an address is one of this machine alone."""
    with contextlib.suppress(OSError):
        return socket.gethostbyname(host).startswith("127.")
    return False
