"""An experiment for tests of campaigns: numbers, of which one fails; it records what it is asked to."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.common import pool
from experiments.common.checkpoint import Checkpoint
from experiments.common.pool import Job
from experiments.common.recording import RECORD
from experiments.common.registry import EXPERIMENTS, Entry, Options
from experiments.common.result import Result, make_result
from experiments.common.workers import Trial, Workers


def perform(job: Job) -> dict[str, Any]:
    if RECORD in job.options:
        folder = Path(job.options[RECORD])
        folder.mkdir(parents=True)
        (folder / "run.mcap").write_text("recorded")
    now_s = time.time()  # noqa: TID251  an outcome that is never the same twice
    return {"square": job.seed**2, "clock": now_s, "odd": now_s if job.seed == 5 else 0}


def failed(trial: Trial) -> bool:
    return trial.outcome["square"] in (9, 25)


def run(options: Options, console: Console) -> Result:
    jobs = [Job(f"n/{i}", "square", i, {}) for i in range(options.trials or 4)]
    with Checkpoint(options.out / "trials.jsonl", "toy", stays=options.keeps_trials) as kept:
        outcomes: Mapping[str, Any] = pool.run(perform, jobs, kept, options.workers, "squares", console)
    return make_result("toy", (), {}, profile="none", seed=1, trials=len(outcomes), more={})


def enter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this one of the experiments."""
    monkeypatch.setitem(EXPERIMENTS, "toy", Entry("?", __name__, (), clocked=("clock",)))


def options(out: Path, workers: int = 1, trials: int = 4) -> Options:
    """Of a campaign of it."""
    return Options(1, "nominal", "palms_471", out, trials=trials, workers=Workers(workers))
