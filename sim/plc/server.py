"""The emulated PLC on its two ports: Modbus/TCP registers and the cyclic datagram.  Decides nothing.

Both run in the asyncio loop of the process; clients are told apart by connection, and by address for datagrams.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence
from typing import cast

from can_dbc.plc import map as plc
from can_dbc.plc.datagram import Header, encode_reply
from can_dbc.plc.map import Feedback
from can_dbc.plc.modbus import ModbusServer, RegisterRefused
from runtime.errors import LinkError
from sim.plc.program import Program

Address = tuple[str, int]


class PlcRegisters:
    """The registers of a PLC for a Modbus server; ``clock_ns`` is the PLC's time."""

    def __init__(self, program: Program, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._program, self._clock_ns = program, clock_ns

    def read(self, address: int, count: int) -> list[int]:
        """A part of the status block or of the command block; both read alike as holding and as input registers."""
        for begin, length in ((plc.STATUS_AT, plc.STATUS_COUNT), (plc.COMMAND_AT, plc.COMMAND_COUNT)):
            if begin <= address and address + count <= begin + length:
                block = self._program.status() if begin == plc.STATUS_AT else self._program.arbiter.command_block()
                return block[address - begin : address - begin + count]
        raise RegisterRefused(RegisterRefused.ADDRESS)

    def write(self, client: int, address: int, values: Sequence[int]) -> None:
        """A write by this connection."""
        self._program.arbiter.write(client, address, values, self._clock_ns())

    def commands(self, client: int) -> bool:
        """Whether this connection commands."""
        return self._program.arbiter.commander(self._clock_ns()) == client

    def closed(self, client: int) -> None:
        """The connection has ended; the commander may return on a new one."""
        self._program.arbiter.disconnected(client)


class Datagrams(asyncio.DatagramProtocol):
    """The UDP side: commands in, an answer at once to every hello, and one reply per PLC cycle in an open session."""

    def __init__(self, program: Program, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._program, self._clock_ns = program, clock_ns
        self._transport: asyncio.DatagramTransport | None = None
        self._beat = 0
        self.port = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Address) -> None:
        offer = self._program.arbiter.datagram(addr, data, self._clock_ns())
        if offer is not None:
            self._reply(offer, self._program.feedback, addr)

    def cycle(self) -> None:
        """Send the reply of a PLC cycle that has not been sent yet."""
        feedback, session = self._program.feedback, self._program.arbiter.session
        if not session.number or feedback.heartbeat == self._beat:
            return
        self._beat = feedback.heartbeat
        self._reply(session.reply_header(self._clock_ns()), feedback, cast(Address, session.client))

    def _reply(self, header: Header, feedback: Feedback, to: Address) -> None:
        if self._transport is not None:
            with contextlib.suppress(OSError):
                self._transport.sendto(encode_reply(header, feedback, self._program.arbiter.key), to)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


async def listen(program: Program, address: Address, clock_ns: Callable[[], int]) -> Datagrams:
    """Open the UDP side on an address.

    Raises:
        LinkError: the address cannot be used.
    """
    protocol = Datagrams(program, clock_ns)
    try:
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: protocol, local_addr=address)
    except OSError as error:
        raise LinkError("plc-link.listen", f"cannot listen on {address[0]}:{address[1]}: {error.strerror}") from error
    return protocol


async def serve(program: Program, address: Address, clock_ns: Callable[[], int]) -> ModbusServer:
    """Open the Modbus side on an address.

    Raises:
        LinkError: the address cannot be used.
    """
    server = ModbusServer(PlcRegisters(program, clock_ns), *address)
    await server.start()
    return server
