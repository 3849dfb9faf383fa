"""A detector ahead of a driving machine: where its pictures are taken, and what its replies mean."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation, decode_logs, decode_request, encode_logs, encode_request
from autonomy.perception.standpoint import MAX_AGE_NS, Standpoint, standpoint
from runtime.errors import InputRefused
from tests.codes import coded

Q = (0.0, 1.2, -2.4, 0.1, math.nan)
LOG = LogObservation(3, (12.0, 5.0, 0.1), (0.0, 1.0, 0.0), 2.0, 0.2)


def turned(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return Pose(np.array([x_m, y_m, 1.5]), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def driving(stamp_ns: int = 0) -> Standpoint:
    """At 1 m/s to the east and 0.1 rad/s to the left, the articulation bending by 0.05 rad/s."""
    return standpoint(stamp_ns, turned(2.0, 0.0, 0.3), turned(1.8, 0.0, 0.28), (0.09, 0.1), 0.2)


def test_a_picture_is_placed_where_the_machine_was_at_its_time() -> None:
    stood = driving(1_000_000_000).at(1_400_000_000)
    assert stood is not None
    base, articulation_rad = stood
    assert base.position_m == pytest.approx([2.4, 0.0, 1.5]) and articulation_rad == pytest.approx(0.12)
    assert math.atan2(base.rotation[1, 0], base.rotation[0, 0]) == pytest.approx(0.34)


def test_no_picture_is_placed_by_an_old_standpoint() -> None:
    assert driving().at(MAX_AGE_NS) is not None
    assert driving().at(MAX_AGE_NS + 1) is None


def test_a_standpoint_arrives_as_it_was_sent() -> None:
    sent = driving(7_123_456_789_012_345)
    request = decode_request(encode_request(Q, sent))
    got = request.standpoint
    assert got is not None and request.q[:4] == Q[:4] and got.stamp_ns == sent.stamp_ns
    assert got.numbers() == pytest.approx(sent.numbers(), abs=1e-7)
    assert decode_request(encode_request(Q)).standpoint is None


@pytest.mark.parametrize("load", [False, True])
def test_a_request_says_whether_the_crane_holds_a_load_before_the_camera(load: bool) -> None:
    request = decode_request(encode_request(Q, replace(driving(), load=load)))
    assert request.standpoint is not None and request.standpoint.load is load


@pytest.mark.parametrize("numbers", ["1 2 3", " ".join(["nan"] * 14)])
def test_a_standpoint_that_is_none_is_refused(numbers: str) -> None:
    with pytest.raises(InputRefused, check=coded("log-list.bad-standpoint")):
        decode_request(b'{"op":"logs","at_ns":"5","standpoint":"%s"}' % numbers.encode())


def test_a_list_in_the_other_frame_is_refused() -> None:
    assert decode_logs(encode_logs([LOG], in_plane=True), in_plane=True) == (LOG,)
    for written, read in ((False, True), (True, False)):
        with pytest.raises(InputRefused, check=coded("log-list.other-frame")):
            decode_logs(encode_logs([LOG], in_plane=written), in_plane=read)
