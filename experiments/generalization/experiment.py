"""Does it work in a world that it has never seen?  Truths at both ends of every parameter, then all drawn.

``--trials`` is the number of drawn machines, and of missions, at most `MISSIONS`; every end is one machine.
``--quick``: the combination of late and wide valves, one drawn machine and one short mission.
"""

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
from experiments.common.worlds import carrier_profile, profile_named
from experiments.generalization.matrix import COMBINED, DRAWN, UNSEEN, names, nominal_file
from experiments.generalization.metrics import (
    CONCLUSION,
    INTRODUCTION,
    OVERALL,
    gather,
    of_truth,
    sections,
    sentences,
    succeeded,
)
from experiments.generalization.mission import MISSION
from experiments.generalization.plots import draw
from experiments.generalization.trial import tried

DRAWN_MACHINES: Final = 20
JOBS: Final = 3
"""Logs that every calibrated machine loads."""
MISSIONS: Final = 20
MISSION_LOGS: Final = 8
FIRST_SEED: Final = 96_000
SEEDS_PER_RUN: Final = 1000
FIRST_MISSION: Final = 500
"""Missions have seeds of their own from here on, so that their machines do not depend on the number of drawn ones."""
CAMERA: Final = "stick"
"""Detects the logs where the machine has it; elsewhere the plant reports them."""


def jobs_of(options: Options) -> list[Job]:
    """One trial for every truth; missions are of the shipped forwarder where the profile does not drive."""
    drawn = options.trials if options.trials is not None else DRAWN_MACHINES
    truths = [*COMBINED, f"{DRAWN}-0"] if options.quick else names(drawn)
    camera = CAMERA if CAMERA in profile_named(options.profile).cameras else ""
    first = FIRST_SEED + SEEDS_PER_RUN * options.seed
    nominal_file(options.profile, options.truth)  # refused now, and not in every trial
    common = {
        "profile": options.profile,
        "around": options.truth,
        "camera": camera,
        "jobs": 1 if options.quick else JOBS,
    }
    jobs = [Job(t, "generalization", first + i, {**common, "truth": t}) for i, t in enumerate(truths)]
    driver = carrier_profile(options.profile)
    around = options.truth if driver == options.profile else "nominal"
    unseen = {"profile": driver, "around": around, "logs": 1 if options.quick else MISSION_LOGS}
    count = 1 if options.quick else min(drawn, MISSIONS)
    names_of_missions = [f"{UNSEEN}-{i}" for i in range(count)]
    first += FIRST_MISSION
    return jobs + [Job(n, MISSION, first + i, {**unseen, "truth": n}) for i, n in enumerate(names_of_missions)]


def run(options: Options, console: Console) -> Result:
    """Try every truth; write ``options.out`` and, if requested, the docs."""
    jobs = jobs_of(options)
    truths = [job.name for job in jobs]
    with checkpoint(options, (), [options.profile], options.truth, LOCKSTEP_SOURCES) as kept:
        outcomes = pool.run(tried, jobs, kept, options.workers, "machines", console)
        for name, outcome in outcomes.items():
            for sentence in sentences(outcome):
                console.print(f"{name}: {sentence}", highlight=False)
        metrics = gather(list(outcomes.values()))
        draw(options.out / "truths.png", truths, metrics)
        result = make_result(
            "generalization", (*OVERALL, *(m for t in truths for m in of_truth(t))), metrics,
            profile=profile_named(options.profile).name, seed=options.seed, trials=len(jobs),
            more={"judged": f"{jobs[0].options['camera'] or 'true'} poses; on missions the machine's own cameras"},
        )  # fmt: skip
        publish(result, page_of(result, outcomes), options, console)
    return result


def failed(trial: Trial) -> bool:
    """Whether a calibrated machine left a log outside the bunk or needed a person: a campaign records its jobs."""
    mission = trial.outcome.get(MISSION)
    driven = mission is None or (mission["in_bunk"] == mission["logs"] and not mission["stops"])
    return not (driven and all(map(succeeded, trial.outcome["jobs"])))


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """The result page."""
    truths = [key.removesuffix(".calibrated") for key in result.metrics if key.endswith(".calibrated")]
    return Page("A world it has never seen", CONCLUSION, INTRODUCTION, sections(truths))
