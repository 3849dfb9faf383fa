"""The requests of the commissioning page: step a joint, calibrate, end, and keep acceptance protocols.

What moves the machine needs the role technician and the control lease; ending it, the role operator.  A protocol is
written once under its name and never changed.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import threading
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from autonomy.commissioning.acceptance import CHECKS, MAX_JSON_BYTES, document, read_protocol
from autonomy.commissioning.step_test import largest_step, profile_margins
from console.access import Access
from console.access_guards import page_of, person_of
from console.accounts import Role
from console.commissioning import Commissioning
from console.guards import body_of, json_route, page_route
from machine.joints import JOINTS, Joint
from machine.profile import joint
from runtime.errors import TimberhandError

SUFFIX: Final = ".protocol.json"
NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


class Step(msgspec.Struct, forbid_unknown_fields=True):
    """What the page asks for; ``amount`` in rad or m."""

    joint: str
    amount: float


class Chosen(msgspec.Struct, forbid_unknown_fields=True):
    """The joints to be calibrated; none for all."""

    joints: list[str]


class CommissionApi:
    """Mounted where the console was given a controller's setpoint port and a bus."""

    def __init__(self, work: Commissioning, access: Access) -> None:
        self._work, self._access = work, access

    def routes(self) -> list[Route]:
        """Make the routes, to be mounted by the server."""
        handlers: list[tuple[str, Callable[[Request], Awaitable[Response]], str]] = [
            ("/api/commission/step", self._step, "POST"),
            ("/api/commission/calibrate", self._calibrate, "POST"),
            ("/api/commission/end", self._end, "POST"),
            ("/api/commission/plots/{name}", self._plot, "GET"),
            ("/api/commission/protocols/{name}", self._open, "GET"),
            ("/api/commission/protocols/{name}", self._save, "POST"),
        ]
        return [
            page_route("/commission", "commission.html"),
            json_route("/api/commission/settings", self._settings),
            json_route("/api/commission/state", self._work.state),
            json_route("/api/commission/protocols", self._protocols),
            *(Route(path, handler, methods=[method]) for path, handler, method in handlers),
        ]

    def _settings(self) -> dict[str, Any]:
        profile = self._work.profile
        joints: list[dict[str, Any]] = []
        for j in JOINTS:
            spec, (phase_deg, gain_db) = joint(profile, j), profile_margins(profile, j)
            joints.append(
                {
                    "name": j.name.lower(),
                    "unit": "m" if spec.kind == "prismatic" else "rad",
                    "senses": spec.encoder is not None,
                    "largest": largest_step(profile, j),
                    "phase_deg": phase_deg,
                    "gain_db": gain_db,
                }
            )
        checks = [{"id": c.id, "title": c.title, "how": c.how, "value": c.value} for c in CHECKS]
        machine_facts = {"machine": profile.title, "profile": profile.name, "folder": str(self._work.folder)}
        return machine_facts | {"joints": joints, "checks": checks, "hash": f"{self._work.profile_hash:08x}"}

    async def _step(self, request: Request) -> Response:
        body = await body_of(request, 1024)
        try:
            step_request = msgspec.json.decode(body or b"", type=Step)
            selected_joint = Joint[step_request.joint.upper()]
        except (msgspec.DecodeError, UnicodeDecodeError, KeyError):
            return PlainTextResponse("Send the joint's name and the amount.", 422)
        return self._run(request, lambda work, goes_on: work.step_joint(selected_joint, step_request.amount, goes_on))

    async def _calibrate(self, request: Request) -> Response:
        body = await body_of(request, 1024)
        try:
            selection = msgspec.json.decode(body or b"", type=Chosen)
            joints = [Joint[name.upper()] for name in selection.joints] or list(JOINTS)
        except (msgspec.DecodeError, UnicodeDecodeError, KeyError):
            return PlainTextResponse("Send the joints' names; none for all.", 422)
        # Planning takes a second: beside the server, so that STOP does not wait.
        return await asyncio.to_thread(self._run, request, lambda work, goes_on: work.calibrate(joints, goes_on))

    def _run(self, request: Request, begin: Callable[[Commissioning, Callable[[], bool]], None]) -> Response:
        page = page_of(request)
        if why := self._access.refusal(page, Role.TECHNICIAN, leased=True):
            return PlainTextResponse(why, 403)
        if self._work.busy:
            return PlainTextResponse("Something runs already; wait, or end it.", 409)
        try:
            begin(self._work, lambda: self._access.leads(page))
        except TimberhandError as error:
            return PlainTextResponse(f"Not begun: {error}.", 422)
        return Response(status_code=204)

    async def _end(self, request: Request) -> Response:
        if why := self._access.refusal(page_of(request), Role.OPERATOR, leased=False):
            return PlainTextResponse(why, 403)
        self._work.end("ended on the page")
        return Response(status_code=204)

    async def _plot(self, request: Request) -> Response:
        result, name = self._work.found, request.path_params["name"]
        if result is None or name not in result["plots"]:
            return PlainTextResponse("There is no such plot.", 404)
        return FileResponse(self._work.folder / result["name"] / name, headers={"Cache-Control": "no-cache"})

    def _protocols(self) -> list[str]:
        return sorted(path.name.removesuffix(SUFFIX) for path in self._work.folder.glob(f"*{SUFFIX}"))

    async def _open(self, request: Request) -> Response:
        name = request.path_params["name"]
        if not NAME.fullmatch(name):
            return PlainTextResponse("There is no such protocol.", 404)
        path = self._work.folder / f"{name}{SUFFIX}"
        return FileResponse(path, media_type="application/json") if path.is_file() else Response(status_code=404)

    async def _save(self, request: Request) -> Response:
        if why := self._access.refusal(page_of(request), Role.TECHNICIAN, leased=False):
            return PlainTextResponse(why, 403)
        name, data = request.path_params["name"], await body_of(request, MAX_JSON_BYTES)
        if not NAME.fullmatch(name):
            return PlainTextResponse("Give a name of letters, digits, - and _, up to 40.", 422)
        if data is None:
            return PlainTextResponse(f"This is larger than {MAX_JSON_BYTES >> 10} kB.", 413)
        try:
            protocol = read_protocol(data)
        except TimberhandError as error:
            return PlainTextResponse(f"Not saved: {error}.", 422)
        facts = {
            "name": name,
            "saved_at": datetime.now(UTC).isoformat(timespec="seconds"),
            "saved_by": person_of(request).name,
            "profile": self._work.profile.name,
            "profile_hash": f"{self._work.profile_hash:08x}",
            "steps": {j: {"at": s["at"], "amount": s["amount"], **s["figures"]} for j, s in self._work.steps.items()},
        }
        protocol_document = document(protocol, facts)
        try:
            await asyncio.to_thread(_write_once, self._work.folder / f"{name}{SUFFIX}", protocol_document)
        except FileExistsError:
            return PlainTextResponse(f"There is a protocol {name} already; a protocol is never changed.", 409)
        except OSError as error:
            return PlainTextResponse(f"The protocol cannot be written: {error.strerror}.", 507)
        return JSONResponse(protocol_document)


def _write_once(path: Path, told: dict[str, Any]) -> None:
    """Write a protocol, whole or not at all, and never over another."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        draft.write_text(json.dumps(told, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        os.link(draft, path)
    finally:
        draft.unlink(missing_ok=True)
