"""Campaigns: their table, kept trials, recordings of those that failed; and all experiments at once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from experiments.common import all_experiments, campaign
from experiments.common.all_experiments import Pass
from experiments.common.pool import Job
from experiments.common.registry import EXPERIMENTS
from experiments.grasp_configs.trial import attempt
from hil.replay.recording import files_of, manifest_of
from host.exit_codes import CommandFailed, ExitCode
from tests.experiments.toy_experiment import enter, options
from timberhand.cli import app

QUIET = Console(quiet=True)


def test_failed_trials_are_recorded_once_and_one_that_does_not_repeat_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(monkeypatch)
    _, found = campaign.run("toy", options(tmp_path, trials=6), 10, QUIET)
    assert [(f.name, f.repeated) for f in found.recorded] == [("n/3", True), ("n/5", False)] and found.failures == 2
    recording = campaign.recording_of(Path(found.recorded[0].recording))
    assert (recording / "run.mcap").exists() and recording == tmp_path / "failed" / "n" / "3"
    (recording / "mark").touch()
    _, again = campaign.run("toy", options(tmp_path, trials=6), 1, QUIET)
    assert (recording / "mark").exists() and len(again.recorded) == 1 and again.failures == 2


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_recorded_grasp_has_the_same_outcome_and_opens(tmp_path: Path) -> None:
    what = {"profile": "palms_471", "truth": "nominal", "configuration": 1, "poses": "true", "planner": "search"}
    job = Job("true.search/1/0", "grasp", 7, what)
    plain = attempt(job)
    recorded = attempt(replace(job, options=what | {"record": str(tmp_path / "run")}))
    clocked = EXPERIMENTS["grasp-configs"].clocked
    assert campaign.line_of("a", plain, clocked) == campaign.line_of("a", recorded, clocked)
    assert plain["lifted"] == 1, "a grasp that never left the start would repeat as well"
    assert manifest_of(files_of(tmp_path / "run")).seed == 7 and (tmp_path / "run" / "profile.toml").exists()
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["complete"], "it was closed"


def test_an_experiment_in_real_time_is_no_campaign() -> None:
    refused = CliRunner().invoke(app, ["campaign", "timing"])
    assert refused.exit_code == ExitCode.USAGE


def test_all_experiments_run_quickly_and_a_failure_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[list[str]] = []

    def call(command: list[str]) -> int:
        called.append(command)
        return {"plant": 3, "plc": 6}.get(command[4], 0)

    monkeypatch.setattr(all_experiments, "_run", call)
    failed = CliRunner().invoke(app, ["experiment", "all", "--quick", "--out", str(tmp_path), "--seed", "5"])
    assert isinstance(failed.exception, CommandFailed) and failed.exception.code == "experiment.failed"
    assert "plant" in str(failed.exception) and "plc" not in str(failed.exception)
    assert [c[4] for c in called] == [name for name, entry in EXPERIMENTS.items() if not entry.live]
    assert all("--quick" in c and c[c.index("--seed") + 1] == "5" for c in called)
    summary = json.loads((tmp_path / "quick" / all_experiments.SUMMARY).read_text())
    assert [one["code"] for one in summary if one["name"] == "plc"] == [6]
    refused = CliRunner().invoke(app, ["experiment", "all", "--trials", "5"])
    assert refused.exit_code == ExitCode.USAGE


def test_the_estimate_scales_processor_time_and_adds_what_runs_in_real_time() -> None:
    hours = all_experiments.estimate_h([Pass("plc", 0, 50.0, 90.0)], workers=2)
    assert hours["plc"] == pytest.approx(90.0 * EXPERIMENTS["plc"].scale / 2 / 3600.0)
    assert hours["soak"] == pytest.approx(0.5) and set(hours) == {"plc", "timing", "rates", "vcan", "soak"}


def test_every_experiment_says_how_much_more_its_full_run_is() -> None:
    assert all(entry.live_s > 0.0 if entry.live else entry.scale > 1.0 for entry in EXPERIMENTS.values())
