"""Where the trials of a run are performed, the list of those that it performed, and what each cost there."""

from __future__ import annotations

import os
import resource
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final


@dataclass(frozen=True, slots=True)
class Trial:
    """A finished trial: the function and the job that made its outcome, and its cost if it was measured."""

    function: Callable[[Any], Any]
    job: Any
    outcome: Any
    cost: TrialCost | None


@dataclass(frozen=True, slots=True)
class Workers:
    """Processes on this computer, or the Ray cluster at the address ``ray``.

    ``trials``: receives every trial of the run, in the order of its jobs.
    """

    count: int = 1
    ray: str = ""
    trials: list[Trial] | None = None


KIB: Final = 1024


@dataclass(frozen=True, slots=True)
class TrialCost:
    """Cost of one trial: worker (host/process), begin (UTC) and duration [s], greatest memory of its process [B]."""

    worker: str
    begin_s: float
    seconds: float
    peak_bytes: int


def measured(function: Callable[[Any], Any], job: Any) -> tuple[Any, TrialCost]:
    """Return the outcome of ``function(job)`` and its cost, measured in the process that runs it."""
    begin_s, begun_ns = time.time(), time.monotonic_ns()
    outcome = function(job)
    seconds = (time.monotonic_ns() - begun_ns) * 1e-9
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIB
    return outcome, TrialCost(f"{socket.gethostname()}/{os.getpid()}", round(begin_s, 6), round(seconds, 6), peak_bytes)


def overhead_s(costs: Sequence[TrialCost]) -> float:
    """Compute the mean time between the end of a trial and the begin of the next one on the same worker; NaN without a
    pair.

    It holds the dispatch, the way of the outcome to the disk, and what a worker waited for others.
    """
    gaps = []
    for worker in {cost.worker for cost in costs}:
        its = sorted((c for c in costs if c.worker == worker), key=lambda c: c.begin_s)
        gaps += [b.begin_s - a.begin_s - a.seconds for a, b in pairwise(its)]
    return sum(gaps) / len(gaps) if gaps else float("nan")
