"""Checks of every request before a handler receives it: its Host and its Origin.

A foreign ``Host`` is DNS rebinding; a foreign ``Origin`` on the websocket or on a command is a page of another site in
this browser.  Both are refused with a sentence.  Every response carries a policy that only lets the page load resources
from this server (docs/reference/safety.md section 3).

`page_route`, `json_route`, `send` and `body_of` are what the handlers of several pages have in common.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

STATIC: Final = Path(__file__).with_name("static")
LOOPBACK_NAMES: Final = ("127.0.0.1", "localhost", "::1")
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:[0-9]{1,5})?")
"""``uri-host [":" port]`` of RFC 9110, section 7.2, as browsers send it: no user, no path."""
_INLINE: Final = re.compile(r"<script type=\"importmap\">(.*?)</script>", re.DOTALL)


def content_security_policy(page: str) -> str:
    """Write the policy of a page: resources from this server only, no inline script but the page's import map."""
    hashes = (hashlib.sha256(text.encode()).digest() for text in _INLINE.findall(page))
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in hashes)
    return (
        f"default-src 'none'; script-src 'self' {allowed}; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def is_loopback(host: str | None) -> bool:
    """Tell whether a peer's address is of this machine."""
    return host is not None and (host in ("::1", "testclient") or host.startswith("127."))


class RequestGuards:
    """ASGI middleware; ``names`` are the served host names, without port."""

    def __init__(self, app: ASGIApp, names: Collection[str], policy: str) -> None:
        self._app = app
        self._names = frozenset(name.strip("[]").lower() for name in names)
        self._headers: Sequence[tuple[str, str]] = (
            ("Content-Security-Policy", policy),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Opener-Policy", "same-origin"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-cache"),
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(Headers(scope=scope))
        if refusal is None:
            await self._app(scope, receive, self._with_headers(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": refusal})
        else:
            await PlainTextResponse(refusal, 403)(scope, receive, self._with_headers(send))

    def _refusal(self, headers: Headers) -> str | None:
        host = headers.get("host", "")
        match = _HOST.fullmatch(host)
        if match is None or match[1].strip("[]").lower() not in self._names:
            return "This console does not serve that host name; start it with --allow-host to add it."
        origin = headers.get("origin")
        # A browser always sends Origin with a websocket and with a POST; a tool such as curl sends none.
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return "Pages of other sites may not use this console."
        return None

    def _with_headers(self, send: Send) -> Send:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers:
                    headers[name] = value
            await send(message)

        return send_with_headers


def guarded(file: str, allow_hosts: Collection[str]) -> Middleware:
    """Return the guards of the page ``file``, which is served under this machine's names and ``allow_hosts``."""
    policy = content_security_policy((STATIC / file).read_text())
    return Middleware(RequestGuards, names={*LOOPBACK_NAMES, *allow_hosts}, policy=policy)


def page_route(path: str, file: str) -> Route:
    """Serve the page ``file`` of this package."""

    async def page(_: Request) -> Response:
        return FileResponse(STATIC / file, media_type="text/html")

    return Route(path, page)


def json_route(path: str, content: Callable[[], Any]) -> Route:
    """Serve what ``content`` returns at each request, as JSON."""

    async def answer(_: Request) -> Response:
        return JSONResponse(content())

    return Route(path, answer)


async def send(socket: WebSocket, text: str) -> None:
    """Send a message; raises WebSocketDisconnect when the page is gone, also if it only answers no ping any more."""
    try:
        await socket.send_text(text)
    except RuntimeError as closed:  # uvicorn's word for a connection that it has closed itself
        raise WebSocketDisconnect(1006) from closed


async def body_of(request: Request, most: int) -> bytes | None:
    """Read the body of a request; None for more than ``most`` bytes, and for a page that is gone."""
    data = b""
    try:
        async for part in request.stream():
            data += part
            if len(data) > most:
                return None
    except ClientDisconnect:
        return None
    return data
