"""The page's buttons to try to break a live run: asks the desk of faults, and follows what becomes of each.

The harness of a live run gives the desk's socket (`--faults`); the console of a machine has none, and then these
addresses do not exist.  A fault needs the control lease.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from console.access import Access
from console.access_guards import page_of
from console.accounts import Role
from console.fault_watch import FaultWatch

ANSWER_S: Final = 6.0
MAX_ANSWER_BYTES: Final = 65_536


def fault_routes(desk: Path, watch: FaultWatch, access: Access) -> list[Route]:
    """``/api/faults`` lists what can be tried; a POST to ``/api/faults/NAME`` tries it."""
    trying = asyncio.Lock()

    async def listed(_: Request) -> Response:
        told = await _ask(desk, {"op": "list"})
        return JSONResponse(told["faults"]) if "faults" in told else PlainTextResponse(_error(told), 502)

    async def inject(request: Request) -> Response:
        if why := access.refusal(page_of(request), Role.OPERATOR, leased=True):
            return PlainTextResponse(why, 403)
        if trying.locked():
            return PlainTextResponse("Another fault is being injected.", 409)
        async with trying:
            told = await _ask(desk, {"op": "inject", "name": request.path_params["name"]})
        if "at_ns" not in told:
            return PlainTextResponse(_error(told), 409)
        watch.begin(str(told["title"]), str(told["said"]), int(told["at_ns"]))
        return Response(status_code=204)

    return [Route("/api/faults", listed), Route("/api/faults/{name}", inject, methods=["POST"])]


async def _ask(desk: Path, request: dict[str, str]) -> dict[str, Any]:
    try:
        async with asyncio.timeout(ANSWER_S):
            reader, writer = await asyncio.open_unix_connection(str(desk), limit=MAX_ANSWER_BYTES)
            try:
                writer.write(json.dumps(request).encode() + b"\n")
                told = json.loads(await reader.readline())
            finally:
                writer.close()
    except (OSError, ValueError, TimeoutError) as error:
        return {"error": f"The run's desk of faults does not answer ({error})."}
    return told if isinstance(told, dict) else {}


def _error(told: dict[str, Any]) -> str:
    return str(told.get("error") or "The run's desk of faults gave no answer.")
