"""The productivity experiment: single logs, piles, a landing; judged, drawn, told."""

from __future__ import annotations

from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.mission_trial import MISSION_SOURCES
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, judged
from experiments.common.result_page import tell
from experiments.common.trials import check_truth, checkpoint, tell_failures
from experiments.common.worlds import carrier_profile, profile_named
from experiments.productivity.metrics import FIGURES, INTRODUCTION, gather, sections
from experiments.productivity.plots import draw
from experiments.productivity.trial import perform

TRIALS: Final = 1
"""Runs of each kind."""
AMOUNTS: Final = {"singles": 12, "piles": 5, "landing": 24}
"""Single logs, piles, logs in the bunk."""
QUICK: Final = {"singles": 1}
FIRST_SEED: Final = 70_000
SEEDS_PER_RUN: Final = 1000
LIMIT_S: Final = 3600.0


def run(options: Options, console: Console) -> Result:
    """Measure everything; writes ``options.out`` and, when asked, the docs.

    Raises:
        Stopped: the truth file cannot be used.
    """
    name = carrier_profile(options.profile)
    check_truth(name, options.truth)
    grapple = profile_named(name).grapple
    tongs_s = grapple.close_time_s + grapple.open_time_s
    trials = 1 if options.quick else options.trials or TRIALS
    jobs = plan(options, name, trials)
    with checkpoint(options, jobs, [name], options.truth, MISSION_SOURCES) as kept:
        outcomes = pool.run(perform, jobs, kept, options.workers, "runs", console)
        result = judged(
            "productivity", FIGURES, gather(outcomes, tongs_s), profile=name, seed=options.seed, trials=trials,
            more={"truth": options.truth, "eyes": "perfect"},
        )  # fmt: skip
        draw(outcomes, tongs_s, options.out)
        tell_failures(outcomes, console)
        tell(result, "Productivity", INTRODUCTION, sections(), options, console)
    return result


def plan(options: Options, profile: str, trials: int) -> list[Job]:
    """Every run, named KIND/NUMBER, the longest first."""
    first = FIRST_SEED + SEEDS_PER_RUN * options.seed
    what: dict[str, Any] = {
        "profile": profile,
        "truth": options.truth,
        "way": "ours",
        "eyes": "perfect",
        "limit_s": LIMIT_S,
    }
    amounts = QUICK if options.quick else AMOUNTS
    return [
        Job(f"{kind}/{i}", kind, first + i, what | {"amount": amount})
        for i in range(trials)
        for kind, amount in amounts.items()
    ]
