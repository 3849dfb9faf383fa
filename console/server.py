"""The server of the operator's web page: shows crane, vehicle and mission; sends operator commands.

Inputs: crane and vehicle reports of the controller and mission reports of the planner (UDP, one port), log lists of the
detector (UDP, requested ten times a second, optional), the controller's timing page (read once a second, optional), and
commands by POST.  Outputs: the page, ``/ws`` with the state 20 times a second (and the mission after each report),
``/api/state``, ``/api/trail`` (the vehicle's track), ``/api/machine``, ``/healthz``; one ``OperatorCommand`` datagram
per command to the controller, one ``MissionCommand`` datagram per mission command to the planner.

STOP is accepted from every page that the console serves; ARM, DISARM, RESET and mission commands only from this machine
(an ssh tunnel counts as this machine).  All resources are served from the package; no other host is contacted.
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
from can_dbc.messages import operator_link
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import MissionAction, MissionCommand, encode_mission_command
from can_dbc.timing.page import TimingRefused, read_timing
from console.guards import LOOPBACK_NAMES, RequestGuards, content_security_policy, is_loopback
from console.state import CraneState, describe_machine
from machine.profile import Profile

PERIOD_S: Final = 0.05
LOG_REQUEST_PERIOD_S: Final = 0.1  # a log in the grapple moves with it
TIMING_PERIOD_S: Final = 1.0
STATIC: Final = Path(__file__).with_name("static")

Address = tuple[str, int]


@dataclass(slots=True)
class Console:
    """Configuration and state of the console.

    ``operator`` None: the page is read-only; ``planner`` None: it sends no mission commands.
    """

    profile: Profile
    profile_hash: int
    operator: Path | None = None
    scene: Address | None = None
    key: bytes | None = None
    reports: socket.socket | None = None
    """A bound UDP socket on which the reports of controller and planner arrive."""
    planner: Address | None = None
    timing_page: Path | None = None
    clock: Callable[[], int] = time.monotonic_ns
    crane_state: CraneState = field(init=False)
    _sequence: int = 0

    def __post_init__(self) -> None:
        self.crane_state = CraneState(self.profile, self.key, self.profile_hash)

    def command(self, action: OperatorAction) -> None:
        """Send one operator command.

        Raises:
            OSError: it cannot be sent.
        """
        assert self.operator is not None
        message = OperatorCommand(self._next(), self.profile_hash, self.clock(), action)
        operator_link.send(encode(message, self.key), self.operator)

    def mission_command(self, action: MissionAction) -> None:
        """Send one mission command to the planner.

        Raises:
            OSError: it cannot be sent.
        """
        assert self.planner is not None
        message = MissionCommand(self._next(), self.profile_hash, self.clock(), action)
        _send(encode_mission_command(message, self.key), self.planner)

    def _next(self) -> int:
        # Starts from the clock, so that commands of a restarted console are not taken for a replay.
        self._sequence = max(self._sequence + 1, self.clock() // 1_000_000 & 0x7FFF_FFFF)
        return self._sequence

    def state_for(self, peer: str | None) -> dict[str, Any]:
        """The page's state and the permissions of the viewer at ``peer``."""
        can = self.operator is not None
        return {
            **self.crane_state.state(self.clock()),
            "may_stop": can,
            "may_command": can and is_loopback(peer),
            "may_order": self.planner is not None and is_loopback(peer),
        }


def _send(data: bytes, to: Address) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(to)
        out.send(data)
        # On loopback the kernel reports at once that nobody listens.
        if code := out.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(code, os.strerror(code))


class _Reports(asyncio.DatagramProtocol):
    def __init__(self, console: Console) -> None:
        self._console = console

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._console.crane_state.on_report(data, self._console.clock())


class _Logs(asyncio.DatagramProtocol):
    def __init__(self, console: Console) -> None:
        self._console = console

    def datagram_received(self, data: bytes, addr: Address) -> None:
        with contextlib.suppress(LogListError):
            self._console.crane_state.logs = decode_logs(data)


async def _request_logs(transport: asyncio.DatagramTransport) -> None:
    while True:
        transport.sendto(encode_request(()))  # without joints: the logs that are already known
        await asyncio.sleep(LOG_REQUEST_PERIOD_S)


async def _read_timing(crane_state: CraneState, page: Path) -> None:
    while True:
        with contextlib.suppress(TimingRefused):  # no page yet; the last state times out
            crane_state.on_timing(await asyncio.to_thread(read_timing, page))
        await asyncio.sleep(TIMING_PERIOD_S)


def _not_local(name: str) -> Response:
    return PlainTextResponse(f"{name} is accepted only from the machine that runs the console.", 403)


def _respond(send: Callable[[], None], who: str, where: str) -> Response:
    """Send, and report an unreachable receiver."""
    try:
        send()
    except OSError as error:
        return PlainTextResponse(f"The {who} at {where} cannot be reached: {error.strerror}.", 502)
    return Response(status_code=204)


def create_app(console: Console, allow_hosts: Collection[str] = ()) -> Starlette:
    """The ASGI application; ``allow_hosts`` are host names to serve in addition to this machine's."""
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
                requesting = asyncio.create_task(_request_logs(scene))
                stack.callback(scene.close)
                stack.callback(requesting.cancel)
            if console.timing_page:
                stack.callback(asyncio.create_task(_read_timing(console.crane_state, console.timing_page)).cancel)
            yield

    async def index(_: Request) -> Response:
        return FileResponse(STATIC / "index.html", media_type="text/html")

    async def api_machine(_: Request) -> Response:
        return JSONResponse(machine)

    async def api_state(request: Request) -> Response:
        state = console.state_for(request.client.host if request.client else None)
        return JSONResponse(state | {"mission": console.crane_state.mission_state.mission()})

    async def api_trail(_: Request) -> Response:
        return JSONResponse(list(console.crane_state.mission_state.trail))

    async def healthz(_: Request) -> Response:
        alive = console.crane_state.alive(console.clock())
        return JSONResponse({"console": "ok", "controller": "alive" if alive else "silent"})

    async def operator(request: Request) -> Response:
        name = request.path_params["action"].upper()
        if name not in OperatorAction.__members__:
            return PlainTextResponse(f"Unknown command {name}.", 404)
        if console.operator is None:
            return PlainTextResponse("This console is read-only; start it with --operator FILE.", 409)
        peer = request.client.host if request.client else None
        if name != "STOP" and not is_loopback(peer):
            return _not_local(name)
        return _respond(lambda: console.command(OperatorAction[name]), "controller", str(console.operator))

    async def mission(request: Request) -> Response:
        name = request.path_params["order"].upper().replace("-", "_")
        if name not in MissionAction.__members__:
            return PlainTextResponse(f"Unknown mission command {name}.", 404)
        if console.planner is None:
            return PlainTextResponse("This console sends no mission commands; start it with --planner HOST:PORT.", 409)
        if not is_loopback(request.client.host if request.client else None):
            return _not_local(name)
        host, port = console.planner
        return _respond(lambda: console.mission_command(MissionAction[name]), "planner", f"{host}:{port}")

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        peer = socket.client.host if socket.client else None
        with contextlib.suppress(WebSocketDisconnect):
            sent_count = 0
            while True:
                state, mission_state = console.state_for(peer), console.crane_state.mission_state
                if sent_count != mission_state.report_count:
                    sent_count, state["mission"] = mission_state.report_count, mission_state.mission()
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
