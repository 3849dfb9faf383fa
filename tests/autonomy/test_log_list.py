"""A detector's reply is a log list, or it is refused as a whole."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from runtime.errors import InputRefused
from tests.codes import coded

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


def test_ids_of_a_detector_are_kept_and_must_differ() -> None:
    seen = [LogObservation(n, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0), 3.0, 0.2) for n in (7, 3)]
    assert decode_logs(encode_logs(seen)) == tuple(seen)
    with pytest.raises(InputRefused, check=coded("log-list.duplicate-id")):
        decode_logs(encode_logs([seen[0], seen[0]]))


def test_a_reply_says_which_logs_the_newest_picture_shows() -> None:
    logs = [LogObservation(n, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0), 3.0, 0.2, seen=n == 7) for n in (7, 3)]
    assert [log.seen for log in decode_logs(encode_logs(logs))] == [True, False]
    assert all(log.seen for log in decode_logs(reply())), "seen is the default"


def test_a_reply_carries_the_covariance() -> None:
    root = np.random.default_rng(1).normal(0.0, 0.02, (7, 7))
    estimate = LogEstimate(np.array([1.0, 2.0, -1.0]), np.array([0.0, 1.0, 0.0]), 3.0, 0.2, root @ root.T)
    (log,) = decode_logs(encode_logs([estimate.observation(4)]))
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


def test_an_empty_list_is_valid() -> None:
    assert decode_logs(b"[]") == ()


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
