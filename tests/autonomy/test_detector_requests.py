"""What a detector is asked and replies: log lists, standpoints, requests that wait, and what systemd is told of it."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.perception import __main__ as process
from autonomy.perception.driving_requests import StandingRequests
from autonomy.perception.log_list import (
    LogEstimate,
    LogObservation,
    decode_logs,
    decode_request,
    encode_error,
    encode_logs,
    encode_request,
    unpack_covariance,
)
from autonomy.perception.shown_picture import NewestPicture
from autonomy.perception.standpoint import MAX_AGE_NS, Standpoint, standpoint
from can_dbc.messages.picture import decode_picture, encode_picture_request
from runtime.errors import InputRefused, LinkError
from runtime.notifier import Notifier
from tests.autonomy.mapped_logs import base as base_at
from tests.codes import coded, numbers_in

LOG: dict[str, Any] = {
    "position_m": [-1.8, 4.4, -1.3],
    "axis": [3.0, 4.0, 0.0],
    "length_m": 2.6,
    "diameter_m": 0.2,
    "mass_kg": 50.0,
}


def reply(**changes: object) -> bytes:
    return json.dumps([LOG, LOG | changes]).encode()


def test_logs_without_ids_are_numbered_by_index_and_axes_are_normalised() -> None:
    first, second = decode_logs(reply(diameter_m=0.3))
    assert (first.id, second.id) == (0, 1)
    assert first.axis == pytest.approx((0.6, 0.8, 0.0)) and second.diameter_m == 0.3
    assert decode_logs(b"[]") == ()


def test_ids_of_a_detector_are_kept_and_must_differ() -> None:
    seen = [LogObservation(n, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0), 3.0, 0.2) for n in (7, 3)]
    assert decode_logs(encode_logs(seen)) == tuple(seen)
    with pytest.raises(InputRefused, check=coded("log-list.duplicate-id")):
        decode_logs(encode_logs([seen[0], seen[0]]))


def test_a_reply_says_which_logs_the_newest_picture_shows() -> None:
    logs = [LogObservation(n, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0), 3.0, 0.2, seen=n == 7) for n in (7, 3)]
    assert [log.seen for log in decode_logs(encode_logs(logs))] == [True, False]
    assert all(log.seen for log in decode_logs(reply())), "seen is the default"


def test_a_reply_carries_an_estimate_with_its_covariance() -> None:
    root = np.random.default_rng(1).normal(0.0, 0.02, (7, 7))
    estimate = LogEstimate(np.array([1.0, 2.0, -1.0]), np.array([0.0, 1.0, 0.0]), 3.0, 0.2, root @ root.T)
    (log,) = decode_logs(encode_logs([estimate.observation(4)]))
    assert (log.id, log.center_m, log.axis) == (4, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0))
    assert (log.length_m, log.diameter_m) == (3.0, 0.2)
    assert log.covariance is not None and unpack_covariance(log.covariance) == pytest.approx(root @ root.T, rel=1e-3)


def test_an_error_reply_is_raised() -> None:
    with pytest.raises(InputRefused, check=coded("log-list.detector-error")):
        decode_logs(encode_error("the camera is dark"))


def test_a_request_carries_the_joints_which_are_nan_when_missing() -> None:
    assert decode_request(encode_request((0.5, -1.0, 2.25, 0.125, math.nan))).q[:4] == (0.5, -1.0, 2.25, 0.125)
    assert all(math.isnan(value) for value in decode_request(encode_request(())).q)


@pytest.mark.parametrize("data", [b"", b"[]", b'{"op":"state"}', b'{"op":"logs","q":"1 2"}', b'{"op":"logs","q":"a"}'])
def test_a_datagram_that_is_not_a_request_is_refused(data: bytes) -> None:
    with pytest.raises(InputRefused, check=coded("log-list.not-a-request")):
        decode_request(data)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"diameter_m": 2.7}, "bad-size"),
        ({"diameter_m": 0.0}, "bad-size"),
        ({"axis": [0.0, 0.0, 0.0]}, "bad-value"),
        ({"axis": [1.7e308, 1.7e308, 0.0]}, "bad-value"),
        ({"length_m": None}, "not-a-list"),
        ({"position_m": [1.0, 2.0]}, "not-a-list"),
        ({"covariance": [1e-4] * 27}, "bad-covariance"),
        ({"covariance": [1e-4] * 27 + [-1e-4]}, "bad-covariance"),
        ({"covariance": [1e-4] * 27 + [math.inf]}, "not-a-list"),
    ],
)
def test_an_impossible_log_refuses_the_whole_list(changes: dict[str, object], code: str) -> None:
    with pytest.raises(InputRefused, check=coded(f"log-list.{code}")):
        decode_logs(reply(**changes))


@given(
    st.one_of(
        st.binary(max_size=300),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.text(max_size=5),
            lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*LOG]), inner, max_size=5),
            max_leaves=12,
        ).map(lambda value: json.dumps(value).encode()),
    )
)
def test_any_other_data_raises_only_log_list_error(data: bytes) -> None:
    try:
        logs = decode_logs(data)
    except InputRefused:
        return
    assert all(math.isfinite(v) for log in logs for v in (*log.center_m, *log.axis))


# -- a detector ahead of a driving machine
Q = (0.0, 1.2, -2.4, 0.1, math.nan)
AHEAD = LogObservation(3, (12.0, 5.0, 0.1), (0.0, 1.0, 0.0), 2.0, 0.2)


def driving(stamp_ns: int = 0) -> Standpoint:
    """At 1 m/s to the east and 0.1 rad/s to the left, the articulation bending by 0.05 rad/s."""
    return standpoint(stamp_ns, base_at(2.0, 0.0, 0.3), base_at(1.8, 0.0, 0.28), (0.09, 0.1), 0.2)


def test_a_picture_is_placed_where_the_machine_was_at_its_time() -> None:
    stood = driving(1_000_000_000).at(1_400_000_000)
    base, articulation_rad = stood
    assert base.position_m == pytest.approx([2.4, 0.0, 1.5]) and articulation_rad == pytest.approx(0.12)
    assert math.atan2(base.rotation[1, 0], base.rotation[0, 0]) == pytest.approx(0.34)


def test_no_picture_is_placed_by_an_old_standpoint() -> None:
    assert driving().at(MAX_AGE_NS) is not None
    assert driving().at(MAX_AGE_NS + 1) is None


@pytest.mark.parametrize("load", [False, True], ids=["no load", "a load before the camera"])
def test_a_standpoint_arrives_as_it_was_sent(load: bool) -> None:
    sent = replace(driving(7_123_456_789_012_345), load=load)
    request = decode_request(encode_request(Q, sent))
    got = request.standpoint
    assert got is not None and request.q[:4] == Q[:4] and (got.stamp_ns, got.load) == (sent.stamp_ns, load)
    assert got.numbers() == pytest.approx(sent.numbers(), abs=1e-7)
    assert decode_request(encode_request(Q)).standpoint is None


@pytest.mark.parametrize("numbers", ["1 2 3", " ".join(["nan"] * 14)])
def test_a_standpoint_that_is_none_is_refused(numbers: str) -> None:
    with pytest.raises(InputRefused, check=coded("log-list.bad-standpoint")):
        decode_request(b'{"op":"logs","at_ns":"5","standpoint":"%s"}' % numbers.encode())


def test_a_list_in_the_other_frame_is_refused() -> None:
    assert decode_logs(encode_logs([AHEAD], in_plane=True), in_plane=True) == (AHEAD,)
    for written, read in ((False, True), (True, False)):
        with pytest.raises(InputRefused, check=coded("log-list.other-frame")):
            decode_logs(encode_logs([AHEAD], in_plane=written), in_plane=read)


# -- requests that wait behind a slow detection
SEEN = LogObservation(3, (-1.0, 4.0, 0.1), (0.0, 1.0, 0.0), 2.0, 0.2)
JOINTS = tuple((0.25 * k, 0.6, -1.2, 0.3, 0.0) for k in range(4))


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
        self.logs = (SEEN,) if len(self.detected) > 1 else ()
        return self.logs or None


@pytest.fixture
def link() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        yield link


@pytest.fixture
def served(link: socket.socket) -> Iterator[SimpleNamespace]:
    """A detector, who asks it, and what is reported of it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.connect(link.getsockname())
        asker.settimeout(0.3)
        detector, troubles = Detector(), list[str]()
        requests = StandingRequests(detector, link, troubles.append, NewestPicture("stick"))
        yield SimpleNamespace(detector=detector, troubles=troubles, asker=asker, requests=requests)


