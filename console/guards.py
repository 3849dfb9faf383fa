"""What every request must pass before a handler sees it: the Host it names and the page it comes from.

A foreign ``Host`` is DNS rebinding; a foreign ``Origin`` on the websocket or on a command is another site's page that
uses this browser.  Both are refused with a sentence.  Every answer carries a policy that lets the page load nothing
from anywhere but here (docs/reference/safety.md section 3).
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Collection, Sequence
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_NAMES: Final = ("127.0.0.1", "localhost", "::1")
_INLINE: Final = re.compile(r"<script type=\"importmap\">(.*?)</script>", re.DOTALL)


def content_security_policy(page: str) -> str:
    """The policy for a page: everything from here, and of inline scripts only the page's own import map."""
    hashes = (hashlib.sha256(text.encode()).digest() for text in _INLINE.findall(page))
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in hashes)
    return (
        f"default-src 'none'; script-src 'self' {allowed}; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def is_loopback(host: str | None) -> bool:
    """Whether a peer's address is this machine."""
    return host is not None and (host in ("::1", "testclient") or host.startswith("127."))


class RequestGuards:
    """ASGI middleware (module docstring: contract); ``names`` are the host names served, without port."""

    def __init__(self, app: ASGIApp, names: Collection[str], policy: str) -> None:
        self._app = app
        self._names = frozenset(names)
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
            await self._app(scope, receive, self._marking(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": refusal})
        else:
            await PlainTextResponse(refusal, 403)(scope, receive, self._marking(send))

    def _refusal(self, headers: Headers) -> str | None:
        host = headers.get("host", "")
        if urlsplit(f"//{host}").hostname not in self._names:
            return "This console does not serve that host name; start it with --allow-host to add one."
        origin = headers.get("origin")
        # A browser always sends Origin with a websocket and with a POST; a tool such as curl sends none.
        if origin is not None and urlsplit(origin).netloc != host:
            return "A page of another site may not use this console."
        return None

    def _marking(self, send: Send) -> Send:
        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers:
                    headers[name] = value
            await send(message)

        return marked
