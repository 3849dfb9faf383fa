"""ASGI middleware: who sends a request, and the audit of what became of it.

`AccessGuards` lets a request through when it may be read or commanded at all: with accounts every address of the API
needs a session; every POST needs the token of a page, in the header `TOKEN_HEADER`, but for STOP, signing in and asking
for a token.  It leaves the person and the page in the request's scope; what they may do, a handler decides.  STOP needs
nothing: it is let through at once.  A page that is asked for with the console's token in its address is answered with
the cookie of a new session and the same address without the token.  A websocket that does not say its Origin, as every
browser's does, only shows, whatever token it has.
"""

from __future__ import annotations

import json
import os
import queue
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from starlette.datastructures import Headers, QueryParams
from starlette.requests import HTTPConnection, cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from console.access import VISITOR, Access, Page
from console.accounts import Person
from console.guards import is_loopback

TOKEN_HEADER: Final = "x-timberhand-page"
COOKIE: Final = "timberhand-session"
ENTRY: Final = "token"
"""Of the query: the console's token."""
STOP_PATH: Final = "/api/operator/stop"
ENTER_WORDS: Final = "Open the address that the console printed at its start, or sign in with its token."
FREE_POSTS: Final = frozenset({STOP_PATH, "/api/session", "/api/sign-in"})
"""They need no token: STOP, and what comes before there is one."""
QUIET_PREFIXES: Final = ("/api/session", "/api/watch-end/", "/api/plan/check", "/api/plan/import", "/api/plan/export/")
"""They change nothing, so the audit log leaves them out, unless they are refused."""
MAX_SENTENCE_BYTES: Final = 300


def cookie_of(headers: Headers) -> str:
    """Name the session's cookie: browsers share cookies between ports, consoles do not."""
    port = headers.get("host", "").rpartition(":")[2]
    return f"{COOKIE}-{port if port.isdecimal() else 0}"


def set_session(answer: Response, headers: Headers, session: str, secure: bool) -> None:
    """Let the browser keep a session, out of the reach of scripts and of other sites."""
    answer.set_cookie(cookie_of(headers), session, httponly=True, samesite="strict", secure=secure, path="/")


def session_of(headers: Headers) -> str:
    """Return the session's cookie, whatever the others on this host hold; empty without one."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_of(headers), "")


def person_of(request: HTTPConnection) -> Person:
    """Return the person who sends a request."""
    person = request.scope.get("person", VISITOR)
    assert isinstance(person, Person)
    return person


def page_of(request: HTTPConnection) -> Page | None:
    """Return the page that sends a request, None without a token."""
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
        headers, query = Headers(scope=scope), QueryParams(scope["query_string"])
        session = session_of(headers)
        if self._access.accounts is None and not is_loopback((scope.get("client") or (None,))[0]):
            session = ""  # the token is for this machine alone
        scope["session"] = session
        person = self._access.person(session)
        scope["person"] = person or VISITOR
        if scope["type"] == "websocket":
            token = query.get("page", "") if "origin" in headers else ""
            scope["page"] = self._access.page(token, session)
            # Without a token it only shows, where whoever is on this machine may look.
            if scope["page"] is None and (token or person is None):
                await receive()
                await send({"type": "websocket.close", "code": 1008, "reason": "This page's token is not valid."})
                return
        else:
            if scope["method"] == "GET" and ENTRY in query and self._access.token:
                await self._entered(scope, headers, query[ENTRY])(scope, receive, send)
                return
            scope["page"] = self._access.page(headers.get(TOKEN_HEADER, ""), session)
            refusal = self._refusal(scope)
            if refusal:
                await PlainTextResponse(refusal, 401 if person is None else 403)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _entered(self, scope: Scope, headers: Headers, token: str) -> Response:
        """Let whoever has a session keep it, and its pages theirs: the printed address may be opened again."""
        existing_session = scope["session"] if scope["person"] is not VISITOR else ""
        session = existing_session or self._access.enter(token)
        answer = RedirectResponse("/" + scope["path"].lstrip("/") if session else "/sign-in", 303)
        if session and not existing_session:
            set_session(answer, headers, session, secure=scope["scheme"] == "https")
        return answer

    def _refusal(self, scope: Scope) -> str:
        path, writes = scope["path"], scope["method"] not in ("GET", "HEAD")
        if not path.startswith("/api/") or path in FREE_POSTS:
            return ""
        if self._access.accounts is not None and scope["person"] is VISITOR:
            return "Sign in first."
        if writes and scope["person"] is VISITOR:
            return ENTER_WORDS
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
        status, refusal = 0, b""

        async def watched(message: Message) -> None:
            nonlocal status, refusal
            match message["type"]:
                case "http.response.start":
                    status = message["status"]
                case "http.response.body" if status >= 400 and not refusal:
                    refusal = message.get("body", b"")[:MAX_SENTENCE_BYTES]
                case "websocket.close" if not status:
                    status, refusal = 403, message.get("reason", "").encode()
                case "websocket.accept":
                    status = 101
            await send(message)

        try:
            await self._app(scope, receive, watched)
        finally:
            self._record(scope, status, refusal.decode(errors="replace"))

    def _record(self, scope: Scope, status: int, refusal: str) -> None:
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
        if refusal:
            fields["why"] = refusal
        self._log.record(refused=refused, **fields)


# -- The audit log: who commanded what from which page, when, and what became of it.
#
# One line of JSON for each request that changes something, and for each that is refused; the file is only ever
# appended to.  A thread writes it, so that a slow disk delays no STOP.  At most `MAX_REFUSED` refusals a second are
# written: what an attacker sends must not fill the disk.  A file that cannot be written is told on every page
# (``failed``).

MAX_REFUSED: Final = 10
MAX_WAITING: Final = 1000
_SECOND_NS: Final = 1_000_000_000


class AuditLog:
    """``clock`` is monotonic [ns]; the lines have UTC.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: Path, clock: Callable[[], int]) -> None:
        self.path = path
        self.failed = ""
        """Why the last lines could not be written."""
        self._clock = clock
        self._second, self._refused, self._left_out = 0, 0, 0
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._waiting: queue.Queue[bytes] = queue.Queue(MAX_WAITING)
        self._writer = threading.Thread(target=self._write, name="audit", daemon=True)
        self._writer.start()

    def record(self, *, refused: bool, **fields: Any) -> None:
        """Write a line; ``fields`` are who, what and result."""
        second = self._clock() // _SECOND_NS
        if second != self._second:
            self._second, self._refused = second, 0
        if refused:
            self._refused += 1
            if self._refused > MAX_REFUSED:
                self._left_out += 1
                return
        line = {"at": datetime.now(UTC).isoformat(timespec="milliseconds"), **fields}
        if self._left_out:
            line["refusals_left_out"], self._left_out = self._left_out, 0
        try:
            self._waiting.put_nowait(json.dumps(line, ensure_ascii=False).encode() + b"\n")
        except queue.Full:
            self.failed = f"The audit log {self.path} is not written: the disk is too slow."

    def close(self) -> None:
        """Write what waits, and close the file; once is enough."""
        if self._writer.is_alive():
            self._waiting.put(b"")
            self._writer.join()
            os.close(self._file)

    def _write(self) -> None:
        torn = b""  # ends a line of which the disk took only a part before it was full
        while line := self._waiting.get():
            rest = torn + line
            try:
                while rest:
                    written = os.write(self._file, rest)
                    rest, torn = rest[written:], b"\n"
                self.failed, torn = "", b""
            except OSError as error:
                self.failed = f"The audit log {self.path} cannot be written ({error.strerror})."
