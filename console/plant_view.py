"""A live three-dimensional view of a simulated plant: its answers, relayed to a page.

Input: the UDP request port of a live plant (``{"op": "scene"}``, ``{"op": "view"}``, ``{"op": "lever"}``, JSON both
ways).  Output: ``/plant`` (page), ``/api/plant`` (what never changes), ``/ws/plant`` (what moves, 20 times a second)
and ``POST /api/plant/lever``: the hand levers on the valve block, accepted only from this machine.  The page shows
the truth of a simulation; no control process reads it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Collection
from pathlib import Path
from typing import Final

import msgspec
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from console.guards import LOOPBACK_NAMES, RequestGuards, content_security_policy, is_loopback

PERIOD_S: Final = 0.05
ANSWER_S: Final = 1.0
STATIC: Final = Path(__file__).with_name("static")
Address = tuple[str, int]


class PlantLink(asyncio.DatagramProtocol):
    """Asks one plant; one question at a time, the newest answer wins."""

    def __init__(self) -> None:
        self._transport: asyncio.DatagramTransport | None = None
        self._waiting: asyncio.Future[bytes] | None = None
        self._turn = asyncio.Lock()

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self._transport = transport

    def datagram_received(self, data: bytes, addr: Address) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(data)

    def close(self) -> None:
        """End the link."""
        if self._transport is not None:
            self._transport.close()

    async def ask(self, question: dict[str, str]) -> bytes | None:
        """The plant's answer (JSON), None when it is silent for a second."""
        assert self._transport is not None
        async with self._turn:
            self._waiting = asyncio.get_running_loop().create_future()
            self._transport.sendto(msgspec.json.encode(question))
            try:
                return await asyncio.wait_for(self._waiting, ANSWER_S)
            except TimeoutError:
                return None


def create_plant_app(plant: Address, allow_hosts: Collection[str] = ()) -> Starlette:
    """The ASGI application of the plant's page."""
    page = (STATIC / "plant.html").read_text()
    links: list[PlantLink] = []
    silent = "The plant does not answer; it has ended, or its request port is another one."

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        _transport, link = await asyncio.get_running_loop().create_datagram_endpoint(PlantLink, remote_addr=plant)
        links.append(link)
        yield
        link.close()

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "plant.html", media_type="text/html")

    async def api_plant(_: Request) -> Response:
        answer = await links[0].ask({"op": "scene"})
        return Response(answer, media_type="application/json") if answer else PlainTextResponse(silent, 504)

    async def lever(request: Request) -> Response:
        if not is_loopback(request.client.host if request.client else None):
            return PlainTextResponse("The hand levers are accepted only from the machine that runs the plant.", 403)
        name, value = request.query_params.get("name", ""), request.query_params.get("value", "0")
        answer = await links[0].ask({"op": "lever", "name": name, "value": value})
        if answer is None:
            return PlainTextResponse(silent, 504)
        error = msgspec.json.decode(answer).get("error")
        return PlainTextResponse(error, 409) if error else Response(status_code=204)

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                answer = await links[0].ask({"op": "view"})
                await socket.send_text(answer.decode() if answer else "null")
                await asyncio.sleep(PERIOD_S)

    return Starlette(
        routes=[
            Route("/", index),
            Route("/plant", index),
            Route("/api/plant", api_plant),
            Route("/api/plant/lever", lever, methods=["POST"]),
            WebSocketRoute("/ws/plant", ws),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[
            Middleware(RequestGuards, names={*LOOPBACK_NAMES, *allow_hosts}, policy=content_security_policy(page))
        ],
        lifespan=lifespan,
    )
