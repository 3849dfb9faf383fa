"""ASGI middleware: who sends a request, and the audit of what became of it.

`AccessGuards` lets a request through when it may be read or commanded at all: with accounts every address of the API
needs a session; every POST needs the token of a page, in the header `TOKEN_HEADER`, but for STOP, signing in and asking
for a token.  It leaves the person and the page in the request's scope; what they may do, a handler decides.  STOP needs
nothing: it is let through at once.
"""

from __future__ import annotations

from http.cookies import CookieError, SimpleCookie
from typing import Any, Final

from starlette.datastructures import Headers, QueryParams
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from console.access import VISITOR, Access, Page
from console.accounts import Person
from console.audit import AuditLog

TOKEN_HEADER: Final = "x-timberhand-page"
COOKIE: Final = "timberhand-session"
STOP_PATH: Final = "/api/operator/stop"
FREE_POSTS: Final = frozenset({STOP_PATH, "/api/session", "/api/sign-in"})
"""They need no token: STOP, and what comes before there is one."""
QUIET_PREFIXES: Final = ("/api/session", "/api/watch-end/", "/api/plan/check", "/api/plan/import", "/api/plan/export/")
"""They change nothing, so the audit log leaves them out, unless they are refused."""
MAX_SENTENCE_BYTES: Final = 300


def session_of(headers: Headers) -> str:
    """The session's cookie; empty without one."""
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value


def person_of(request: HTTPConnection) -> Person:
    """The person who sends a request."""
    person = request.scope.get("person", VISITOR)
    assert isinstance(person, Person)
    return person


def page_of(request: HTTPConnection) -> Page | None:
    """The page that sends a request, None without a token."""
    page = request.scope.get("page")
    assert page is None or isinstance(page, Page)
    return page


class AccessGuards:
    """See the module's docstring."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers, peer = Headers(scope=scope), (scope.get("client") or (None,))[0]
        session = session_of(headers)
        person = self._access.person(session, peer)
        scope["person"] = person or VISITOR
        if scope["type"] == "websocket":
            token = QueryParams(scope["query_string"]).get("page", "")
            scope["page"] = self._access.page(token, session, peer)
            # Without a token it only shows, where whoever is on this machine may look.
            if scope["page"] is None and (token or person is None):
                await receive()
                await send({"type": "websocket.close", "code": 1008, "reason": "This page's token is not valid."})
                return
        else:
            scope["page"] = self._access.page(headers.get(TOKEN_HEADER, ""), session, peer)
            refusal = self._refusal(scope)
            if refusal:
                await PlainTextResponse(refusal, 401 if person is None else 403)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> str:
        path, writes = scope["path"], scope["method"] not in ("GET", "HEAD")
        if not path.startswith("/api/") or path in FREE_POSTS:
            return ""
        if self._access.accounts is not None and scope["person"] is VISITOR:
            return "Sign in first."
        if writes and scope["page"] is None:
            return "This does not come from a page of this console; load the page again."
        return ""


class AuditTrail:
    """Writes every command and every refused request into the audit log; outermost, so that it sees all of them."""

    def __init__(self, app: ASGIApp, log: AuditLog) -> None:
        self._app, self._log = app, log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        status, said = 0, b""

        async def watched(message: Message) -> None:
            nonlocal status, said
            match message["type"]:
                case "http.response.start":
                    status = message["status"]
                case "http.response.body" if status >= 400 and not said:
                    said = message.get("body", b"")[:MAX_SENTENCE_BYTES]
                case "websocket.close" if not status:
                    status, said = 403, message.get("reason", "").encode()
                case "websocket.accept":
                    status = 101
            await send(message)

        try:
            await self._app(scope, receive, watched)
        finally:
            self._record(scope, status, said.decode(errors="replace"))

    def _record(self, scope: Scope, status: int, said: str) -> None:
        path, refused = scope["path"], status >= 400
        reads = scope["type"] == "websocket" or scope["method"] in ("GET", "HEAD")
        if not refused and (reads or path.startswith(QUIET_PREFIXES)):
            return
        if status == 404 and reads:
            return
        request = HTTPConnection(scope)
        page, tried = page_of(request), scope.get("tried_name")
        fields: dict[str, Any] = {
            "who": tried or (page.person if page else person_of(request)).name,
            "page": page.number if page else 0,
            "peer": request.client.host if request.client else "",
            "what": path if scope["type"] == "websocket" else f"{scope['method']} {path}",
            "result": status,
        }
        if said:
            fields["why"] = said
        self._log.record(refused=refused, **fields)
