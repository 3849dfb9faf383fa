"""Where the trials of a run are performed, and the list of those that it performed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from experiments.common.trial_cost import TrialCost


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
