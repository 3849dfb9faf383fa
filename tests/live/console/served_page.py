"""An application of the console, served in a thread on a free port, and what it is told."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator

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


@contextlib.contextmanager
def fed(to: tuple[str, int], period_s: float, told: Callable[[int], Iterable[bytes]]) -> Iterator[None]:
    """Send the datagrams that are told at a time, again and again, in a thread."""
    over = threading.Event()

    def feed() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not over.wait(period_s):
                for data in told(time.monotonic_ns()):
                    out.sendto(data, to)

    thread = threading.Thread(target=feed)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
