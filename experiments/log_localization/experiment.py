"""The log-localization experiment: paper B's approaches, and single frames over angle and range."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from autonomy.networks import SHIPPED
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, sampled_unless_given
from experiments.common.worlds import carrier_profile, profile_named
from experiments.log_localization.metrics import CONCLUSION, DEGREES, INTRODUCTION, METRICS, PAPER, gather, sections
from experiments.log_localization.plots import draw, overlay
from experiments.log_localization.trial import SEGMENTERS, perform
from host.exit_codes import CommandFailed, ExitCode

TRIALS: Final = 12
QUICK_TRIALS: Final = 1
FIRST_SEED: Final = 30_000
"""These sites were not looked at while perception was developed."""
SEEDS_PER_RUN: Final = 1000
ANGLES: Final = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
QUICK_ANGLES: Final = (0.0, 90.0)
TRIALS_PER_CURVE: Final = 2


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used, or the machine has no front camera.
    """
    name, truth = carrier_profile(options.profile), sampled_unless_given(options.truth)
    profile = profile_named(name)
    if "front" not in profile.cameras:
        raise CommandFailed(
            "log-localization.no-front-camera",
            f"{name} has no camera named front; add [cameras.front] to the profile",
            ExitCode.CONFIGURATION,
        )
    check_truth(name, truth)
    masks = "network" if (SHIPPED / "logs_rgbd.onnx").exists() else "true"
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    jobs = plan(options, name, truth, trials, masks)
    with checkpoint(options, (), [name], truth, LOCKSTEP_SOURCES) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "log-localization trials", console)
        result = make_result(
            "log-localization",
            METRICS,
            gather(outcomes),
            profile=name,
            seed=options.seed,
            trials=trials,
            more={"truth": truth, "masks": masks},
            paper=PAPER,
        )
        draw(outcomes, options.out)
        overlay(profile, truth, jobs[0].seed, SEGMENTERS[masks], options.out / "overlay.png")
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Log localization", CONCLUSION, INTRODUCTION, sections(result.environment["masks"]))


def plan(options: Options, profile: str, truth: str, trials: int, masks: str) -> list[Job]:
    """Plan every job of the run."""
    first_seed = FIRST_SEED + options.seed * SEEDS_PER_RUN
    job_options = {"profile": profile, "truth": truth, "masks": masks}
    jobs = [
        Job(f"approach/{d}/{i}", "approach", first_seed + i, job_options | {"degrees": float(d)})
        for i in range(trials)
        for d in DEGREES
    ]
    curves = range(max(1, trials // TRIALS_PER_CURVE))
    angles = QUICK_ANGLES if options.quick else ANGLES
    return jobs + [
        Job(f"curve/{a:g}/{i}", "curve", first_seed + i, job_options | {"degrees": a}) for i in curves for a in angles
    ]
