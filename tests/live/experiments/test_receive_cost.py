"""The benchmark of receiving frames: its traffic, complete reception on every path, and its limit.  No times."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from experiments.timing import receive_cost
from experiments.timing.receive_cost import measure
from host.exit_codes import CommandFailed
from tests.codes import coded


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return measure(frames=30, rounds=10)


def test_every_path_receives_every_frame(result: dict[str, Any]) -> None:
    assert set(result["paths"]) == {"ours", "pythoncan", "pythoncan_bus"}
    assert {"rx_us", "rx_decode_us", "rx_pythoncan_us", "rx_decode_pythoncan_us"} < set(result["metrics"])
    assert all(value > 0 for value in result["metrics"].values())


def test_a_path_that_loses_a_frame_ends_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    lanes = receive_cost._lanes
    monkeypatch.setattr(
        receive_cost,
        "_lanes",
        lambda stack: [replace(x, send=lambda frames, send=x.send: send(frames[:-1])) for x in lanes(stack)],
    )
    with pytest.raises(CommandFailed, check=coded("receive-cost.frames-missing")):
        measure(frames=30, rounds=3)
