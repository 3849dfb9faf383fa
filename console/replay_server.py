"""Serves a recorded run in the operator's page: the same page, fed from a recording (`console.replay`).

Nothing can be commanded: every POST is refused with a sentence, and the page says that it shows a recording.  Each page
seeks and plays on its own, by words on its websocket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Collection
from typing import Any, Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from console.can_tap import load_databases
from console.guards import STATIC, guarded, json_route, page_route, send
from console.replay import Overview, Recording, ReplayView
from console.server import PERIOD_S
from console.state import describe_machine
from machine.profile import Profile

REFUSAL: Final = "This page shows a recording: nothing can be commanded."
MAX_ORDERS: Final = 64
"""Words of one page that wait; a page that sends more than it can be answered is closed."""


def create_replay_app(
    recording: Recording,
    profile: Profile,
    *,
    name: str = "",
    note: str = "",
    at_ns: int | None = None,
    allow_hosts: Collection[str] = (),
) -> Starlette:
    """Build the ASGI application; ``name`` and ``note`` are shown, ``at_ns`` is where a page begins."""
    overview, databases = Overview(recording, profile), load_databases(profile)
    machine = describe_machine(profile) | {
        "panels": ["error", "timeline", "can"],
        "recording": {
            "name": name,
            "note": note,
            "begin_s": recording.begin_ns / 1e9,
            "end_s": recording.end_ns / 1e9,
            "moves": bool(overview.trail),
        },
    }

    async def refuse(_: Request) -> Response:
        return PlainTextResponse(REFUSAL, 409)

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        view = await asyncio.to_thread(ReplayView, recording, profile, overview, databases, at_ns)
        orders: asyncio.Queue[str] = asyncio.Queue(MAX_ORDERS)
        hearing = asyncio.create_task(_hear(socket, orders))
        with contextlib.suppress(WebSocketDisconnect, asyncio.QueueFull):
            while not hearing.done():
                state = await asyncio.to_thread(_next, view, _waiting(orders), time.monotonic_ns())
                await send(socket, json.dumps(state, separators=(",", ":")))
                await asyncio.sleep(PERIOD_S)
        hearing.cancel()

    return Starlette(
        routes=[
            page_route("/", "index.html"),
            json_route("/api/machine", lambda: machine),
            json_route("/api/trail", lambda: overview.trail),
            json_route("/api/timeline", lambda: overview.entries),
            Route("/api/{command:path}", refuse, methods=["POST"]),
            WebSocketRoute("/ws", ws),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[guarded("index.html", allow_hosts)],
    )


async def _hear(socket: WebSocket, orders: asyncio.Queue[str]) -> None:
    while (message := await socket.receive())["type"] != "websocket.disconnect":
        orders.put_nowait(message.get("text") or "")


def _waiting(orders: asyncio.Queue[str]) -> list[str]:
    """Take the orders that wait; of several seeks in a row only the last counts, or dragging would lag behind."""
    waiting_orders: list[str] = []
    while not orders.empty():
        order = orders.get_nowait()
        if waiting_orders and order.startswith("seek ") and waiting_orders[-1].startswith("seek "):
            waiting_orders.pop()
        waiting_orders.append(order)
    return waiting_orders


def _next(view: ReplayView, orders: list[str], now_ns: int) -> dict[str, Any]:
    for order in orders:
        view.order(order)
    return view.step(now_ns)
