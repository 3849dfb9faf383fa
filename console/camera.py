"""The camera's picture on the page: asks the log detector for it, only while a page shows it.

``/api/camera`` says what belongs to the newest picture, ``/api/camera/NUMBER`` is its JPEG.  However many pages ask,
the detector is asked at most twice a second, and answers beside its own work: controller and planner take no part.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Final

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from can_dbc.messages.picture import PictureFacts
from console.camera_state import NO_DETECTOR, CameraState
from console.state import CraneState

ASK_PERIOD_NS: Final = 450_000_000
ANSWER_S: Final = 0.3
"""A page waits so long for a newer picture and is then answered with the last one."""
Address = tuple[str, int]


class CameraLink(asyncio.DatagramProtocol):
    """Asks one detector."""

    def __init__(self, crane_state: CraneState, clock: Callable[[], int]) -> None:
        self.camera_state = CameraState()
        self._crane_state, self._clock = crane_state, clock
        self._transport: asyncio.DatagramTransport | None = None
        self._answered = asyncio.Event()
        self._asked_ns = 0

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self._transport = transport

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self.camera_state.on_reply(data, self._clock(), self._crane_state.mission_state.place)
        self._answered.set()

    async def ask(self) -> None:
        """Ask for a newer picture, unless that was done just now, and wait shortly for the answer."""
        now_ns = self._clock()
        if self._transport is None or now_ns - self._asked_ns < ASK_PERIOD_NS:
            return
        self._asked_ns = now_ns
        self._answered.clear()
        self._transport.sendto(self.camera_state.request(now_ns))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._answered.wait(), ANSWER_S)


class Camera:
    """The routes of the camera; ``detector`` None: the page says that there is none."""

    def __init__(self, detector: Address | None, crane_state: CraneState, clock: Callable[[], int]) -> None:
        self._detector, self._crane_state, self._clock = detector, crane_state, clock
        self._link: CameraLink | None = None

    @contextlib.asynccontextmanager
    async def connected(self) -> AsyncIterator[None]:
        """While it lasts the detector can be asked."""
        if self._detector is None:
            yield
            return
        transport, self._link = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: CameraLink(self._crane_state, self._clock), remote_addr=self._detector
        )
        yield
        transport.close()

    async def newest(self) -> tuple[PictureFacts, bytes] | None:
        """Facts and JPEG of the newest picture, after asking for a newer one; None before the first."""
        if self._link is None:
            return None
        await self._link.ask()
        state = self._link.camera_state
        return None if state.facts is None else (state.facts, state.jpegs[state.facts.measured_ns])

    def routes(self) -> list[Route]:
        """``/api/camera`` and the JPEG."""
        return [Route("/api/camera", self._facts), Route("/api/camera/{number:int}", self._jpeg)]

    async def _facts(self, _: Request) -> Response:
        if self._link is None:
            return JSONResponse({"picture": 0, "words": NO_DETECTOR})
        await self._link.ask()
        now_ns = self._clock()
        grasp = self._crane_state.grasp_state.shown(now_ns)
        place = self._crane_state.mission_state.place
        return JSONResponse(self._link.camera_state.page(now_ns, grasp, place))

    async def _jpeg(self, request: Request) -> Response:
        state = None if self._link is None else self._link.camera_state
        jpeg = None if state is None else state.jpegs.get(request.path_params["number"])
        if jpeg is None:
            return PlainTextResponse("This picture is gone: newer ones have been measured.", 404)
        return Response(jpeg, media_type="image/jpeg")
