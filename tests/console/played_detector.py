"""A program with one answer to every request: a log detector, or a plant."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from can_dbc.messages.picture import picture_request
from tests.operator_end import udp_end


@contextmanager
def detector(
    answer: bytes, read: Callable[[bytes], Any] = picture_request
) -> Iterator[tuple[tuple[str, int], list[Any]]]:
    """One that gives one answer, and the requests that it got; what ``read`` makes None of is none."""
    asked: list[Any] = []
    with udp_end(0.1) as link:
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                try:
                    data, sender = link.recvfrom(2048)
                except TimeoutError:
                    continue
                request = read(data)
                if request is not None:
                    asked.append(request)
                    link.sendto(answer, sender)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield link.getsockname(), asked
        finally:
            over.set()
            thread.join()
