"""The camera's picture on the page: asks the log detector for it, only while a page shows it.

``/api/camera`` says what belongs to the newest picture, ``/api/camera/NUMBER`` is its JPEG.  However many pages ask,
the detector is asked at most twice a second, and answers beside its own work: controller and planner take no part.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from can_dbc.messages.picture import PictureFacts, decode_picture, encode_picture_request
from console.state import CraneState
from runtime.errors import InputRefused

# -- The camera's newest picture for the page: what belongs to it, and where the chosen grasp is in it.  Pure.
#
# The picture comes from the log detector (`can_dbc.messages.picture`).  The grasp is in the crane's base frame, so
# it is drawn only while the machine stands where the picture was taken.


SILENT_NS: Final = 5_000_000_000
"""A detector that has not answered for this long is said not to answer; a detection takes a second or two."""
MOVED_M: Final = 0.05
TURNED_RAD: Final = 0.02
MIN_DEPTH_M: Final = 0.1
NO_DETECTOR: Final = "No camera: this console is not connected to a log detector (--scene)."
NO_CAMERA: Final = "No camera: the log detector of this run works without pictures."
WAITING: Final = "The log detector has not answered yet."
SILENT: Final = "The log detector does not answer: check that its process runs."
NO_PICTURE: Final = "No picture has been measured yet: the detector looks when the planner asks and the crane rests."

Place = dict[str, float]
"""Of the vehicle: ``x_m``, ``y_m``, ``front_rad``, ``rear_rad``."""


class CameraState:
    """The newest picture of one detector; ``jpegs`` has its JPEG and the one before, by ``measured_ns``."""

    def __init__(self) -> None:
        self.jpegs: dict[int, bytes] = {}
        self.facts: PictureFacts | None = None
        self._problem = ""
        self._asked_ns = self._unanswered_ns = self._answered_ns = 0
        self._without_camera = False
        self._place: Place | None = None

    def request(self, now_ns: int) -> bytes:
        """Encode the next request to the detector: for a picture that is newer than this one."""
        if not self._unanswered_ns or now_ns - self._asked_ns > SILENT_NS:
            self._unanswered_ns = now_ns  # nobody looked for a while: an old question tells nothing
        self._asked_ns = now_ns
        return encode_picture_request(self.facts.measured_ns if self.facts else 0)

    def on_reply(self, data: bytes, now_ns: int, place: Place | None) -> None:
        """Take a datagram of the detector; ``place`` is where the vehicle is now, None for a stationary machine."""
        self._answered_ns, self._unanswered_ns = now_ns, 0
        try:
            facts, jpeg = decode_picture(data)
        except InputRefused as error:
            self._without_camera, self._problem = error.code == "picture.no-camera", str(error)
            return
        self._without_camera, self._problem = False, facts.problem
        if jpeg:
            before = self.facts.measured_ns if self.facts else 0
            # A page may still fetch the picture of which it was told before.
            self.jpegs = {n: data for n, data in self.jpegs.items() if n == before} | {facts.measured_ns: jpeg}
            self.facts, self._place = facts, place

    def page(self, now_ns: int, grasp: dict[str, Any] | None, place: Place | None) -> dict[str, Any]:
        """Return what the page shows: ``words`` say why there is no picture or no newer one, empty when all is well."""
        facts = self.facts
        if facts is None:
            return {"picture": 0, "words": self._why_none(now_ns)}
        moved = self._moved(place)
        return {
            "picture": facts.measured_ns,
            "words": SILENT if self._silent(now_ns) else self._problem,
            "age_s": round(max(0, now_ns - facts.measured_ns) * 1e-9, 1),
            "camera": facts.camera,
            "width_px": facts.width_px,
            "height_px": facts.height_px,
            "logs": [
                {
                    "id": log.id,
                    "ends_px": log.ends_px,
                    "length_m": log.length_m,
                    "diameter_m": log.diameter_m,
                    "seen": log.seen,
                }
                for log in facts.logs
            ],
            "moved": moved,
            "grasp": None
            if grasp is None
            else {
                "tips_px": None if moved else _projected(facts, grasp["tips"]),
                "logs": grasp["logs"],
                "reason": grasp["reason"],
            },
        }

    def _silent(self, now_ns: int) -> bool:
        return bool(self._unanswered_ns) and now_ns - self._unanswered_ns > SILENT_NS

    def _why_none(self, now_ns: int) -> str:
        if self._silent(now_ns):
            return SILENT
        if self._without_camera:
            return NO_CAMERA
        if not self._answered_ns:
            return WAITING
        return f"No picture: {self._problem}." if self._problem else NO_PICTURE

    def _moved(self, place: Place | None) -> bool:
        before = self._place
        if before is None or place is None:
            return False
        turned = max(abs(math.remainder(place[k] - before[k], math.tau)) for k in ("front_rad", "rear_rad"))
        return math.hypot(place["x_m"] - before["x_m"], place["y_m"] - before["y_m"]) > MOVED_M or turned > TURNED_RAD


def _projected(facts: PictureFacts, points_m: list[list[float]]) -> list[list[float]] | None:
    """Project base-frame points [m] to pixels; None when one is not in front of the camera."""
    pixels_px = []
    for point in points_m:
        d = [p - o for p, o in zip(point, facts.position_m, strict=True)]
        x, y, z = (sum(d[row] * facts.rotation[3 * row + axis] for row in range(3)) for axis in range(3))
        if z < MIN_DEPTH_M:
            return None
        pixels_px.append([round(facts.fx_px * x / z + facts.cx_px, 1), round(facts.fy_px * y / z + facts.cy_px, 1)])
    return pixels_px


# -- The camera's picture on the page


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
        """Keep the link to the detector open while the context lasts."""
        if self._detector is None:
            yield
            return
        transport, self._link = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: CameraLink(self._crane_state, self._clock), remote_addr=self._detector
        )
        yield
        transport.close()

    async def newest(self) -> tuple[PictureFacts, bytes] | None:
        """Return facts and JPEG of the newest picture, after asking for a newer one; None before the first."""
        if self._link is None:
            return None
        await self._link.ask()
        state = self._link.camera_state
        return None if state.facts is None else (state.facts, state.jpegs[state.facts.measured_ns])

    def routes(self) -> list[Route]:
        """Make the routes of ``/api/camera`` and the JPEG."""
        return [Route("/api/camera", self._facts), Route("/api/camera/{number:int}", self._jpeg)]

    async def _facts(self, _: Request) -> Response:
        if self._link is None:
            return JSONResponse({"picture": 0, "words": NO_DETECTOR})
        await self._link.ask()
        now_ns = self._clock()
        grasp = self._crane_state.grasp_state.shown(now_ns)
        vehicle_pose = self._crane_state.mission_state.place
        return JSONResponse(self._link.camera_state.page(now_ns, grasp, vehicle_pose))

    async def _jpeg(self, request: Request) -> Response:
        state = None if self._link is None else self._link.camera_state
        jpeg = None if state is None else state.jpegs.get(request.path_params["number"])
        if jpeg is None:
            return PlainTextResponse("This picture is gone: newer ones have been measured.", 404)
        return Response(jpeg, media_type="image/jpeg")
