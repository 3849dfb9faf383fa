"""Requests for logs to a detector whose camera looks ahead of a machine that drives.

Every request with a standpoint asks for one picture; while one is being measured, only the newest request waits.  The
reply is in the plane of the standpoint, because the machine has driven on by the time it arrives.  A request without a
standpoint, as from a page that only displays logs, gets the last list in the base frame of the last standpoint.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, Protocol

from autonomy.perception.camera.frame import Pose
from autonomy.perception.driving_log_detector import in_base
from autonomy.perception.log_list import LogObservation, LogRequest, decode_request, encode_error, encode_logs
from autonomy.perception.shown_picture import NewestPicture
from autonomy.perception.sources.camera_source import CameraSource
from runtime.errors import InputRefused


class DetectorInPlane(Protocol):
    """`autonomy.perception.driving_log_detector.DrivingLogDetector`."""

    problem: str

    def detect_in_plane(
        self, standing: Callable[[], tuple[Pose, float] | None], q: tuple[float, ...], load: bool
    ) -> tuple[LogObservation, ...] | None:
        """Detect the logs of a new picture in the plane."""


def asked_ns(source: CameraSource) -> int | None:
    """Return when a source was asked for its last picture; None when it does not know."""
    asked: int | None = getattr(source, "asked_ns", None)
    return asked


class DrivingRequests:
    """Replies to requests that arrive on a socket; ``taken_ns`` says when the last picture was taken, None: at the
    beginning of its detection.  ``report`` is told why there are no logs.  ``pictures`` answers those who watch.
    """

    def __init__(
        self,
        detector: DetectorInPlane,
        link: socket.socket,
        taken_ns: Callable[[], int | None],
        report: Callable[[str], None],
        pictures: NewestPicture,
    ) -> None:
        self._detector, self._link, self._taken_ns, self._report = detector, link, taken_ns, report
        self._pictures = pictures
        self._logs: tuple[LogObservation, ...] = ()
        self._base: Pose | None = None
        self._reported = ""
        self.lists = 0
        """Number of lists that were measured."""

    @property
    def log_count(self) -> int:
        """Number of logs in the last list."""
        return len(self._logs)

    @property
    def problem(self) -> str:
        """Why the last picture gave no list; empty when it did."""
        return self._reported

    def answer_waiting(self) -> None:
        """Answer the requests that wait: one picture for the newest standpoint, the last list for every page."""
        newest: tuple[LogRequest, Address] | None = None
        self._link.setblocking(False)
        while True:
            try:
                data, sender = self._link.recvfrom(MAX_REQUEST_BYTES)
            except BlockingIOError:
                break
            if (picture := self._pictures.reply(data, self._reported)) is not None:
                self._send(picture, sender)
                continue
            try:
                request = decode_request(data)
            except InputRefused as error:
                self._send(encode_error(str(error)), sender)
                continue
            if request.standpoint is not None:
                newest = (request, sender)
            elif not any(value == value for value in request.q):
                base = self._base
                self._send(encode_logs(in_base(log, base) for log in self._logs) if base else encode_logs(()), sender)
        if newest is not None:
            self._take_picture(*newest)

    def _take_picture(self, request: LogRequest, sender: Address) -> None:
        standpoint, begun_ns = request.standpoint, time.monotonic_ns()
        assert standpoint is not None

        def standing() -> tuple[Pose, float] | None:
            taken_ns = self._taken_ns()
            return standpoint.at(begun_ns if taken_ns is None else taken_ns)

        logs = self._detector.detect_in_plane(standing, request.q, standpoint.load)
        if logs is not None:
            self._logs, self._base = logs, standpoint.base
            self.lists += 1
            self._send(encode_logs(logs, in_plane=True), sender)
        problem = self._detector.problem
        if problem and problem != self._reported:
            self._report(problem)
        self._reported = problem

    def _send(self, data: bytes, sender: Address) -> None:
        try:
            self._link.sendto(data, sender)
        except OSError:
            return  # who asked is gone; the next request gets an answer


# -- Requests for logs to a detector whose camera rides on the crane of a machine that stands.
#
# A detection takes longer than the planner's period, so all requests that wait are read at once: the joints of each
# say whether the crane rests, the newest one gets a detection, and who watches gets the last list or the last
# picture without waiting behind detections.

MAX_REQUEST_BYTES: Final = 2048
Address = tuple[str, int]


class StandingDetector(Protocol):
    """`autonomy.perception.log_detector.LogDetector`."""

    problem: str
    logs: tuple[LogObservation, ...]

    def rests(self, q: Sequence[float], now_ns: int) -> bool:
        """Tell whether the crane rests, by its joints now."""

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """Detect the logs of a new picture."""


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
        datagrams = []
        self._link.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                datagrams.append(self._link.recvfrom(MAX_REQUEST_BYTES))
        return datagrams

    def _send(self, data: bytes, sender: Address) -> None:
        with suppress(OSError):  # who asked is gone; the next request gets an answer
            self._link.sendto(data, sender)
