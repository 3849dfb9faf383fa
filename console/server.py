"""The operator's web page: watch crane and mission, stop them, arm them, order the mission about.

Inputs: the controller's reports of crane and vehicle and the planner's of its mission (UDP, one port), the detector's
log list (UDP, asked twice a second, optional), the controller's timing page (read once a second, optional) and the
operator's commands and orders (POST).  Outputs: a page, ``/ws`` with the state 20 times a second (and the mission when
something new was told of it), ``/api/state``, ``/api/trail`` (where the vehicle was), ``/api/machine``, ``/healthz``;
one ``OperatorCommand`` datagram per command to the controller, one ``MissionOrder`` per order to the planner.

STOP is accepted from every page that may see the console; ARM, DISARM, RESET and the orders of a mission only from this
machine (an ssh tunnel counts as this machine).  Everything is served from the package: no other host is ever asked for
anything.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import time
from collections.abc import AsyncIterator, Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from autonomy.perception.log_list.datagrams import LogListError, decode_logs, encode_request
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import MissionOrder, Order, encode_order
from can_dbc.timing.page import TimingRefused, read_timing
from console.guards import LOOPBACK_NAMES, RequestGuards, content_security_policy, is_loopback
from console.state import CraneState, describe_machine
from machine.profile import Profile

PERIOD_S: Final = 0.05
ASK_LOGS_S: Final = 0.1  # a log in the tongs is drawn where they are
LOOK_AT_TIMING_S: Final = 1.0
STATIC: Final = Path(__file__).with_name("static")

Address = tuple[str, int]


@dataclass(slots=True)
class Console:
    """The console's configuration and what it knows.  ``controller`` None: the page only watches; ``planner`` None: the
    mission cannot be ordered about.
    """

    profile: Profile
    profile_hash: int
    controller: Address | None = None
    scene: Address | None = None
    key: bytes | None = None
    reports: socket.socket | None = None
    """A bound UDP socket on which the reports of controller and planner arrive."""
    planner: Address | None = None
    timing_page: Path | None = None
    clock: Callable[[], int] = time.monotonic_ns
    watch: CraneState = field(init=False)
    _sequence: int = 0

    def __post_init__(self) -> None:
        self.watch = CraneState(self.profile, self.key, self.profile_hash)

    def command(self, action: OperatorAction) -> None:
        """Send one operator command; raises OSError."""
        assert self.controller is not None
        message = OperatorCommand(self._next(), self.profile_hash, self.clock(), action)
        _send(encode(message, self.key), self.controller)

    def order(self, order: Order) -> None:
        """Send one order to the planner; raises OSError."""
        assert self.planner is not None
        message = MissionOrder(self._next(), self.profile_hash, self.clock(), order)
        _send(encode_order(message, self.key), self.planner)

    def _next(self) -> int:
        # Starts from the clock, so that a restarted console is no replay of the one before.
        self._sequence = max(self._sequence + 1, self.clock() // 1_000_000 & 0x7FFF_FFFF)
        return self._sequence

    def state_for(self, peer: str | None) -> dict[str, Any]:
        """The page's state with what the viewer at ``peer`` may do."""
        can = self.controller is not None
        return {
            **self.watch.state(self.clock()),
            "may_stop": can,
            "may_command": can and is_loopback(peer),
            "may_order": self.planner is not None and is_loopback(peer),
        }


def _send(data: bytes, to: Address) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(to)
        out.send(data)
        # On loopback the kernel says at once when nobody listens.
        if code := out.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(code, os.strerror(code))


class _Reports(asyncio.DatagramProtocol):
    def __init__(self, console: Console) -> None:
        self._console = console

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._console.watch.on_report(data, self._console.clock())


class _Logs(asyncio.DatagramProtocol):
    def __init__(self, console: Console) -> None:
        self._console = console

    def datagram_received(self, data: bytes, addr: Address) -> None:
        with contextlib.suppress(LogListError):
            self._console.watch.logs = decode_logs(data)


async def _ask_logs(transport: asyncio.DatagramTransport) -> None:
    while True:
        transport.sendto(encode_request(()))  # what is known already will do
        await asyncio.sleep(ASK_LOGS_S)


