"""Runs independent trials on all cores or on a cluster, with a checkpoint on disk.

A job is plain data.  ``function(job)`` runs in a worker and returns plain (JSON) data that depends on the job alone, so
neither the number of workers nor their place changes a result.  Outcomes come back in the order of the jobs.  Every
finished job is written to the checkpoint at once; after an interruption the same call continues from there.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from experiments.common.checkpoint import Checkpoint as Checkpoint
from experiments.common.checkpoint import installation
from experiments.common.workers import Trial, TrialCost, Workers, measured
from runtime.memory import keep_memory

SPEED_PERIOD_S: Final = 1800.0
"""The time left is estimated from so long: a mission takes minutes."""
TOLD_EVERY_S: Final = 60.0
"""Without a terminal the progress is a line, at most this often."""


@dataclass(frozen=True, slots=True)
class Job:
    """One trial: a name unique in the run, the kind of trial, its seed and further plain arguments."""

    name: str
    kind: str
    seed: int
    options: dict[str, Any]

    def digest(self) -> str:
        """Compute the hash of the whole content."""
        text = json.dumps([self.name, self.kind, self.seed, self.options], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


def run(
    function: Callable[[Job], Any],
    jobs: Sequence[Job],
    checkpoint: Checkpoint,
    workers: Workers,
    title: str,
    console: Console,
) -> dict[str, Any]:
    """Return every job's outcome by name, in the order of ``jobs``; an exception in a trial names it in a note."""
    digests = {job.name: job.digest() for job in jobs}
    stored_trials = {
        job.name: stored_trial for job in jobs if (stored_trial := checkpoint.find(digests[job.name])) is not None
    }
    checkpoint.done.update({name: trial.outcome for name, trial in stored_trials.items()})
    work = {
        job.name: partial(measured, partial(_named, function), job) for job in jobs if job.name not in stored_trials
    }
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, speed_estimate_period=SPEED_PERIOD_S) as progress:
        task = progress.add_task(title, total=len(jobs), completed=len(stored_trials))
        begun_s = reported_s = time.monotonic()
        for count, (name, (outcome, cost)) in enumerate(_completed(work, workers), 1):
            checkpoint.add(name, outcome, digests[name], cost)
            progress.advance(task)
            now_s = time.monotonic()
            if not console.is_terminal and now_s - reported_s > TOLD_EVERY_S:
                reported_s = now_s
                left_min = (now_s - begun_s) / count * (len(work) - count) / 60.0
                console.print(
                    f"{title}: {len(stored_trials) + count} of {len(jobs)}, {left_min:.0f} min left", highlight=False
                )
    if workers.trials is not None:
        for job in jobs:
            stored_trial = checkpoint.find(digests[job.name])
            assert stored_trial is not None
            workers.trials.append(Trial(function, job, stored_trial.outcome, stored_trial.cost))
    return {job.name: checkpoint.done[job.name] for job in jobs}


def _completed(
    work: Mapping[str, Callable[[], tuple[Any, TrialCost]]], workers: Workers
) -> Iterator[tuple[str, tuple[Any, TrialCost]]]:
    """Yield name, outcome and cost of every trial as it is done."""
    if workers.ray and work:
        from experiments.common import ray_workers

        yield from ray_workers.completed(work, workers.ray, installation)
    elif workers.count > 1 and work:
        from experiments.common import local_workers

        yield from local_workers.completed(work, workers.count)
    else:
        keep_memory()
        yield from ((name, do()) for name, do in work.items())


def _named(function: Callable[[Job], Any], job: Job) -> Any:
    try:
        return function(job)
    except BaseException as error:
        error.add_note(f"in trial {job.name}")
        raise
