"""The productivity experiment: single logs, piles, and unloading at a landing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, print_failures
from experiments.common.workers import Trial
from experiments.common.worlds import carrier_profile, profile_named
from experiments.productivity.metrics import CONCLUSION, INTRODUCTION, METRICS, gather, sections
from experiments.productivity.plots import draw
from experiments.productivity.trial import perform

TRIALS: Final = 1
"""Runs of each task."""
AMOUNTS: Final = {"singles": 12, "piles": 5, "landing": 24}
"""Number of single logs, piles, and logs in the bunk."""
QUICK: Final = {"singles": 1}
FIRST_SEED: Final = 70_000
SEEDS_PER_RUN: Final = 1000
LIMIT_S: Final = 3600.0


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    name = carrier_profile(options.profile)
    check_truth(name, options.truth)
    grapple = profile_named(name).grapple
    grapple_s = grapple.close_time_s + grapple.open_time_s
    trials = 1 if options.quick else options.trials or TRIALS
    jobs = plan(options, name, trials)
    with checkpoint(options, (), [name], options.truth, LOCKSTEP_SOURCES) as kept:
        outcomes = pool.run(perform, jobs, kept, options.workers, "runs", console)
        result = make_result(
            "productivity", METRICS, gather(outcomes, grapple_s), profile=name, seed=options.seed, trials=trials,
            more={"truth": options.truth, "eyes": "perfect"},
        )  # fmt: skip
        draw(outcomes, grapple_s, options.out)
        print_failures(outcomes, console)
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """The result page."""
    return Page("Productivity", CONCLUSION, INTRODUCTION, sections())


def failed(trial: Trial) -> bool:
    """Whether a run did not end: a campaign keeps its recording."""
    return not trial.outcome["finished"]


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
