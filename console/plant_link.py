"""Asks a simulated plant on its request port (`sim.process.live_plant`): JSON over UDP, one request at a time."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Collection
from dataclasses import asdict
from typing import Any, Final

import msgspec
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from autonomy.perception.log_list import decode_logs
from console.guards import STATIC, guarded, is_loopback, page_route, send
from runtime.errors import InputRefused

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
        """Return the plant's response (JSON), None after a timeout."""
        assert self._transport is not None
        async with self._lock:
            self._waiting = asyncio.get_running_loop().create_future()
            self._transport.sendto(msgspec.json.encode(query))
            try:
                return await asyncio.wait_for(self._waiting, RESPONSE_TIMEOUT_S)
            except TimeoutError:
                await self._open_again()
                return None

    async def _open_again(self) -> None:
        """Go on from another port, so that a late answer is not taken for that to the next request."""
        assert self._transport is not None
        former = self._transport
        plant: Address = former.get_extra_info("peername")
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, remote_addr=plant)
        former.close()


# -- A live 3-D view of a simulated plant: relays the plant's responses to a page.
#
# Input: the UDP request port of a live plant (``{"op": "scene"}``, ``{"op": "view"}``, ``{"op": "lever"}``, JSON
# both ways).  Output: ``/plant`` (page), ``/api/plant`` (constant data), ``/ws/plant`` (poses, 20 times a second)
# and ``POST /api/plant/lever``: the hand levers on the valve block, accepted only from this machine.  The page
# shows the ground truth of a simulation; no control process reads it.

VIEW_PERIOD_S: Final = 0.05


def create_plant_app(plant: Address, allow_hosts: Collection[str] = ()) -> Starlette:
    """Build the ASGI application of the plant's page."""
    links: list[PlantLink] = []
    silent = "The plant does not respond; check that it is running and that the request port is right."

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        _transport, link = await asyncio.get_running_loop().create_datagram_endpoint(PlantLink, remote_addr=plant)
        links.append(link)
        yield
        link.close()

    async def api_plant(_: Request) -> Response:
        response = await links[0].request({"op": "scene"})
        return Response(response, media_type="application/json") if response else PlainTextResponse(silent, 504)

    async def lever(request: Request) -> Response:
        if not is_loopback(request.client.host if request.client else None):
            return PlainTextResponse("The hand levers are accepted only from the machine that runs the plant.", 403)
        name, value = request.query_params.get("name", ""), request.query_params.get("value", "0")
        response = await links[0].request({"op": "lever", "name": name, "value": value})
        if response is None:
            return PlainTextResponse(silent, 504)
        error = msgspec.json.decode(response).get("error")
        return PlainTextResponse(error, 409) if error else Response(status_code=204)

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                response = await links[0].request({"op": "view"})
                await send(socket, response.decode() if response else "null")
                await asyncio.sleep(VIEW_PERIOD_S)

    return Starlette(
        routes=[
            page_route("/", "plant.html"),
            page_route("/plant", "plant.html"),
            Route("/api/plant", api_plant),
            Route("/api/plant/lever", lever, methods=["POST"]),
            WebSocketRoute("/ws/plant", ws),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[guarded("plant.html", allow_hosts)],
        lifespan=lifespan,
    )


# -- The logs as they truly are, for the page of an emulated run: asked of the plant while a page shows them.
#
# The harness of a live run gives the plant's address (`--truth`); the console of a machine has none, and then
# ``/api/true-logs`` does not exist.  The answer goes to the page alone: it passes neither controller nor planner.

TRUE_LOGS_PERIOD_S: Final = 0.4
"""The plant is asked at most this often, however many pages show the logs: it has deadlines."""
SILENT: Final = "The plant does not answer; the true logs are not shown."


class TrueLogs:
    """The true logs of one plant, in the crane's base frame."""

    def __init__(self, plant: Address) -> None:
        self._plant = plant
        self._link: PlantLink | None = None
        self._asked_s = -TRUE_LOGS_PERIOD_S
        self._logs: list[dict[str, Any]] | None = None
        self._lock = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def connected(self) -> AsyncIterator[None]:
        """Keep the link to the plant open while the context lasts."""
        loop = asyncio.get_running_loop()
        _, self._link = await loop.create_datagram_endpoint(PlantLink, remote_addr=self._plant)
        yield
        self._link.close()

    def routes(self) -> list[Route]:
        """Make the route of ``/api/true-logs``."""
        return [Route("/api/true-logs", self._answer)]

    async def _answer(self, _: Request) -> Response:
        async with self._lock:
            if time.monotonic() - self._asked_s >= TRUE_LOGS_PERIOD_S:
                self._logs = await self._ask()
                self._asked_s = time.monotonic()
        return PlainTextResponse(SILENT, 504) if self._logs is None else JSONResponse(self._logs)

    async def _ask(self) -> list[dict[str, Any]] | None:
        assert self._link is not None
        response = await self._link.request({"op": "logs"})
        if response is None:
            return None
        try:
            logs = decode_logs(response)
        except InputRefused:
            return None
        return [asdict(log) for log in logs]
