"""The plant experiment: plan, evaluation, one trial of each kind, and the complete quick run."""

from __future__ import annotations

import pytest
from rich.console import Console
from typer.testing import CliRunner

from experiments.common.registry import EXPERIMENTS, Options, load
from experiments.common.workers import Workers
from experiments.plant import experiment
from experiments.plant.metrics import METRICS
from timberhand.cli import app


def options(tmp_path, **changes) -> Options:
    return Options(**{"seed": 1, "truth": "nominal", "profile": "palms_471", "out": tmp_path, **changes})


def test_every_experiment_can_be_loaded():
    assert all(callable(load(name)) for name in EXPERIMENTS)


def test_the_plan_has_every_trial_once_and_the_longest_first(tmp_path):
    jobs = experiment.plan(options(tmp_path), 5)
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names) == len(experiment.FUNCTIONS) - 4 + 4 * 5
    assert names[0] == "shift" and {job.kind for job in jobs} == set(experiment.FUNCTIONS)


def test_a_truth_file_of_the_fixed_crane_does_not_reach_the_carrier(tmp_path):
    jobs = {job.name: job.options for job in experiment.plan(options(tmp_path, truth="mine.toml"), 1)}
    assert jobs["sag"]["truth"] == "mine.toml" and jobs["turning"]["truth"] == "nominal"
    assert jobs["turning"]["profile"] == "aoro_fc8"


def test_an_unusable_truth_file_is_named(tmp_path):
    done = CliRunner().invoke(
        app, ["experiment", "plant", "--truth", str(tmp_path / "no.toml"), "--out", str(tmp_path)]
    )
    assert "no.toml" in str(done.exception) and done.exception.exit_code == 3


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_quick_run_meets_its_limits_and_writes_everything(tmp_path):
    result = experiment.run(
        options(tmp_path / "out", quick=True, workers=Workers(2), docs=tmp_path / "docs"), Console(quiet=True)
    )
    clocked = {f.name for f in METRICS if f.clocked}
    assert set(result.missed) <= clocked and {f.name for f in METRICS} <= result.metrics.keys()
    assert result.metrics["load_cell_error"] < 0.2
    assert not (tmp_path / "out" / "trials.jsonl").exists()
