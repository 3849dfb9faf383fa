"""Modbus/TCP: a client for one PLC and a server for an emulated one; the only module that uses pymodbus (pinned).

pymodbus handles the protocol (frames, function codes, exceptions); the caller's `Registers` define the meaning of a
register.  Both ends run in one asyncio loop and use bounded memory whatever the other side does.  The server keeps at
most `MAX_CONNECTIONS`, accepts one request at a time from each of them in turn, at most one per `PACE_S`, and ends a
connection that is idle, half open or slow; the commanding client is never evicted for a new one.
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
from runtime.errors import LinkError

UNIT: Final = 1
MAX_CONNECTIONS: Final = 8
PACE_S: Final = 0.001
IDLE_S: Final = 10.0
REQUEST_S: Final = 2.0
"""A started request must be complete within this time, and so must the transfer of its answer."""
_FUNCTIONS: Final = frozenset((3, 4, 6, 16, 23))
_WRITE_SINGLE: Final = 6
_MBAP: Final = struct.Struct(">HHHB")
_MAX_PDU: Final = 253
_RESET_ON_CLOSE: Final = struct.pack("ii", 1, 0)
_REFUSED: Final = (ModbusException, ValueError, OSError, TimeoutError)

# Exceptions and counters report every problem; the library's own log would repeat them on stderr.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class RegisterRefused(Exception):
    """The registers refuse a request, by Modbus exception code (2 address, 3 value, 6 busy)."""

    ADDRESS, VALUE, BUSY = ExcCodes.ILLEGAL_ADDRESS, ExcCodes.ILLEGAL_VALUE, ExcCodes.DEVICE_BUSY

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {int(code)}")
        self.code = int(code)


class Registers(Protocol):
    """The registers of a server; reading and writing raise RegisterRefused, and then change nothing."""

    def read(self, address: int, count: int) -> list[int]:
        """Read registers from ``address`` on."""

    def write(self, client: int, address: int, values: Sequence[int]) -> None:
        """Take a write by the connection with this number."""

    def commands(self, client: int) -> bool:
        """Tell whether this connection is the one that commands now."""

    def closed(self, client: int) -> None:
        """Note that this connection has ended."""


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
        """Connect, after closing an existing connection; raises LinkError."""
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
        # Closing discards data in the kernel: no old command arrives after a cable is reconnected.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
        self._client = client

    async def exchange(self, command: Sequence[int]) -> list[int]:
        """Write the command block and read the status block in one request (FC 23).

        Raises:
            RegisterRefused: The PLC refused the write; the connection stays open.
            LinkError: Any other failure; the connection is closed.
        """
        return await self._request(
            lambda client: client.readwrite_registers(
                read_address=STATUS_AT,
                read_count=STATUS_COUNT,
                write_address=COMMAND_AT,
                values=list(command),
                device_id=UNIT,
            )
        )

    async def status(self) -> list[int]:
        """Read the status block (FC 3); raises as `exchange` does."""
        return await self._request(lambda c: c.read_holding_registers(STATUS_AT, count=STATUS_COUNT, device_id=UNIT))

    async def _request(self, request: Any) -> list[int]:
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
        """End the connection; may be called twice."""
        if self._client is not None:
            self._client.close()
            self._client = None


# -- server ------------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class ServerCounts:
    """Totals since start."""

    connections: int = 0
    evicted: int = 0
    """Connections ended because of too many connections."""
    requests: int = 0
    refused: int = 0
    """Requests answered with an exception."""
    malformed: int = 0
    """Connections ended because the data was not Modbus/TCP."""
    slow: int = 0
    """Connections ended because they were idle, or did not complete a request or read its answer."""


class _Context:
    """The data store of pymodbus' requests; one per connection, so that a write has an author."""

    def __init__(self, registers: Registers, client: int) -> None:
        self._registers, self._client = registers, client
        self._written: list[int] = []

    async def async_getValues(self, _unit: int, function: int, address: int, count: int = 1) -> Any:
        if function == _WRITE_SINGLE:  # the answer repeats the request; the value may not be accepted yet
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
        """Number of its last complete request, counted over all connections; 0 before the first."""
        self._context = _Context(registers, number)
        self._decoder = DecodePDU(True)
        self._framer = FramerSocket(self._decoder)

    async def answer(self, transaction: int, unit: int, pdu: bytes) -> tuple[bytes, bool]:
        """Return the answer to a request, and whether it is a refusal."""
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
    """Serves registers on one address, in the running loop from `start` to `close`."""

    def __init__(self, registers: Registers, host: str, port: int) -> None:
        self.counts = ServerCounts()
        self._registers, self._host, self.port = registers, host, port
        self._server: asyncio.Server | None = None
        self._connections: dict[int, _Connection] = {}

    async def start(self) -> None:
        """Listen; raises LinkError.  ``port`` is then the port in use (0 chooses a free one)."""
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
        """End listening and every connection."""
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
            await self._serve_requests(connection, reader)
        except TimeoutError:
            self.counts.slow += 1
        except (asyncio.IncompleteReadError, OSError):
            pass  # the client has disconnected
        finally:
            self._connections.pop(connection.number, None)
            self._registers.closed(connection.number)
            writer.transport.abort()

    def _evict(self) -> None:
        """End the connection without a request for longest, never the commanding one."""
        others = [c for c in self._connections.values() if not self._registers.commands(c.number)]
        victim = min(others, key=lambda c: (c.active, c.number))
        self.counts.evicted += 1
        self._connections.pop(victim.number)
        victim.writer.transport.abort()

    async def _serve_requests(self, connection: _Connection, reader: asyncio.StreamReader) -> None:
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
            # Limits the rate of a client that sends without waiting, so that the others get their turn.
            await asyncio.sleep(max(0.0, begun + PACE_S - clock()))


def is_loopback(host: str) -> bool:
    """Tell whether an address is a loopback address of this machine."""
    with contextlib.suppress(OSError):
        return socket.gethostbyname(host).startswith("127.")
    return False
