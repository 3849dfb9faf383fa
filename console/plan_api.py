"""The requests of the plan page: check, import, export, save, and upload to the planner.

Planning needs no controller and no network.  Every POST needs the role operator, an upload the control lease as well;
its body is limited, and its JSON is checked against the mission's schema; a refusal is one sentence, with a code where
a mission is at fault.  Checks run one after another in a thread beside the server, so that STOP never waits for one.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from autonomy.missions import geojson
from autonomy.missions.export import FORMATS, export
from autonomy.missions.folder import MissionFolder
from autonomy.missions.mission_file import read
from autonomy.missions.model import ForwardingMission, MissionError
from autonomy.missions.review import review
from autonomy.missions.source import MAX_JSON_BYTES
from autonomy.missions.validation import Finding, problems_of
from console.access import Access
from console.access_guards import page_of, person_of
from console.accounts import Role
from console.guards import page_route
from machine.profile import Carrier, Profile
from runtime.errors import InputRefused

# -- What the plan page is told about a mission: errors and warnings with the part that each is about, time and
# wood.
#
# The checks are those of ``timberhand plan check``.  Pure; a large mission takes seconds.


MAX_FINDINGS = 100


def mission_of(body: bytes) -> ForwardingMission:
    """Decode the mission in a request.

    Raises:
        InputRefused: it is not JSON, or a field is unknown, missing or of the wrong type.
    """
    try:
        return msgspec.json.decode(body, type=ForwardingMission)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        reason = str(error)[:200].rstrip(".")
        raise InputRefused("plan.document", f"This is not a mission of this page: {reason}.") from None


def site_of(carrier: Carrier) -> tuple[float, float]:
    """Return latitude and longitude [deg] of the machine's site."""
    return carrier.site_lat_deg, carrier.site_lon_deg


def reviewed(mission: ForwardingMission, profile: Profile) -> dict[str, Any]:
    """List errors, warnings and, of a mission that can be driven, the estimate."""
    assert profile.carrier is not None
    errors = problems_of(mission, True, site_of(profile.carrier))
    answer: dict[str, Any] = {"errors": _told(errors), "warnings": [], "estimate": None, "wood": wood(mission)}
    if not errors:
        figures = review(mission, profile)
        answer["warnings"] = _told(list(figures.warnings))
        answer["estimate"] = {
            "length_m": round(figures.length_m, 1),
            "drive_s": round(figures.drive_s),
            "crane_s": round(figures.crane_s),
            "total_s": round(figures.total_s),
            "logs": figures.logs,
        }
    return answer


def wood(mission: ForwardingMission) -> dict[str, Any]:
    """Count the listed logs and those without a size, sum their volume, and list their kinds."""
    volumes = [log.volume_m3 for log in mission.logs]
    return {
        "logs": len(volumes),
        "volume_m3": round(sum(v for v in volumes if v is not None), 3),
        "unsized": sum(v is None for v in volumes),
        "kinds": sorted({log.assortment or log.species for log in mission.logs} - {""})[:20],
    }


def imported(data: bytes, name: str) -> dict[str, Any]:
    """Return the mission in a file of any format; its errors are found by the check that follows.

    Raises:
        MissionError: it cannot be read as a mission.
    """
    draft = read(data, name)
    notes = [*(problem.sentence for problem in draft.warnings), *draft.notes]
    return {"mission": msgspec.to_builtins(draft.mission), "format": draft.format, "notes": notes}


def _told(findings: list[Finding]) -> list[dict[str, Any]]:
    return [
        {"code": f.code, "sentence": f.sentence, "part": None if f.key is None else list(f.key)}
        for f in findings[:MAX_FINDINGS]
    ]


# -- The requests of the plan page


MAX_BODY_BYTES: Final = MAX_JSON_BYTES
MAX_QUERY_CHARS: Final = 100
ANSWER_S: Final = 3.0
"""So long the planner may take to answer an upload; it reports at once."""
Answer = tuple[int, str, str]
"""Sequence number of a command or upload, why it is refused (empty: it is not), and the refusal's code."""
POLL_S: Final = 0.05
T = TypeVar("T")


class Refused(Exception):
    """A request is refused: status and sentence."""


