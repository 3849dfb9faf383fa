"""A log detector with one answer to every request for a picture."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

from can_dbc.messages.picture import picture_request


@contextmanager
def detector(answer: bytes) -> Iterator[tuple[tuple[str, int], list[int]]]:
    """A detector that gives one answer, and the requests that it got."""
    asked: list[int] = []
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as link:
        link.bind(("127.0.0.1", 0))
        link.settimeout(0.1)
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                try:
                    data, sender = link.recvfrom(2048)
                except TimeoutError:
                    continue
                since = picture_request(data)
                if since is not None:
                    asked.append(since)
                    link.sendto(answer, sender)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield link.getsockname(), asked
        finally:
            over.set()
            thread.join()
