"""A detector ahead of a driving machine: where its pictures are taken, and what its replies mean."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import pytest

from autonomy.perception.camera.frame import Pose
from autonomy.perception.driving_requests import DrivingRequests
from autonomy.perception.log_list import LogObservation, decode_logs, encode_request
from autonomy.perception.shown_picture import NewestPicture
from autonomy.perception.standpoint import MAX_AGE_NS, standpoint
from can_dbc.messages.picture import decode_picture, encode_picture_request
from runtime.errors import InputRefused
from tests.autonomy.mapped_logs import base as base_at
from tests.autonomy.test_detector_requests import AHEAD, Q, driving
from tests.codes import coded
from tests.operator_end import udp_end


class Detector:
    """Reports one log, wherever the machine stands; ``delay_s`` passes before its picture."""

    def __init__(self) -> None:
        self.problem, self.stood, self.delay_s = "", list[tuple[Pose, float] | None](), 0.0

    def detect_in_plane(
        self, standing: Callable[[], tuple[Pose, float] | None], q: tuple[float, ...], load: bool
    ) -> tuple[LogObservation, ...] | None:
        time.sleep(self.delay_s)
        self.stood.append(standing())
        self.problem = "" if self.stood[-1] else "too late"
        return (AHEAD,) if self.stood[-1] else None


class Served:
    """A detector's socket and a planner's."""

    def __init__(self) -> None:
        self.detector, self.troubles = Detector(), list[str]()
        self.taken_ns: int | None = None
        self._link = udp_end(None)
        self.planner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.planner.connect(self._link.getsockname())
        self.planner.settimeout(5.0)
        self.pictures = NewestPicture("front")
        self.requests = DrivingRequests(
            self.detector, self._link, lambda: self.taken_ns, self.troubles.append, self.pictures
        )

    def close(self) -> None:
        self._link.close()
        self.planner.close()


@pytest.fixture
def served() -> Iterator[Served]:
    one = Served()
    yield one
    one.close()


def test_only_the_newest_of_waiting_requests_gets_a_picture(served: Served) -> None:
    now_ns = time.monotonic_ns()
    for late_ns in (200_000_000, 100_000_000, 0):
        served.planner.send(encode_request(Q, driving(now_ns - late_ns)))
    served.taken_ns = now_ns + 100_000_000
    served.requests.answer_waiting()
    (stood,) = served.detector.stood
    assert stood is not None and stood[0].position_m[0] == pytest.approx(2.1)
    assert decode_logs(served.planner.recv(4096), in_plane=True) == (AHEAD,)


def test_a_page_gets_the_last_list_in_the_frame_of_the_crane(served: Served) -> None:
    served.planner.send(encode_request(()))
    served.requests.answer_waiting()
    assert decode_logs(served.planner.recv(4096)) == () and not served.detector.stood
    served.planner.send(
        encode_request(Q, standpoint(time.monotonic_ns(), base_at(2, 0, 0), base_at(2, 0, 0), (0, 0), 0))
    )
    served.requests.answer_waiting()
    served.planner.recv(4096)
    served.planner.send(encode_request(()))
    served.requests.answer_waiting()
    (log,) = decode_logs(served.planner.recv(4096))
    assert log.center_m == pytest.approx((10.0, 5.0, -1.4))


def test_a_standpoint_that_is_too_old_is_told_once(served: Served) -> None:
    for _ in range(2):
        served.planner.send(encode_request(Q, driving(time.monotonic_ns() - 2 * MAX_AGE_NS)))
        served.requests.answer_waiting()
    assert served.troubles == ["too late"]


def test_a_nonsense_request_is_answered_with_an_error(served: Served) -> None:
    served.planner.send(b"{}")
    served.requests.answer_waiting()
    with pytest.raises(InputRefused, check=coded("log-list.detector-error")):
        decode_logs(served.planner.recv(4096))


def test_who_watches_gets_an_answer_without_a_picture_being_taken(served: Served) -> None:
    served.planner.send(encode_picture_request())
    served.requests.answer_waiting()
    facts, jpeg = decode_picture(served.planner.recv(65536))
    assert (facts.camera, facts.measured_ns, jpeg) == ("front", 0, b"") and not served.detector.stood
