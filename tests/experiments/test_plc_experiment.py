"""Metrics of the PLC experiment from plain outcomes."""

from __future__ import annotations

import math
from typing import Any

import pytest

from experiments.plc.experiment import METRICS, PATHS, gather, slope


def outcome(success: bool, rests_mm: list[float]) -> dict[str, Any]:
    measured = {"rests_mm": rests_mm, "squares": 900.0, "moments": 9, "age_ms": 20.0, "delays_ms": [10.0, 15.0]}
    return {"success": success, "stops": 1, "seconds": 40.0} | measured


def test_every_path_has_every_metric_and_a_lost_log_misses_the_limit() -> None:
    trials = {f"{path}-{i}": outcome(path != "valves" or i > 0, [1.0, 2.0 + i]) for path in PATHS for i in range(4)}
    metrics = gather(trials)
    assert {f.name for f in METRICS} <= metrics.keys()
    assert metrics["can_success"] == 1.0 and metrics["valves_success"] == 0.75 and metrics["can_stops"] == 4.0
    assert (metrics["references_rest_max_mm"], metrics["can_track_mm"]) == (5.0, 10.0)
    assert metrics["valves_command_ms"] == 12.5
    assert [f.name for f in METRICS if not f.holds(metrics[f.name])] == ["valves_success"]


def test_the_age_is_a_slope_so_that_an_offset_does_not_count() -> None:
    speeds = [-0.2, -0.1, 0.0, 0.1, 0.2]
    assert slope(speeds, [0.02 * v + 0.7 for v in speeds]) == pytest.approx(0.02)
    assert math.isnan(slope([1.0, 1.0], [1.0, 2.0]))
