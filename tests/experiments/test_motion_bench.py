"""The bench of clear ways: scenes in the base frame, and figures that can be told."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from experiments.benches.motion import Bench, observed
from experiments.common.worlds import wood_of
from machine.load import load_profile
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


def test_no_motion_is_no_crash() -> None:
    figures = Bench().metrics()
    assert figures["motions"] == 0 and figures["cpu_p95_ms"] != figures["cpu_p95_ms"]


@pytest.mark.slow
@pytest.mark.computed
def test_the_bench_plans_every_motion_and_none_is_slower_on_the_whole() -> None:
    result = CliRunner().invoke(app, ["bench", "motion", "--seeds", "1", "--profile", "aoro_fc8", "--json"])
    assert result.exit_code == 0
    figures = json.loads(result.stdout)["aoro_fc8"]
    assert figures["motions"] == 12 and figures["blocked"] == 0
    assert figures["ours_mean_s"] < figures["travel_mean_s"]
