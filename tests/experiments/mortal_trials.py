"""Trials for tests of workers: pieces of the plant experiment, and trials whose process is killed."""

from __future__ import annotations

import os
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.common import pool
from experiments.common.campaign import line_of
from experiments.common.checkpoint import Checkpoint
from experiments.common.pool import Job
from experiments.common.workers import Workers
from experiments.plant.experiment import perform

QUIET = Console(quiet=True)
KINDS = ("sag", "pendulum", "sharing", "cylinder")
"""Kinds of the plant experiment that take about a second each."""


def plant_jobs() -> list[Job]:
    return [Job(kind, kind, 7, {"profile": "palms_471", "truth": "nominal", "quick": True}) for kind in KINDS]


def killed_once(marker: Path, job: Job) -> Any:
    """The trial; the first process that performs `pendulum` is killed, as the kernel does when memory runs out."""
    if job.name == "pendulum":
        kill_unless(marker)
    return perform(job)


def kill_unless(marker: Path) -> None:
    """Kill this process unless the marker exists, which it then does."""
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


def always_killed(job: Job) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def slow_square(job: Job) -> int:
    time.sleep(0.5)  # noqa: TID251  in the processes of a live test
    return job.seed**2


def endless(marker: Path, job: Job) -> None:
    """A trial that lasts for an hour once the marker exists."""
    marker.touch()
    time.sleep(3600.0)  # noqa: TID251  in the processes of a live test


def square_jobs(count: int) -> list[Job]:
    return [Job(f"square/{i}", "square", i, {}) for i in range(count)]


def mortal(marker: Path) -> Any:
    """`killed_once` with its marker, as a function of a job."""
    return partial(killed_once, marker)


def process_id() -> str:
    """An installation that no other process has."""
    return str(os.getpid())


def table(path: Path, function: Any, workers: Workers, jobs: list[Job]) -> bytes:
    """The outcomes of a run, line by line."""
    with Checkpoint(path, "run") as kept:
        outcomes = pool.run(function, jobs, kept, workers, "trials", QUIET)
    return "\n".join(line_of(name, outcome, ()) for name, outcome in outcomes.items()).encode()


def table_of_one_process(folder: Path) -> bytes:
    """The table of the pieces of the plant experiment."""
    return table(folder / "alone.jsonl", perform, Workers(), plant_jobs())
