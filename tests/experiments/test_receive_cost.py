"""The benchmark of receiving frames: its traffic, complete reception on every path, and its limit.  No times."""

from __future__ import annotations

import json
from collections import Counter
from itertools import islice
from typing import Any

import pytest
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from can_dbc.protocols.e2e import Checker, Status
from experiments.timing import receive_cost
from experiments.timing.receive_cost import LIMIT_US, measure, traffic
from host.exit_codes import ExitCode
from timberhand.commands.bench import app

TICKS = 40


def test_the_traffic_is_what_the_controller_receives() -> None:
    """Every message at its cycle time, every value in range, every counter in step."""
    database = load("crane")
    received = {c.key: c for c in database.messages.values() if c.cycle_time_ns and "CTRL" not in c.senders}
    per_second = sum(10**9 // codec.cycle_time_ns for codec in received.values())
    checkers = {key: Checker(codec.data_ids) for key, codec in received.items() if codec.data_ids}
    frames = list(islice(traffic(database), per_second * TICKS // 200))
    for key, count in Counter(key for key, _ in frames).items():
        assert abs(count - TICKS * 5_000_000 / received[key].cycle_time_ns) <= 1
    first = set()
    for key, data in frames:
        assert None not in received[key].receive(data)
        if key in checkers:
            assert checkers[key].check(data) is (Status.OK if key in first else Status.INITIAL)
            first.add(key)
    assert frames == list(islice(traffic(database), len(frames)))


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return measure(frames=30, rounds=10)


@pytest.mark.parametrize(
    ("cost_us", "lab", "code"),
    [
        (LIMIT_US, False, ExitCode.OK),
        (LIMIT_US + 0.1, False, ExitCode.FIGURE_MISSED),
        (LIMIT_US + 0.1, True, ExitCode.OK),
    ],
)
@pytest.mark.parametrize("form", [[], ["--json"]])
def test_the_command_compares_with_its_limit(
    cost_us: float,
    lab: bool,
    code: ExitCode,
    form: list[str],
    result: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    measured = result | {"lab": lab, "metrics": result["metrics"] | {"rx_decode_us": cost_us}}
    monkeypatch.setattr(receive_cost, "measure", lambda frames, rounds: measured)
    done = CliRunner().invoke(app, ["bus", *form])
    assert done.exit_code == code
    if form:
        assert json.loads(done.stdout)["metrics"]["rx_decode_us"] == cost_us
    else:
        assert ("lab:" in done.stdout) is lab
