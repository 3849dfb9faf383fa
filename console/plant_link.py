"""Asks a simulated plant on its request port (`sim.process.live_plant`): JSON over UDP, one request at a time."""

from __future__ import annotations

import asyncio
from typing import Final

import msgspec

RESPONSE_TIMEOUT_S: Final = 1.0
Address = tuple[str, int]


class PlantLink(asyncio.DatagramProtocol):
    """Sends requests to one plant, one at a time."""

    def __init__(self) -> None:
        self._transport: asyncio.DatagramTransport | None = None
        self._waiting: asyncio.Future[bytes] | None = None
        self._lock = asyncio.Lock()

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self._transport = transport

    def datagram_received(self, data: bytes, addr: Address) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(data)

    def close(self) -> None:
        """Close the link."""
        if self._transport is not None:
            self._transport.close()

    async def request(self, query: dict[str, str]) -> bytes | None:
        """The plant's response (JSON), None after a timeout."""
        assert self._transport is not None
        async with self._lock:
            self._waiting = asyncio.get_running_loop().create_future()
            self._transport.sendto(msgspec.json.encode(query))
            try:
                return await asyncio.wait_for(self._waiting, RESPONSE_TIMEOUT_S)
            except TimeoutError:
                return None
