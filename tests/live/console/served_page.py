"""An application of the console, served in a thread on a free port."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator

import uvicorn
from starlette.applications import Starlette

from tests.live.console.entries import note


@contextlib.contextmanager
def served(app: Starlette) -> Iterator[str]:
    """The page's address while it is served."""
    page = socket.socket()
    page.bind(("127.0.0.1", 0))
    page.setblocking(False)
    config = uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1, ws="websockets-sansio")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [page]})
    thread.start()
    url = f"http://127.0.0.1:{page.getsockname()[1]}/"
    access = getattr(app.state, "access", None)
    if access is not None and access.token:
        note(f"{url}?token={access.token}")
    try:
        yield url
    finally:
        server.should_exit = True
        thread.join()
