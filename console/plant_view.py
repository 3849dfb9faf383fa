"""A live 3-D view of a simulated plant: relays the plant's responses to a page.

Input: the UDP request port of a live plant (``{"op": "scene"}``, ``{"op": "view"}``, ``{"op": "lever"}``, JSON both
ways).  Output: ``/plant`` (page), ``/api/plant`` (constant data), ``/ws/plant`` (poses, 20 times a second)
and ``POST /api/plant/lever``: the hand levers on the valve block, accepted only from this machine.  The page shows
the ground truth of a simulation; no control process reads it.
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
from console.plant_link import Address, PlantLink

PERIOD_S: Final = 0.05
STATIC: Final = Path(__file__).with_name("static")


def create_plant_app(plant: Address, allow_hosts: Collection[str] = ()) -> Starlette:
    """The ASGI application of the plant's page."""
    page = (STATIC / "plant.html").read_text()
    links: list[PlantLink] = []
    silent = "The plant does not respond; check that it is running and that the request port is right."

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        _transport, link = await asyncio.get_running_loop().create_datagram_endpoint(PlantLink, remote_addr=plant)
        links.append(link)
        yield
        link.close()

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "plant.html", media_type="text/html")

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
                await socket.send_text(response.decode() if response else "null")
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
