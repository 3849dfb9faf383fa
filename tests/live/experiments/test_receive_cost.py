"""The benchmark of receiving frames: its traffic, complete reception on every path, and its limit.  No times."""

from __future__ import annotations

from typing import Any

import pytest

from experiments.timing.receive_cost import Traffic, measure
from host.exit_codes import CommandFailed
from tests.codes import coded


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return measure(frames=30, rounds=10)


def test_every_path_receives_every_frame(result: dict[str, Any]) -> None:
    assert set(result["paths"]) == {"ours", "pythoncan", "wire"}
    assert {"rx_us", "rx_decode_us", "rx_pythoncan_us", "rx_decode_pythoncan_us"} < set(result["metrics"])
    assert all(value > 0 for value in result["metrics"].values())


def test_a_path_that_loses_a_frame_ends_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    take = Traffic.take
    monkeypatch.setattr(Traffic, "take", lambda self, count: take(self, count)[:-1])
    with pytest.raises(CommandFailed, check=coded("receive-cost.frames-missing")):
        measure(frames=30, rounds=3)
