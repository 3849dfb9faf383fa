"""The crane-accuracy experiment: calibrates machines, lets every variant move on them, publishes the result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, print_failures, sampled_unless_given
from experiments.common.worlds import carrier_profile, profile_named
from experiments.crane_accuracy.metrics import CONCLUSION, INTRODUCTION, METRICS, PAPER, SECTIONS, gather
from experiments.crane_accuracy.plan import (
    OWN,
    REPETITIONS,
    UNCALIBRATED,
    UNCOMPENSATED,
    UNSHAPED,
    law_of,
    repetitions,
    variants,
    visits,
)
from experiments.crane_accuracy.plots import draw
from experiments.crane_accuracy.trial import perform

MACHINES: Final = 20
QUICK_MACHINES: Final = 1
QUICK_REPETITIONS: Final = 2
QUICK_GOALS: Final = (0, 2)
FIRST_SEED: Final = 20_000
"""These machines were not looked at while plans and laws were developed."""
SEEDS_PER_RUN: Final = 1000
TRACED_GOAL: Final = 2
TRACED: Final = (OWN, UNSHAPED, UNCOMPENSATED)


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    name, truth = carrier_profile(options.profile), sampled_unless_given(options.truth)
    check_truth(name, truth)
    machines = options.trials or (QUICK_MACHINES if options.quick else MACHINES)
    own_law = law_of(profile_named(name))
    seeds = [FIRST_SEED + SEEDS_PER_RUN * options.seed + i for i in range(machines)]
    calibrations = [
        Job(f"{i}/calibration", "calibration", s, {"profile": name, "truth": truth}) for i, s in enumerate(seeds)
    ]
    asked = (options.quick, options.repetitions)
    with checkpoint(options, (), [name], truth, LOCKSTEP_SOURCES) as trial_store:
        texts = pool.run(perform, calibrations, trial_store, options.workers, "calibrations", console)
        jobs = motions(calibrations, texts, variants(own_law), *asked)
        outcomes = texts | pool.run(perform, jobs, trial_store, options.workers, "runs with motions", console)
        repetition_count = str(options.repetitions or REPETITIONS)
        result = make_result(
            "crane-accuracy",
            METRICS,
            gather(outcomes, own_law),
            profile=name,
            seed=options.seed,
            trials=machines,
            more={"truth": truth, "law": own_law, "repetitions": repetition_count},
            paper=PAPER,
        )
        draw(outcomes, profile_named(name).kinematics, options.out)
        print_failures(texts, console)
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    introduction = INTRODUCTION.format(repetitions=result.environment["repetitions"])
    return Page("Crane accuracy", CONCLUSION, introduction, SECTIONS)


def motions(
    calibrations: list[Job], texts: Mapping[str, Any], names: tuple[str, ...], quick: bool, own: int | None
) -> list[Job]:
    """Make one job for every variant on every machine with a calibrated profile, the longest first.

    ``own``: repetitions with the law of the profile; None: as many as paper B made.
    """
    jobs = []
    for variant in names:
        repetition_count = own if own and variant == OWN else repetitions(variant)
        made = visits(min(repetition_count, QUICK_REPETITIONS), QUICK_GOALS) if quick else visits(repetition_count)
        pairs = [(v.goal, v.load_kg) for v in made]
        for machine in calibrations:
            text = texts[machine.name]["profile"]
            if text is None:
                continue
            job_options: dict[str, Any] = {
                **machine.options,
                "variant": variant,
                "visits": pairs,
                "text": None if variant == UNCALIBRATED else text,
            }
            if machine is calibrations[0] and variant in TRACED:
                job_options["trace"] = next((i for i, (g, load) in enumerate(pairs) if g == TRACED_GOAL and load), None)
            jobs.append(Job(machine.name.replace("calibration", variant), "motions", machine.seed, job_options))
    return jobs