def test_of_waiting_requests_only_the_newest_gets_a_detection(served: SimpleNamespace) -> None:
    """Else each detection uses older joints than the last one, and its picture is placed where it was not taken."""
    for q in JOINTS:
        served.asker.send(encode_request(q))
    served.requests.answer_waiting()
    assert served.detector.detected == [JOINTS[3]] and served.detector.heard == list(JOINTS[:3])
    with pytest.raises(TimeoutError):
        served.asker.recv(4096)
    served.asker.send(encode_request(JOINTS[3]))
    served.requests.answer_waiting()
    assert (served.requests.lists, served.requests.log_count, served.requests.problem) == (1, 1, "")
    assert decode_logs(served.asker.recv(4096)) == (SEEN,)


def test_who_watches_is_answered_before_the_detection(served: SimpleNamespace) -> None:
    served.detector.logs = (SEEN,)
    for request in (encode_request(JOINTS[0]), encode_request(()), encode_picture_request()):
        served.asker.send(request)
    served.requests.answer_waiting()
    assert decode_logs(served.asker.recv(4096)) == (SEEN,)
    assert decode_picture(served.asker.recv(65536))[0].camera == "stick"


def test_a_problem_is_reported_once_and_a_bad_request_is_answered(served: SimpleNamespace) -> None:
    served.asker.send(b'{"op":"what"}')
    for _ in range(2):
        served.detector.detected.clear()
        served.asker.send(encode_request(JOINTS[0]))
        served.requests.answer_waiting()
    assert served.troubles == ["no picture"] and served.requests.lists == 0
    with pytest.raises(InputRefused, check=coded("log-list.detector-error")):
        decode_logs(served.asker.recv(4096))


