"""Requests for logs to a detector whose camera rides on the crane of a machine that stands.

A detection takes longer than the planner's period, so all requests that wait are read at once: the joints of each say
whether the crane rests, the newest one gets a detection, and who watches gets the last list or the last picture without
waiting behind detections.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, Protocol

from autonomy.perception.log_list.datagrams import decode_request, encode_error, encode_logs
from autonomy.perception.log_list.observation import LogObservation
from autonomy.perception.shown_picture import NewestPicture
from runtime.errors import InputRefused

MAX_REQUEST_BYTES: Final = 2048
Address = tuple[str, int]


class StandingDetector(Protocol):
    """`autonomy.perception.log_detector.LogDetector`."""

    problem: str
    logs: tuple[LogObservation, ...]

    def rests(self, q: Sequence[float], now_ns: int) -> bool:
        """Whether the crane rests, by its joints now."""

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """The logs of a new picture."""


class StandingRequests:
    """Replies to requests that arrive on a socket; ``report`` is told why there are no logs."""

    def __init__(
        self,
        detector: StandingDetector,
        link: socket.socket,
        report: Callable[[str], None],
        pictures: NewestPicture,
    ) -> None:
        self._detector, self._link, self._report, self._pictures = detector, link, report, pictures
        self._reported = ""
        self.lists = 0
        """Number of lists that were measured."""

    @property
    def log_count(self) -> int:
        """Number of logs in the last list."""
        return len(self._detector.logs)

    @property
    def problem(self) -> str:
        """Why the last request for a detection gave no list; empty when it did, or the crane moved."""
        return self._detector.problem

    def answer_waiting(self) -> None:
        """Answer the requests that wait: a detection for the newest joints, the last list for every page."""
        newest: tuple[tuple[float, ...], Address] | None = None
        for data, sender in self._waiting():
            if (picture := self._pictures.reply(data, self._detector.problem)) is not None:
                self._send(picture, sender)
                continue
            try:
                q = decode_request(data).q
            except InputRefused as error:
                self._send(encode_error(str(error)), sender)
                continue
            if all(map(math.isnan, q)):
                self._send(encode_logs(self._detector.logs), sender)
                continue
            if newest is not None:
                self._detector.rests(newest[0], time.monotonic_ns())
            newest = (q, sender)
        if newest is not None:
            self._detect(*newest)

    def _detect(self, q: tuple[float, ...], sender: Address) -> None:
        logs = self._detector.detect(q, time.monotonic_ns())
        if logs is not None:
            self.lists += 1
            self._send(encode_logs(logs), sender)
        problem = self._detector.problem
        if problem and problem != self._reported:
            self._report(problem)
        self._reported = problem

    def _waiting(self) -> list[tuple[bytes, Address]]:
        found = []
        self._link.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                found.append(self._link.recvfrom(MAX_REQUEST_BYTES))
        return found

    def _send(self, data: bytes, sender: Address) -> None:
        with suppress(OSError):  # who asked is gone; the next request gets an answer
            self._link.sendto(data, sender)
