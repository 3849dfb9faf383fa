"""The benchmark of motion planning: scenes in the base frame, and metrics without motions."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from experiments.benches.motion import Bench, observed
from experiments.common.worlds import wood_of
from machine.loading.profile_file import load_profile
from sim.scenes.arrangements import arrangement
from timberhand.cli import app


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_the_logs_of_a_scene_lie_in_the_pick_area_on_the_ground(name: str) -> None:
    profile = load_profile(name)
    for spec in arrangement("single", profile, wood_of(name, "nominal"), 4, 1):
        log = observed(profile, 0, spec)
        (cx, cy), half = profile.workspace.pick_center_m, profile.workspace.pick_half_size_m + 0.5
        assert abs(log.center_m[0] - cx) < half and abs(log.center_m[1] - cy) < half
        low = log.center_m[2] - log.diameter_m / 2 - profile.workspace.ground_z_m
        assert 0.0 <= low < 0.05


def test_no_motion_gives_empty_metrics() -> None:
    metrics = Bench().metrics()
    assert metrics["motions"] == 0 and metrics["cpu_p95_ms"] != metrics["cpu_p95_ms"]


@pytest.mark.long
def test_the_benchmark_plans_every_motion_and_is_faster_on_average() -> None:
    result = CliRunner().invoke(app, ["bench", "motion", "--seeds", "1", "--profile", "aoro_fc8", "--json"])
    assert result.exit_code == 0
    metrics = json.loads(result.stdout)["aoro_fc8"]
    assert metrics["motions"] == 12 and metrics["blocked"] == 0
    assert metrics["ours_mean_s"] < metrics["travel_mean_s"]
