"""The server of the operator's web page: shows crane, vehicle and mission; sends operator commands.

Inputs: crane and vehicle reports of the controller and mission reports of the planner (UDP, one port), log lists of the
detector (UDP, requested ten times a second, optional), the controller's timing page (read once a second, optional), and
commands by POST.  Outputs: the page, ``/ws`` with the state 20 times a second (and the mission after each report),
``/api/state``, ``/api/trail`` (the vehicle's track), ``/api/timeline``, ``/api/camera`` (`console.camera`),
``/api/machine``, ``/healthz``; one
``OperatorCommand`` datagram per command to the controller, one ``MissionCommand`` datagram per mission command to the
planner.  Pages that may command answer on ``/ws``, which makes the heartbeats of their watch (`console.console`);
a page that shows a panel says so there and gets its data (`console.panel`).

STOP is accepted from every page that the console serves, at once and without more.  Everything else needs a session
that a person opened, a page's token and a role, and what can move the machine the control lease as well
(`console.access`).  All resources are served from the package; no other host is contacted.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any, Final

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from autonomy.missions.folder import MissionFolder
from autonomy.perception.log_list import decode_logs, encode_request
from can_dbc.messages.crane import WATCH_ACTIONS, OperatorAction
from can_dbc.messages.mission import MissionAction
from can_dbc.timing.page import read_timing
from console.access import Access, Page
from console.access_guards import AccessGuards, AuditTrail, page_of, person_of
from console.access_routes import access_routes
from console.accounts import Role
from console.camera import Camera
from console.console import Address, Console
from console.fault_watch import FaultWatch
from console.foxglove_server import feed_pictures
from console.guards import STATIC, guarded, json_route, page_route, send
from console.panel import Panel, panel_data, panels_of
from console.plan_api import PlanApi
from console.plant_link import TrueLogs
from console.state import CraneState, describe_machine
from runtime.errors import InputRefused

# -- The page's buttons to try to break a live run: asks the desk of faults, and follows what becomes of each.
#
# The harness of a live run gives the desk's socket (`--faults`); the console of a machine has none, and then these
# addresses do not exist.  A fault needs the control lease.


ANSWER_S: Final = 6.0
MAX_ANSWER_BYTES: Final = 65_536


def fault_routes(desk: Path, watch: FaultWatch, access: Access) -> list[Route]:
    """Make the routes of faults: ``/api/faults`` lists what can be tried; a POST to ``/api/faults/NAME`` tries it."""
    trying = asyncio.Lock()

    async def listed(_: Request) -> Response:
        response = await _ask(desk, {"op": "list"})
        return JSONResponse(response["faults"]) if "faults" in response else PlainTextResponse(_error(response), 502)

    async def inject(request: Request) -> Response:
        if why := access.refusal(page_of(request), Role.OPERATOR, leased=True):
            return PlainTextResponse(why, 403)
        if trying.locked():
            return PlainTextResponse("Another fault is being injected.", 409)
        async with trying:
            response = await _ask(desk, {"op": "inject", "name": request.path_params["name"]})
        if "at_ns" not in response:
            return PlainTextResponse(_error(response), 409)
        watch.begin(str(response["title"]), str(response["said"]), int(response["at_ns"]))
        return Response(status_code=204)

    return [Route("/api/faults", listed), Route("/api/faults/{name}", inject, methods=["POST"])]


async def _ask(desk: Path, request: dict[str, str]) -> dict[str, Any]:
    try:
        async with asyncio.timeout(ANSWER_S):
            reader, writer = await asyncio.open_unix_connection(str(desk), limit=MAX_ANSWER_BYTES)
            try:
                writer.write(json.dumps(request).encode() + b"\n")
                response = json.loads(await reader.readline())
            finally:
                writer.close()
    except TimeoutError:
        return {"error": f"The run's desk of faults does not answer within {ANSWER_S:.0f} s."}
    except (OSError, ValueError) as error:
        return {"error": f"The run's desk of faults does not answer ({error})."}
    return response if isinstance(response, dict) else {}


def _error(told: dict[str, Any]) -> str:
    return str(told.get("error") or "The run's desk of faults gave no answer.")


# -- The server of the operator's web page


PERIOD_S: Final = 0.05
LOG_REQUEST_PERIOD_S: Final = 0.1  # a log in the grapple moves with it
TIMING_PERIOD_S: Final = 1.0

BUTTONS: Final = tuple(action.name for action in OperatorAction if action not in WATCH_ACTIONS)


class _Receiver(asyncio.DatagramProtocol):
    """Hands every datagram to ``take``."""

    def __init__(self, take: Callable[[bytes], object]) -> None:
        self._take = take

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._take(data)


def _take_logs(crane_state: CraneState, data: bytes) -> None:
    with contextlib.suppress(InputRefused):
        crane_state.logs = decode_logs(data)


async def _request_logs(transport: asyncio.DatagramTransport) -> None:
    while True:
        transport.sendto(encode_request(()))  # without joints: the logs that are already known
        await asyncio.sleep(LOG_REQUEST_PERIOD_S)


async def _read_timing(crane_state: CraneState, page: Path) -> None:
    while True:
        with contextlib.suppress(InputRefused):  # no page yet; the last state times out
            crane_state.on_timing(await asyncio.to_thread(read_timing, page))
        await asyncio.sleep(TIMING_PERIOD_S)


async def _hear(socket: WebSocket, console: Console, page: Page | None, panel: Panel) -> None:
    """Take the answers of a page, and which panel it shows, until it is gone."""
    async with contextlib.AsyncExitStack() as looking:
        while (message := await socket.receive())["type"] != "websocket.disconnect":
            text = message.get("text") or ""
            if not panel.choose(text):
                console.watch(text, page)
                continue
            await looking.aclose()
            if panel.shown == "can":
                await looking.enter_async_context(console.can_tap.viewer())


FREE_ORDERS: Final = frozenset({MissionAction.PAUSE})
"""Mission commands that any operator may give: they only stop."""


def _respond(send: Callable[[], None], who: str, where: str) -> Response:
    """Send, and report an unreachable receiver."""
    try:
        send()
    except OSError as error:
        return PlainTextResponse(f"The {who} at {where} cannot be reached: {error.strerror or error}.", 502)
    return Response(status_code=204)


def _commission_routes(console: Console) -> list[Route]:
    """Make the routes of the commissioning page; its procedures are imported only where there is one."""
    options, bus = console.commission, console.buses.get(console.profile.crane_bus)
    if options is None or bus is None:
        return []
    from console.commission_api import CommissionApi
    from console.commissioning import Commissioning

    work = Commissioning(
        console.profile,
        console.profile_hash,
        options.source,
        options.folder,
        options.controller,
        bus,
        console.key,
        lambda: console.crane_state.report,
    )
    return CommissionApi(work, console.access).routes()


def create_app(console: Console, allow_hosts: Collection[str] = ()) -> Starlette:
    """Build the ASGI application; ``allow_hosts`` are host names to serve in addition to this machine's."""
    machine = describe_machine(console.profile)
    plan = PlanApi(
        console.profile,
        console.access,
        None if console.missions is None else MissionFolder(console.missions),
        None if console.planner is None else console.offer,
        lambda: console.crane_state.mission_state.answer,
    )

    camera = Camera(console.scene, console.crane_state, console.clock)
    true_logs = None if console.truth is None else TrueLogs(console.truth)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            await stack.enter_async_context(camera.connected())
            if console.foxglove is not None:
                feeding = asyncio.create_task(feed_pictures(console.foxglove, camera))
                stack.callback(console.foxglove.close)
                stack.callback(feeding.cancel)
            if true_logs is not None:
                await stack.enter_async_context(true_logs.connected())
            if console.reports:
                receiver = _Receiver(lambda data: console.crane_state.on_report(data, console.clock()))
                reports, _protocol = await loop.create_datagram_endpoint(lambda: receiver, sock=console.reports)
                stack.callback(reports.close)
            if console.scene:
                logs = _Receiver(partial(_take_logs, console.crane_state))
                scene, _protocol = await loop.create_datagram_endpoint(lambda: logs, remote_addr=console.scene)
                requesting = asyncio.create_task(_request_logs(scene))
                stack.callback(scene.close)
                stack.callback(requesting.cancel)
            if console.timing_page:
                stack.callback(asyncio.create_task(_read_timing(console.crane_state, console.timing_page)).cancel)
            yield

    async def api_machine(_: Request) -> Response:
        commissions = console.commission is not None
        return JSONResponse(
            machine
            | {
                "commissions": commissions,
                "run": str(console.recording or ""),
                "panels": panels_of(console.can_tap, bool(console.timing_page), bool(console.faults)),
                "truth": console.truth is not None,
            }
        )

    async def api_state(request: Request) -> Response:
        state = console.state_for(page_of(request), person_of(request))
        return JSONResponse(state | {"mission": console.crane_state.mission_state.mission()})

    async def healthz(_: Request) -> Response:
        alive = console.crane_state.alive(console.clock())
        return JSONResponse({"console": "ok", "controller": "alive" if alive else "silent"})

    async def operator(request: Request) -> Response:
        name = request.path_params["action"].upper()
        if name not in BUTTONS:
            return PlainTextResponse(f"Unknown command {name}.", 404)
        return press(request, OperatorAction[name])

    def press(request: Request, action: OperatorAction) -> Response:
        if console.operator is None:
            return PlainTextResponse("This console is read-only; start it with --operator FILE.", 409)
        if action is not OperatorAction.STOP:
            leased = action in (OperatorAction.ARM, OperatorAction.RESET)
            if why := console.access.refusal(page_of(request), Role.OPERATOR, leased):
                return PlainTextResponse(why, 403)
        if action is OperatorAction.WATCH_END and not console.page_watch.end(
            request.path_params["page"], console.clock()
        ):
            return Response(status_code=204)  # another page watches
        return _respond(lambda: console.command(action), "controller", str(console.operator))

    async def begin_shift(request: Request) -> Response:
        if why := console.access.refusal(page_of(request), Role.OPERATOR, False):
            return PlainTextResponse(why, 403)
        console.crane_state.shift.begin(console.clock())
        return Response(status_code=204)

    async def watch_end(request: Request) -> Response:
        return press(request, OperatorAction.WATCH_END)

    async def mission(request: Request) -> Response:
        name = request.path_params["order"].upper().replace("-", "_")
        if name not in MissionAction.__members__:
            return PlainTextResponse(f"Unknown mission command {name}.", 404)
        if console.planner is None:
            return PlainTextResponse("This console sends no mission commands; start it with --planner HOST:PORT.", 409)
        if why := console.access.refusal(page_of(request), Role.OPERATOR, MissionAction[name] not in FREE_ORDERS):
            return PlainTextResponse(why, 403)
        host, port = console.planner
        return _respond(lambda: console.mission_command(MissionAction[name]), "planner", f"{host}:{port}")

    async def ws(socket: WebSocket) -> None:
        await socket.accept()
        page, person, panel = page_of(socket), person_of(socket), Panel()
        hearing = asyncio.create_task(_hear(socket, console, page, panel))
        with contextlib.suppress(WebSocketDisconnect), console.access.connected(page):
            sent_count = 0
            while not hearing.done() and console.access.is_valid(page, socket.scope["session"]):
                state, mission_state = console.state_for(page, person), console.crane_state.mission_state
                if sent_count != mission_state.report_count:
                    sent_count, state["mission"] = mission_state.report_count, mission_state.mission()
                if panel.due(state["sent_ms"]):
                    state |= panel_data(panel.shown, console.can_tap, console.crane_state)
                await send(socket, json.dumps(state, separators=(",", ":")))
                await asyncio.sleep(PERIOD_S)
            if not hearing.done():
                await socket.close(1008, "The session has ended.")
        hearing.cancel()

    app = Starlette(
        routes=[
            page_route("/", "index.html"),
            Route("/api/machine", api_machine),
            Route("/api/state", api_state),
            json_route("/api/trail", lambda: list(console.crane_state.mission_state.trail)),
            json_route("/api/timeline", lambda: list(console.crane_state.timeline.entries)),
            Route("/api/operator/{action}", operator, methods=["POST"]),
            Route("/api/watch-end/{page}", watch_end, methods=["POST"]),
            Route("/api/mission/{order}", mission, methods=["POST"]),
            Route("/api/shift/begin", begin_shift, methods=["POST"]),
            *plan.routes(),
            *camera.routes(),
            *(() if true_logs is None else true_logs.routes()),
            Route("/healthz", healthz),
            *(fault_routes(console.faults, console.crane_state.fault_watch, console.access) if console.faults else ()),
            *access_routes(console.access, console.tls),
            *_commission_routes(console),
            WebSocketRoute("/ws", ws),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[
            *([Middleware(AuditTrail, log=console.audit)] if console.audit else ()),
            guarded("index.html", allow_hosts),
            Middleware(AccessGuards, access=console.access),
        ],
        lifespan=lifespan,
    )
    app.state.access = console.access
    return app
