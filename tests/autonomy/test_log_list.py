"""The detector's answer is a log list, or it is refused whole."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.logs import LogsRefused, parse_logs

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
