"""The logs as they truly are, for the page of an emulated run: asked of the plant while a page shows them.

The harness of a live run gives the plant's address (`--truth`); the console of a machine has none, and then
``/api/true-logs`` does not exist.  The answer goes to the page alone: it passes neither controller nor planner.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from dataclasses import asdict
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from autonomy.perception.log_list.datagrams import decode_logs
from console.plant_link import Address, PlantLink
from runtime.errors import InputRefused

PERIOD_S: Final = 0.4
"""The plant is asked at most this often, however many pages show the logs: it has deadlines."""
SILENT: Final = "The plant does not answer; the true logs are not shown."


class TrueLogs:
    """The true logs of one plant, in the crane's base frame."""

    def __init__(self, plant: Address) -> None:
        self._plant = plant
        self._link: PlantLink | None = None
        self._asked_s = -PERIOD_S
        self._logs: list[dict[str, Any]] | None = None
        self._lock = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def connected(self) -> AsyncIterator[None]:
        """While it lasts the plant can be asked."""
        loop = asyncio.get_running_loop()
        _, self._link = await loop.create_datagram_endpoint(PlantLink, remote_addr=self._plant)
        yield
        self._link.close()

    def routes(self) -> list[Route]:
        """``/api/true-logs``."""
        return [Route("/api/true-logs", self._answer)]

    async def _answer(self, _: Request) -> Response:
        async with self._lock:
            if time.monotonic() - self._asked_s >= PERIOD_S:
                self._logs = await self._ask()
                self._asked_s = time.monotonic()
        return PlainTextResponse(SILENT, 504) if self._logs is None else JSONResponse(self._logs)

    async def _ask(self) -> list[dict[str, Any]] | None:
        assert self._link is not None
        told = await self._link.request({"op": "logs"})
        if told is None:
            return None
        try:
            logs = decode_logs(told)
        except InputRefused:
            return None
        return [asdict(log) for log in logs]