async def _watch_timing(watch: CraneState, page: Path) -> None:
    while True:
        with contextlib.suppress(TimingRefused):  # none, or none yet; what was read before grows old
            watch.on_timing(await asyncio.to_thread(read_timing, page))
        await asyncio.sleep(LOOK_AT_TIMING_S)


def _elsewhere(name: str) -> Response:
    return PlainTextResponse(f"{name} is accepted only from the machine that runs the console.", 403)


def _answer(send: Callable[[], None], who: str, where: Address) -> Response:
    """Send, and say when nobody is there."""
    try:
        send()
    except OSError as error:
        return PlainTextResponse(f"The {who} at {where[0]}:{where[1]} cannot be reached: {error.strerror}.", 502)
    return Response(status_code=204)


def create_app(console: Console, allow_hosts: Collection[str] = ()) -> Starlette:
    """The ASGI application; ``allow_hosts`` are names to serve besides this machine's own."""
    page = (STATIC / "index.html").read_text()
    machine = describe_machine(console.profile)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            if console.reports:
                reports, _receiver = await loop.create_datagram_endpoint(
                    lambda: _Reports(console), sock=console.reports
                )
                stack.callback(reports.close)
            if console.scene:
                scene, _logs = await loop.create_datagram_endpoint(lambda: _Logs(console), remote_addr=console.scene)
                asking = asyncio.create_task(_ask_logs(scene))
                stack.callback(scene.close)
                stack.callback(asking.cancel)
            if console.timing_page:
                stack.callback(asyncio.create_task(_watch_timing(console.watch, console.timing_page)).cancel)
            yield

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "index.html", media_type="text/html")

    async def api_machine(_: Request) -> Response:
        return JSONResponse(machine)

    async def api_state(request: Request) -> Response:
        state = console.state_for(request.client.host if request.client else None)
        return JSONResponse(state | {"mission": console.watch.forwarding.mission()})

    async def api_trail(_: Request) -> Response:
        return JSONResponse(list(console.watch.forwarding.trail))

    async def healthz(_: Request) -> Response:
        alive = console.watch.alive(console.clock())
        return JSONResponse({"console": "ok", "controller": "alive" if alive else "silent"})

    async def operator(request: Request) -> Response:
        name = request.path_params["action"].upper()
        if name not in OperatorAction.__members__:
            return PlainTextResponse(f"There is no command {name}.", 404)
        if console.controller is None:
            return PlainTextResponse("This console only watches; start it with --controller HOST:PORT.", 409)
        peer = request.client.host if request.client else None
        if name != "STOP" and not is_loopback(peer):
            return _elsewhere(name)
        return _answer(lambda: console.command(OperatorAction[name]), "controller", console.controller)

    async def mission(request: Request) -> Response:
        name = request.path_params["order"].upper().replace("-", "_")
        if name not in Order.__members__:
            return PlainTextResponse(f"There is no order {name}.", 404)
        if console.planner is None:
            return PlainTextResponse("This console gives no orders; start it with --planner HOST:PORT.", 409)
        if not is_loopback(request.client.host if request.client else None):
            return _elsewhere(name)
        return _answer(lambda: console.order(Order[name]), "planner", console.planner)

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        peer = socket.client.host if socket.client else None
        with contextlib.suppress(WebSocketDisconnect):
            told = 0
            while True:
                state, forwarding = console.state_for(peer), console.watch.forwarding
                if told != forwarding.told:
                    told, state["mission"] = forwarding.told, forwarding.mission()
                await socket.send_text(json.dumps(state, separators=(",", ":")))
                await asyncio.sleep(PERIOD_S)

    return Starlette(
        routes=[
            Route("/", index),
            Route("/api/machine", api_machine),
            Route("/api/state", api_state),
            Route("/api/trail", api_trail),
            Route("/api/operator/{action}", operator, methods=["POST"]),
            Route("/api/mission/{order}", mission, methods=["POST"]),
            Route("/healthz", healthz),
            WebSocketRoute("/ws", ws),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[
            Middleware(RequestGuards, names={*LOOPBACK_NAMES, *allow_hosts}, policy=content_security_policy(page))
        ],
        lifespan=lifespan,
    )
