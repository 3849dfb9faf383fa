"""Requests that wait behind a slow detection: the newest joints count, and who watches does not wait."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence

import pytest

from autonomy.perception.driving_requests import StandingRequests
from autonomy.perception.log_list import LogObservation, decode_logs, encode_request
from autonomy.perception.shown_picture import NewestPicture
from can_dbc.messages.picture import decode_picture, encode_picture_request
from runtime.errors import InputRefused
from tests.codes import coded

LOG = LogObservation(3, (-1.0, 4.0, 0.1), (0.0, 1.0, 0.0), 2.0, 0.2)
Q = tuple((0.25 * k, 0.6, -1.2, 0.3, 0.0) for k in range(4))


class Detector:
    """Sees one log when it is asked for the second time."""

    def __init__(self) -> None:
        self.problem = ""
        self.logs: tuple[LogObservation, ...] = ()
        self.heard: list[tuple[float, ...]] = []
        self.detected: list[tuple[float, ...]] = []

    def rests(self, q: Sequence[float], now_ns: int) -> bool:
        self.heard.append(tuple(q))
        return True

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        self.detected.append(tuple(q))
        self.problem = "" if len(self.detected) > 1 else "no picture"
        self.logs = (LOG,) if len(self.detected) > 1 else ()
        return self.logs or None


class Served:
    def __init__(self) -> None:
        self.detector, self.troubles = Detector(), list[str]()
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.bind(("127.0.0.1", 0))
        self.asker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.asker.connect(self.link.getsockname())
        self.asker.settimeout(0.3)
        self.requests = StandingRequests(self.detector, self.link, self.troubles.append, NewestPicture("stick"))


@pytest.fixture
def served() -> Iterator[Served]:
    one = Served()
    yield one
    one.link.close()
    one.asker.close()


def test_of_waiting_requests_only_the_newest_gets_a_detection(served: Served) -> None:
    """Else each detection uses older joints than the last one, and its picture is placed where it was not taken."""
    for q in Q:
        served.asker.send(encode_request(q))
    served.requests.answer_waiting()
    assert served.detector.detected == [Q[3]] and served.detector.heard == list(Q[:3])
    with pytest.raises(TimeoutError):
        served.asker.recv(4096)
    served.asker.send(encode_request(Q[3]))
    served.requests.answer_waiting()
    assert (served.requests.lists, served.requests.log_count, served.requests.problem) == (1, 1, "")
    assert decode_logs(served.asker.recv(4096)) == (LOG,)


def test_who_watches_is_answered_before_the_detection(served: Served) -> None:
    served.detector.logs = (LOG,)
    for request in (encode_request(Q[0]), encode_request(()), encode_picture_request()):
        served.asker.send(request)
    served.requests.answer_waiting()
    assert decode_logs(served.asker.recv(4096)) == (LOG,)
    assert decode_picture(served.asker.recv(65536))[0].camera == "stick"


def test_a_problem_is_reported_once_and_a_bad_request_is_answered(served: Served) -> None:
    served.asker.send(b'{"op":"what"}')
    for _ in range(2):
        served.detector.detected.clear()
        served.asker.send(encode_request(Q[0]))
        served.requests.answer_waiting()
    assert served.troubles == ["no picture"] and served.requests.lists == 0
    with pytest.raises(InputRefused, check=coded("log-list.detector-error")):
        decode_logs(served.asker.recv(4096))
