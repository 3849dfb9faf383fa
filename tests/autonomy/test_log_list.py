"""The detector's answer is a log list, or it is refused whole."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.perception import logs
from autonomy.perception.estimate import LogEstimate, unpacked
from autonomy.perception.logs import LogObservation, LogsRefused, parse_logs, parse_question, question

LOG: dict[str, Any] = {
    "position_m": [-1.8, 4.4, -1.3],
    "axis": [3.0, 4.0, 0.0],
    "length_m": 2.6,
    "diameter_m": 0.2,
    "mass_kg": 50.0,
}


def answer(**changes: object) -> bytes:
    return json.dumps([LOG, LOG | changes]).encode()


def test_logs_are_numbered_by_their_place_and_their_axes_have_length_one() -> None:
    first, second = parse_logs(answer(diameter_m=0.3))
    assert (first.id, second.id) == (0, 1)
    assert first.axis == pytest.approx((0.6, 0.8, 0.0)) and second.diameter_m == 0.3


def test_numbers_that_a_detector_gives_are_kept_and_must_differ() -> None:
    seen = [LogObservation(n, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0), 3.0, 0.2) for n in (7, 3)]
    assert parse_logs(logs.answer(seen)) == tuple(seen)
    with pytest.raises(LogsRefused, match="same number"):
        parse_logs(logs.answer([seen[0], seen[0]]))


def test_whether_the_newest_look_shows_a_log_goes_with_it() -> None:
    told = [LogObservation(n, (1.0, 2.0, -1.0), (0.0, 1.0, 0.0), 3.0, 0.2, seen=n == 7) for n in (7, 3)]
    assert [log.seen for log in parse_logs(logs.answer(told))] == [True, False]
    assert all(log.seen for log in parse_logs(answer())), "who does not say so has seen it"


def test_how_well_a_log_is_known_goes_with_it() -> None:
    root = np.random.default_rng(1).normal(0.0, 0.02, (7, 7))
    estimate = LogEstimate(np.array([1.0, 2.0, -1.0]), np.array([0.0, 1.0, 0.0]), 3.0, 0.2, root @ root.T)
    (told,) = parse_logs(logs.answer([estimate.observation(4)]))
    assert told.covariance is not None and unpacked(told.covariance) == pytest.approx(root @ root.T, rel=1e-3)


def test_a_detector_that_cannot_look_says_why() -> None:
    with pytest.raises(LogsRefused, match="the camera is dark"):
        parse_logs(logs.answer_trouble("the camera is dark"))


def test_a_question_carries_the_joints_and_without_any_they_are_unknown() -> None:
    assert parse_question(question((0.5, -1.0, 2.25, 0.125, math.nan)))[:4] == (0.5, -1.0, 2.25, 0.125)
    assert all(math.isnan(value) for value in parse_question(question(())))


@pytest.mark.parametrize("data", [b"", b"[]", b'{"op":"state"}', b'{"op":"logs","q":"1 2"}', b'{"op":"logs","q":"a"}'])
def test_what_is_no_question_for_logs_is_refused(data: bytes) -> None:
    with pytest.raises(LogsRefused, match="no question"):
        parse_question(data)


def test_no_logs_is_a_list_too() -> None:
    assert parse_logs(b"[]") == ()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"diameter_m": 2.7}, "log 1 is 2.6 m long and 2.7 m wide"),
        ({"diameter_m": 0.0}, "which is no log"),
        ({"axis": [0.0, 0.0, 0.0]}, "log 1 has .* an axis without a direction"),
        ({"axis": [1.7e308, 1.7e308, 0.0]}, "not finite"),
        ({"length_m": None}, "not a log list"),
        ({"position_m": [1.0, 2.0]}, "not a log list"),
        ({"covariance": [1e-4] * 27}, "log 1 has a covariance that is none"),
        ({"covariance": [1e-4] * 27 + [-1e-4]}, "no variance below 0"),
        ({"covariance": [1e-4] * 27 + [math.inf]}, "not a log list"),
    ],
)
def test_an_impossible_log_refuses_the_list(changes: dict[str, object], says: str) -> None:
    with pytest.raises(LogsRefused, match=says):
        parse_logs(answer(**changes))


@given(st.one_of(st.binary(max_size=300), st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*LOG]), inner, max_size=5),
    max_leaves=12,
).map(lambda value: json.dumps(value).encode())))  # fmt: skip
def test_anything_else_is_refused_and_nothing_else_is_raised(data: bytes) -> None:
    try:
        logs = parse_logs(data)
    except LogsRefused:
        return
    assert all(math.isfinite(v) for log in logs for v in (*log.center_m, *log.axis))