@dataclass(slots=True)
class PlanApi:
    """``folder`` None: missions are not saved here.  ``offer`` sends name and digest of a saved mission to the planner
    and returns the sequence number (None: no planner); ``answer`` is the planner's last answer.
    """

    profile: Profile
    access: Access
    folder: MissionFolder | None = None
    offer: Callable[[str, bytes], int] | None = None
    answer: Callable[[], Answer] = lambda: (0, "", "")
    _one: asyncio.Lock = field(default_factory=asyncio.Lock)

    def routes(self) -> list[Route]:
        """Make the routes, to be mounted by the server."""
        handlers: list[tuple[str, Callable[[Request], Awaitable[Response]], str]] = [
            ("/api/plan/settings", self._settings, "GET"),
            ("/api/plan/missions", self._missions, "GET"),
            ("/api/plan/missions/{name}", self._open, "GET"),
            ("/api/plan/missions/{name}", self._save, "POST"),
            ("/api/plan/check", self._check, "POST"),
            ("/api/plan/import", self._import, "POST"),
            ("/api/plan/export/{kind}", self._export, "POST"),
            ("/api/plan/upload/{name}", self._upload, "POST"),
            # A name with a slash is refused like any other bad one, in a sentence.
            ("/api/plan/missions/{name:path}", self._open, "GET"),
            ("/api/plan/missions/{name:path}", self._save, "POST"),
            ("/api/plan/upload/{name:path}", self._upload, "POST"),
        ]
        requests = [Route(path, _answering(handler), methods=[method]) for path, handler, method in handlers]
        return [page_route("/plan", "plan.html"), *requests]

    async def _settings(self, request: Request) -> Response:
        carrier = self.profile.carrier
        return JSONResponse(
            {
                "machine": self.profile.title,
                "profile": self.profile.name,
                "site": None if carrier is None else site_of(carrier),
                "formats": list(FORMATS),
                "folder": None if self.folder is None else str(self.folder.path),
                "may_upload": self.folder is not None and self.offer is not None,
                "may_plan": person_of(request).role >= Role.OPERATOR,
            }
        )

    async def _missions(self, _: Request) -> Response:
        return JSONResponse([] if self.folder is None else await asyncio.to_thread(self.folder.names))

    async def _open(self, request: Request) -> Response:
        _only_planners(request)
        folder, name = self._folder(), request.path_params["name"]
        return JSONResponse(await self._alone(lambda: imported(folder.read(name), name)))

    async def _check(self, request: Request) -> Response:
        self._drives()
        body = await _body(request)
        return JSONResponse(await self._alone(lambda: reviewed(mission_of(body), self.profile)))

    async def _import(self, request: Request) -> Response:
        body, name = await _body(request), request.query_params.get("name", "file")[:MAX_QUERY_CHARS]
        return JSONResponse(await self._alone(lambda: imported(body, name)))

    async def _export(self, request: Request) -> Response:
        body, kind = await _body(request), request.path_params["kind"]
        exported = await self._alone(lambda: export(mission_of(body), kind))
        return JSONResponse({"text": exported.data.decode(), "left_out": exported.left_out})

    async def _save(self, request: Request) -> Response:
        body, name = await _body(request), request.path_params["name"]
        replace, folder = request.query_params.get("replace") == "1", self._folder()
        await self._alone(lambda: folder.write(name, geojson.write(mission_of(body)), replace))
        return JSONResponse({"saved": name})

    async def _upload(self, request: Request) -> Response:
        """Save the mission, which must be free of errors, and offer it to the planner."""
        self._drives()
        body, name, folder = await _body(request), request.path_params["name"], self._folder()
        if self.offer is None:
            raise Refused(409, "This console has no planner; start it with --planner HOST:PORT.")
        if why := self.access.refusal(page_of(request), Role.OPERATOR, leased=True):
            raise Refused(403, why)
        mission = await self._alone(lambda: mission_of(body))
        plan_review = await self._alone(lambda: reviewed(mission, self.profile))
        if plan_review["errors"]:
            raise MissionError(plan_review["errors"][0]["code"], plan_review["errors"][0]["sentence"])
        data = geojson.write(mission)
        await self._alone(lambda: folder.write(name, data, True))
        try:
            number = self.offer(name, hashlib.sha256(data).digest())
        except OSError as error:
            raise Refused(502, f"The planner cannot be reached: {error.strerror}.") from None
        refusal, code = await self._answered(number)
        if refusal:
            return JSONResponse({"code": code or "upload.refused", "sentence": f"The planner refused: {refusal}."}, 409)
        return JSONResponse({"uploaded": name})

    async def _answered(self, number: int) -> tuple[str, str]:
        for _ in range(int(ANSWER_S / POLL_S)):
            order, refusal, code = self.answer()
            if order == number:
                return refusal, code
            await asyncio.sleep(POLL_S)
        raise Refused(504, "The planner does not answer; is it running, and does it report to this console?")

    def _folder(self) -> MissionFolder:
        if self.folder is None:
            raise Refused(409, "This console has no folder of missions; start it with --missions DIR.")
        return self.folder

    def _drives(self) -> None:
        if self.profile.carrier is None:
            raise Refused(409, f"{self.profile.name} does not drive; a mission needs a machine with a carrier.")

    async def _alone(self, work: Callable[[], T]) -> T:
        async with self._one:
            return await asyncio.to_thread(work)


def _answering(handler: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """Wrap the handler so that its refusals become answers."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except Refused as refused:
            status, sentence = refused.args
            return PlainTextResponse(sentence, status)
        except (InputRefused, MissionError) as error:
            return JSONResponse({"code": error.code, "sentence": str(error)}, 422)
        except ClientDisconnect:
            return Response(status_code=400)

    return answer


async def _body(request: Request) -> bytes:
    """Read the body of a request of somebody who may plan."""
    _only_planners(request)
    sentence = f"This is larger than {MAX_BODY_BYTES >> 20} MB; a mission has some kB."
    if request.headers.get("content-length", "0").isdigit() and (
        int(request.headers.get("content-length", "0")) > MAX_BODY_BYTES
    ):
        raise Refused(413, sentence)
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > MAX_BODY_BYTES:
            raise Refused(413, sentence)
        parts.append(part)
    return b"".join(parts)


def _only_planners(request: Request) -> None:
    if person_of(request).role < Role.OPERATOR:
        raise Refused(403, "Missions are planned by operators: sign in as one.")
