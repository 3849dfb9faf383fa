"""What the pool itself costs: trials that only wait, by one worker and by two; other load disturbs them little."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.checkpoint import Checkpoint
from experiments.common.pool import Job
from experiments.common.workers import Trial, Workers, overhead_s

TRIALS: Final = 100
WAIT_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class PoolCost:
    """Duration of all trials [s] without the first one of each worker, and mean time between two of a worker [s]."""

    workers: int
    wall_s: float
    between_s: float
    peak_bytes: int


def waits(job: Job) -> dict[str, Any]:
    """Wait for the length of a trial and do nothing else."""
    time.sleep(WAIT_S)
    return {"number": job.seed}


def measure(workers: int, console: Console) -> PoolCost:
    """Perform the trials with so many workers."""
    trials: list[Trial] = []
    jobs = [Job(f"wait/{i}", "wait", i, {}) for i in range(TRIALS)]
    with tempfile.TemporaryDirectory() as folder, Checkpoint(Path(folder) / "trials.jsonl", "bench") as trial_store:
        pool.run(waits, jobs, trial_store, Workers(workers, trials=trials), f"trials by {workers}", console)
    costs = [t.cost for t in trials if t.cost is not None]
    begun_s = min(c.begin_s for c in costs)
    ended_s = max(c.begin_s + c.seconds for c in costs)
    return PoolCost(workers, ended_s - begun_s, overhead_s(costs), max(c.peak_bytes for c in costs))
