"""The addresses of signing in, of a page's token, and of the control lease."""

from __future__ import annotations

import asyncio
from typing import Any, Final, TypeVar

import msgspec
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from console.access import Access
from console.access_guards import TOKEN_HEADER, cookie_of, page_of, person_of, set_session
from console.guards import body_of, json_route, page_route

MAX_BODY_BYTES: Final = 2048
HANDOVER_STEPS, HANDOVER_STEP_S = 10, 0.05
"""So long a page that is loaded again waits for the end of its former connection; a duplicated tab waits in vain."""
T = TypeVar("T")


class SignIn(msgspec.Struct, forbid_unknown_fields=True):
    """What the sign-in form sends."""

    name: str
    password: str


class Entry(msgspec.Struct, forbid_unknown_fields=True):
    """What the sign-in form sends where nobody has a password."""

    token: str


class Take(msgspec.Struct, forbid_unknown_fields=True):
    """``over``: the page from which the lease is taken over, 0 for nobody."""

    over: int


def access_routes(access: Access, secure: bool) -> list[Route]:
    """Make the routes of sign-in, sessions and lease; ``secure``: the page and its cookie use TLS."""
    hash_lock = asyncio.Lock()

    async def enter(request: Request) -> Response:
        entry = await _body(request, Entry)
        if entry is None:
            return PlainTextResponse("Send the token that the console printed at its start.", 422)
        return begun(request, access.enter(entry.token), "This is not the token that the console printed at its start.")

    def begun(request: Request, session: str, otherwise: str) -> Response:
        if not session:
            return PlainTextResponse(otherwise, 403)
        answer = Response(status_code=204)
        set_session(answer, request.headers, session, secure)
        return answer

    async def sign_in(request: Request) -> Response:
        if access.accounts is None:
            return await enter(request)
        credentials = await _body(request, SignIn)
        if credentials is None:
            return PlainTextResponse("Send name and password.", 422)
        request.scope["tried_name"] = credentials.name[:32]
        async with hash_lock:  # one hash at a time, whoever asks; each may try when it is his turn
            if not access.may_try():
                return PlainTextResponse("Too many wrong passwords; wait half a minute.", 429)
            person = await asyncio.to_thread(access.accounts.check, credentials.name, credentials.password)
            session = access.signed_in(person)
        return begun(request, session, "Name or password is wrong.")

    async def sign_out(request: Request) -> Response:
        access.sign_out(request.scope["session"])
        answer = Response(status_code=204)
        answer.delete_cookie(cookie_of(request.headers), path="/")
        return answer

    async def session(request: Request) -> Response:
        token, person = request.headers.get(TOKEN_HEADER, ""), person_of(request)
        for _ in range(HANDOVER_STEPS):
            if not access.is_connected(token):
                break
            await asyncio.sleep(HANDOVER_STEP_S)
        page = access.open_page(token, request.scope["session"])
        if page is None and access.accounts is not None:
            return PlainTextResponse("Sign in first.", 401)
        session_facts: dict[str, Any] = {"token": page.token if page else "", "page": page.number if page else 0}
        session_facts |= {
            "person": person.name,
            "role": person.role.name.lower(),
            "signs_in": access.accounts is not None,
        }
        return JSONResponse(session_facts)

    async def take(request: Request) -> Response:
        takeover, page = await _body(request, Take), page_of(request)
        assert page is not None
        if takeover is None:
            return PlainTextResponse("Send the page from which control is taken over, or 0.", 422)
        why = access.take(page, takeover.over)
        return PlainTextResponse(why, 409) if why else Response(status_code=204)

    async def give_back(request: Request) -> Response:
        page = page_of(request)
        assert page is not None
        access.give_back(page)
        return Response(status_code=204)

    return [
        page_route("/sign-in", "sign-in.html"),
        json_route("/api/sign-in", lambda: {"by": "password" if access.accounts is not None else "token"}),
        Route("/api/sign-in", sign_in, methods=["POST"]),
        Route("/api/sign-out", sign_out, methods=["POST"]),
        Route("/api/session", session, methods=["POST"]),
        Route("/api/lease/take", take, methods=["POST"]),
        Route("/api/lease/give-back", give_back, methods=["POST"]),
    ]


async def _body(request: Request, kind: type[T]) -> T | None:
    """Decode the JSON of a small body; None when it is none of this kind."""
    try:
        return msgspec.json.decode(await body_of(request, MAX_BODY_BYTES) or b"", type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
