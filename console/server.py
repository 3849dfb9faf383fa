"""The operator's web page: watch the crane, stop it, arm it.

Inputs: the controller's state reports (UDP), the detector's log list (UDP, asked twice a second, optional) and the
operator's commands (POST).  Outputs: a page, ``/ws`` with the state 20 times a second, ``/api/state``,
``/api/machine``, ``/healthz``, and one ``OperatorCommand`` datagram per command to the controller.

STOP is accepted from every page that may see the console; ARM, DISARM and RESET only from this machine (an ssh tunnel
counts as this machine).  Everything is served from the package: no other host is ever asked for anything.
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

from autonomy.logs import QUESTION, LogsRefused, parse_logs
from can_dbc.setpoint import OperatorAction, OperatorCommand, encode
from console.guards import LOOPBACK_NAMES, Guards, content_security_policy, is_loopback
from console.state import Watch, describe_machine
from machine.profile import Profile

PERIOD_S: Final = 0.05
ASK_LOGS_S: Final = 0.5
STATIC: Final = Path(__file__).with_name("static")

Address = tuple[str, int]


@dataclass(slots=True)
class Console:
    """The console's configuration and what it knows.  ``controller`` None: the page only watches."""

    profile: Profile
    profile_hash: int
    controller: Address | None = None
    scene: Address | None = None
    key: bytes | None = None
    reports: socket.socket | None = None
    """A bound UDP socket on which the controller's reports arrive."""
    clock: Callable[[], int] = time.monotonic_ns
    watch: Watch = field(init=False)
    _sequence: int = 0

    def __post_init__(self) -> None:
        self.watch = Watch(self.profile, self.key)

    def command(self, action: OperatorAction) -> None:
        """Send one operator command; raises OSError."""
        assert self.controller is not None
        now_ns = self.clock()
        # Starts from the clock, so that a restarted console is no replay of the one before.
        self._sequence = max(self._sequence + 1, now_ns // 1_000_000 & 0x7FFF_FFFF)
        message = OperatorCommand(self._sequence, self.profile_hash, now_ns, action)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.connect(self.controller)
            out.send(encode(message, self.key))
            # On loopback the kernel says at once when nobody listens.
            if code := out.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(code, os.strerror(code))

    def state_for(self, peer: str | None) -> dict[str, Any]:
        """The page's state with what the viewer at ``peer`` may do."""
        can = self.controller is not None
        return {
            **self.watch.state(self.clock()),
            "may_stop": can,
            "may_command": can and is_loopback(peer),
        }


class _Reports(asyncio.DatagramProtocol):
    def __init__(self, console: Console) -> None:
        self._console = console

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._console.watch.on_report(data, self._console.clock())


class _Logs(asyncio.DatagramProtocol):
    def __init__(self, console: Console) -> None:
        self._console = console

    def datagram_received(self, data: bytes, addr: Address) -> None:
        with contextlib.suppress(LogsRefused):
            self._console.watch.logs = parse_logs(data)


async def _ask_logs(transport: asyncio.DatagramTransport) -> None:
    while True:
        transport.sendto(QUESTION)
        await asyncio.sleep(ASK_LOGS_S)


def create_app(console: Console, allow_hosts: Collection[str] = ()) -> Starlette:
    """The ASGI application; ``allow_hosts`` are names to serve besides this machine's own."""
    page = (STATIC / "index.html").read_text()
    machine = describe_machine(console.profile)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            if console.reports:
                reports, _ = await loop.create_datagram_endpoint(lambda: _Reports(console), sock=console.reports)
                stack.callback(reports.close)
            if console.scene:
                scene, _ = await loop.create_datagram_endpoint(lambda: _Logs(console), remote_addr=console.scene)
                asking = asyncio.create_task(_ask_logs(scene))
                stack.callback(scene.close)
                stack.callback(asking.cancel)
            yield

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "index.html", media_type="text/html")

    async def api_machine(_: Request) -> Response:
        return JSONResponse(machine)

    async def api_state(request: Request) -> Response:
        return JSONResponse(console.state_for(request.client.host if request.client else None))

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
            return PlainTextResponse(f"{name} is accepted only from the machine that runs the console.", 403)
        try:
            console.command(OperatorAction[name])
        except OSError as error:
            host, port = console.controller
            reason = error.strerror
            return PlainTextResponse(f"The controller at {host}:{port} cannot be reached: {reason}.", 502)
        return Response(status_code=204)

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        peer = socket.client.host if socket.client else None
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await socket.send_text(json.dumps(console.state_for(peer), separators=(",", ":")))
                await asyncio.sleep(PERIOD_S)

    return Starlette(
        routes=[
            Route("/", index),
            Route("/api/machine", api_machine),
            Route("/api/state", api_state),
            Route("/api/operator/{action}", operator, methods=["POST"]),
            Route("/healthz", healthz),
            WebSocketRoute("/ws", ws),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[Middleware(Guards, names={*LOOPBACK_NAMES, *allow_hosts}, policy=content_security_policy(page))],
        lifespan=lifespan,
    )
