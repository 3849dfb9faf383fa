"""A campaign: many trials of one experiment, whose table is the same bytes wherever they ran.

An experiment performs its trials as always (`experiments.common.pool`); the campaign keeps them, writes them as a table
in the order of the plan, says what they cost, and performs those that failed once more with a recording.  A trial is a
pure function of its job, so that its repetition fails in the same way; where it does not, the campaign says so.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.checkpoint import Checkpoint
from experiments.common.recording import RECORD
from experiments.common.registry import EXPERIMENTS, Options, load
from experiments.common.result import Result, mean
from experiments.common.workers import Trial, TrialCost, Workers, overhead_s

TABLE: Final = "table.jsonl"
SUMMARY: Final = "campaign.json"
RECORDINGS: Final = "failed"
"""Folder of the recordings of failed trials, in that of the campaign."""


@dataclass(frozen=True, slots=True)
class FailedTrial:
    """A trial that failed: its recording, and whether the repetition gave the same outcome."""

    name: str
    recording: str
    repeated: bool


@dataclass(frozen=True, slots=True)
class Campaign:
    """What a campaign leaves in campaign.json beside its table.

    ``failures``: failed trials; ``recorded``: those with a recording.  ``seconds``: of a trial, mean and greatest;
    ``overhead_s``: mean time between two trials of a worker (None with fewer than two); ``worker_bytes``: greatest
    memory of a worker; ``table_bytes`` and ``kept_bytes``: of a trial in the table and on the disk, mean;
    ``wall_s``: duration of this call, which skips trials that were kept.
    """

    experiment: str
    seed: int
    trials: int
    workers: int
    table_sha256: str
    failures: int
    recorded: tuple[FailedTrial, ...]
    seconds: float
    seconds_max: float
    overhead_s: float | None
    worker_bytes: int
    table_bytes: float
    kept_bytes: float
    wall_s: float


def run(name: str, options: Options, recordings: int, console: Console) -> tuple[Result, Campaign]:
    """Perform the trials of an experiment and record again at most ``recordings`` of those that failed."""
    begun_s = time.monotonic()
    trials: list[Trial] = []
    workers = replace(options.workers, trials=trials)
    result = load(name)(replace(options, workers=workers, keeps_trials=True), console)
    clocked = EXPERIMENTS[name].clocked
    lines = [line_of(t.job.name, t.outcome, clocked) for t in trials]
    table = "".join(f"{line}\n" for line in lines).encode()
    (options.out / TABLE).write_bytes(table)
    judge: Callable[[Any], bool] | None = getattr(import_module(EXPERIMENTS[name].module), "failed", None)
    failed = [t for t in trials if judge is not None and judge(t)]
    recorded = record(failed[:recordings], clocked, options, console)
    costs = [t.cost for t in trials if t.cost is not None]
    campaign = Campaign(
        experiment=name,
        seed=options.seed,
        trials=len(trials),
        workers=len({c.worker for c in costs}),
        table_sha256=hashlib.sha256(table).hexdigest(),
        failures=len(failed),
        recorded=recorded,
        **_figures(costs),
        table_bytes=round(len(table) / max(1, len(trials)), 1),
        kept_bytes=round((options.out / "trials.jsonl").stat().st_size / max(1, len(trials)), 1),
        wall_s=round(time.monotonic() - begun_s, 3),
    )
    (options.out / SUMMARY).write_text(json.dumps(asdict(campaign), indent=2) + "\n")
    return result, campaign


def line_of(name: str, outcome: Any, clocked: Sequence[str]) -> str:
    """Write the line of a trial in the table: name and outcome, without what depends on the speed of the host."""
    comparable = {k: v for k, v in outcome.items() if k not in clocked} if isinstance(outcome, Mapping) else outcome
    return json.dumps([name, comparable], sort_keys=True)


def record(
    failed: Sequence[Trial], clocked: Sequence[str], options: Options, console: Console
) -> tuple[FailedTrial, ...]:
    """Perform trials again with a recording each; those that have one already are not performed."""
    folders = {t.job.name: options.out / RECORDINGS / t.job.name for t in failed}
    jobs = [replace(t.job, options=t.job.options | {RECORD: str(folders[t.job.name].resolve())}) for t in failed]
    repeated_outcomes: dict[str, Any] = {}
    with Checkpoint(options.out / "recordings.jsonl", "recordings", stays=True) as trial_store:
        for function in dict.fromkeys(t.function for t in failed):
            function_jobs = [job for job, t in zip(jobs, failed, strict=True) if t.function is function]
            for job in function_jobs:
                if trial_store.find(job.digest()) is None:
                    shutil.rmtree(folders[job.name], ignore_errors=True)  # the rest of an interrupted recording
            local = Workers(options.workers.count)
            repeated_outcomes |= pool.run(
                function, function_jobs, trial_store, local, "recordings of failed trials", console
            )
    return tuple(
        FailedTrial(
            t.job.name,
            str(folders[t.job.name]),
            line_of(t.job.name, repeated_outcomes[t.job.name], clocked) == line_of(t.job.name, t.outcome, clocked),
        )
        for t in failed
    )


def _figures(costs: Sequence[TrialCost]) -> dict[str, Any]:
    between_s = overhead_s(costs)
    return {
        "seconds": round(mean([c.seconds for c in costs]), 3),
        "seconds_max": max((c.seconds for c in costs), default=math.nan),
        "overhead_s": round(between_s, 4) if math.isfinite(between_s) else None,
        "worker_bytes": max((c.peak_bytes for c in costs), default=0),
    }


def recording_of(trial: Path) -> Path:
    """Find the first recorded run in the folder of a failed trial: a trial may run several."""
    return min((path.parent for path in trial.rglob("run.mcap")), default=trial)
