"""The PLC experiment: compares the PLC path with the CAN path in lockstep, with the same jobs, seeds and machines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.common.workers import Trial
from experiments.common.worlds import profile_named
from experiments.plc.metrics import CONCLUSION, INTRODUCTION, METRICS, PATHS, SECTIONS, gather
from experiments.plc.trial import perform

TRIALS: Final = 20
QUICK_TRIALS: Final = 1


def run(options: Options, console: Console) -> Result:
    """Run all trials on all paths; write ``options.out`` and, if requested, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    common = {"profile": options.profile, "truth": options.truth}
    jobs = [Job(f"{path}-{i}", path, options.seed + i, common) for i in range(trials) for path in PATHS]
    with checkpoint(options, (), [options.profile], options.truth, LOCKSTEP_SOURCES) as kept:
        outcomes = pool.run(perform, jobs, kept, options.workers, "plc trials", console)
        result = make_result(
            "plc", METRICS, gather(outcomes), profile=profile_named(options.profile).name, seed=options.seed,
            trials=trials, more={"truth": options.truth},
        )  # fmt: skip
        publish(result, page_of(result, {}), options, console)
    return result


def failed(trial: Trial) -> bool:
    """Whether the log is not in the bunk, or somebody had to arm again: a campaign keeps its recording."""
    return not trial.outcome["success"] or trial.outcome["stops"] > 0


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """The result page."""
    return Page("PLC path and CAN path", CONCLUSION, INTRODUCTION, SECTIONS)