# -- what systemd is told
S = 1_000_000_000


class Requests:
    """Makes a list each time it answers."""

    def __init__(self) -> None:
        self.lists, self.log_count, self.problem = 0, 3, ""

    def answer_waiting(self) -> None:
        self.lists += 1


def test_the_status_tells_logs_and_lists_per_second_or_the_trouble() -> None:
    requests, now = Requests(), iter((0, S, 3 * S, 4 * S))
    text = process.StatusText("stick", requests, lambda: next(now))
    assert numbers_in(text()) == []
    requests.lists = 9
    assert numbers_in(text()) == [3.0, 4.5]
    requests.problem = "trouble 77"
    assert numbers_in(text()) == [77.0]


def test_it_is_ready_when_it_serves_alive_while_it_does_and_says_that_it_ends(tmp_path: Path, link) -> None:
    signals: list[int] = []

    class Ending(Requests):
        def answer_waiting(self) -> None:
            super().answer_waiting()
            signals.append(15)

    requests = Ending()
    link.sendto(b"x", link.getsockname())
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        notifier = Notifier(process.StatusText("stick", requests), str(tmp_path / "notify"))
        process.serve(link, requests, notifier, signals)
        first, last = systemd.recv(4096).decode(), systemd.recv(4096).decode()
    assert first.split("\n")[:2] == ["READY=1", "WATCHDOG=1"] and last.split("\n")[0] == "STOPPING=1"
    assert requests.lists == 1


@pytest.mark.parametrize(("code", "exit_code"), [("camera-source.not-opened", 4), ("camera-source.no-sdk", 3)])
def test_a_camera_that_is_not_there_now_is_tried_again_by_the_service(monkeypatch, code, exit_code) -> None:
    def refuse(*_: object) -> None:
        raise LinkError(code, "no")

    monkeypatch.setattr(process, "LogSegmenter", lambda *_: None)
    monkeypatch.setattr(process, "open_source", refuse)
    assert process.main(["--camera", "stick", "--frames", "zed"]) == exit_code
