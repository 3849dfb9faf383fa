"""The crane-accuracy experiment: machines are calibrated, then every variant moves on them; judged, drawn, written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, judged
from experiments.common.result_page import tell
from experiments.common.trials import check_truth, checkpoint, individuals, tell_failures
from experiments.common.worlds import carrier_profile, profile_named
from experiments.crane_accuracy.metrics import FIGURES, INTRODUCTION, PAPER, SECTIONS, gather
from experiments.crane_accuracy.plan import (
    GOALS_M,
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
"""Judged on machines that nobody looked at while plans and laws were made."""
SEEDS_PER_RUN: Final = 1000
TRACED_GOAL: Final = 2
TRACED: Final = (OWN, UNSHAPED, UNCOMPENSATED)
SOURCES: Final = ("autonomy", "controller", "hil/harness/lockstep.py", "hil/calibration/crane.py", "hil/harness/operator.py")


def run(options: Options, console: Console) -> Result:
    """Measure everything; writes ``options.out`` and, when asked, the docs.

    Raises:
        Stopped: the truth file cannot be used.
    """
    name, truth = carrier_profile(options.profile), individuals(options.truth)
    check_truth(name, truth)
    machines = options.trials or (QUICK_MACHINES if options.quick else MACHINES)
    own_law = law_of(profile_named(name))
    seeds = [FIRST_SEED + SEEDS_PER_RUN * options.seed + i for i in range(machines)]
    calibrations = [
        Job(f"{i}/calibration", "calibration", s, {"profile": name, "truth": truth}) for i, s in enumerate(seeds)
    ]
    asked = (options.quick, options.repetitions)
    with checkpoint(options, (calibrations, asked, GOALS_M), [name], truth, SOURCES) as kept:
        texts = pool.run(perform, calibrations, kept, options.workers, "calibrations", console)
        jobs = motions(calibrations, texts, variants(own_law), *asked)
        outcomes = texts | pool.run(perform, jobs, kept, options.workers, "runs with motions", console)
        often = str(options.repetitions or REPETITIONS)
        result = judged(
            "crane-accuracy", FIGURES, gather(outcomes, own_law), profile=name, seed=options.seed, trials=machines,
            more={"truth": truth, "law": own_law, "repetitions": often}, paper=PAPER,
        )  # fmt: skip
        draw(outcomes, profile_named(name).kinematics, options.out)
        tell_failures(texts, console)
        words = INTRODUCTION.format(repetitions=often)
        tell(result, "Crane accuracy, measured", words, SECTIONS, options, console)
    return result


def motions(
    calibrations: list[Job], texts: Mapping[str, Any], names: tuple[str, ...], quick: bool, own: int | None
) -> list[Job]:
    """One job for every machine that has a calibrated profile, and variant, the longest first; ``own`` are the
    repetitions of the profile's own law, None for paper B's.
    """
    jobs = []
    for variant in names:
        often = own if own and variant == OWN else repetitions(variant)
        made = visits(min(often, QUICK_REPETITIONS), QUICK_GOALS) if quick else visits(often)
        pairs = [(v.goal, v.load_kg) for v in made]
        for machine in calibrations:
            text = texts[machine.name]["profile"]
            if text is None:
                continue
            what: dict[str, Any] = {
                **machine.options, "variant": variant, "visits": pairs,
                "text": None if variant == UNCALIBRATED else text,
            }  # fmt: skip
            if machine is calibrations[0] and variant in TRACED:
                what["trace"] = next((i for i, (g, load) in enumerate(pairs) if g == TRACED_GOAL and load), None)
            jobs.append(Job(machine.name.replace("calibration", variant), "motions", machine.seed, what))
    return jobs
