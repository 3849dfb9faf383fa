"""Shared parts of the experiments: metrics and limits, Wilson intervals, the pool with its checkpoint, the page."""

from __future__ import annotations

import os

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Checkpoint, Job
from experiments.common.workers import Workers

QUIET = Console(quiet=True)


def square(job: Job) -> dict[str, int]:
    """A trial."""
    return {"square": job.seed**2, "process": os.getpid()}


def jobs(n: int) -> list[Job]:
    return [Job(f"square/{i}", "square", i, {}) for i in range(n)]


def test_the_number_of_workers_changes_nothing(tmp_path):
    outcomes = []
    for workers in (1, 2):
        with Checkpoint(tmp_path / f"{workers}.jsonl", "run") as checkpoint:
            outcomes.append(pool.run(square, jobs(7), checkpoint, Workers(workers), "trials", QUIET))
    one, two = outcomes
    assert list(one) == list(two) == [job.name for job in jobs(7)]
    assert [o["square"] for o in one.values()] == [o["square"] for o in two.values()]
    assert {o["process"] for o in one.values()} == {os.getpid()}
    assert os.getpid() not in {o["process"] for o in two.values()}
