"""The navigation experiment: two methods, three grounds, six starts, two laps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, sampled_unless_given
from experiments.common.workers import Trial
from experiments.common.worlds import CarrierPose, carrier_profile, profile_named
from experiments.navigation.metrics import CONCLUSION, GROUNDS, INTRODUCTION, LAP, METRICS, PAPER, SECTIONS, gather
from experiments.navigation.plots import draw
from experiments.navigation.trial import perform

TRIALS: Final = 1
"""Individual machines; each makes 36 drives of five minutes."""
LAPS: Final = 2
CORNERS: Final = ((15.0, -10.0), (15.0, 10.0), (-15.0, 10.0), (-15.0, -10.0))
"""Waypoints in the field [m east, north], 5 m from its edges, in driving order."""
STARTS: Final = (
    (-12.0, -10.0, 0.0),
    (-4.0, -14.0, 20.0),
    (-17.0, -1.0, -70.0),
    (0.0, 1.0, -20.0),
    (-13.0, -7.0, 95.0),
    (-11.0, -3.0, 180.0),
)
"""Front axle [m east, north] and direction [deg from east, + left]."""
QUICK_START: Final = (4.0, -10.0, 0.0)
METHODS: Final = ("faithful", "ours")
FIRST_SEED: Final = 7000
SEEDS_PER_RUN: Final = 100


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    name, truth = carrier_profile(options.profile), sampled_unless_given(options.truth)
    carrier = profile_named(name).carrier
    assert carrier is not None
    check_truth(name, truth)
    trials = 1 if options.quick else options.trials or TRIALS
    points = list(CORNERS[:2]) if options.quick else list(CORNERS) * LAPS
    jobs = plan(options, name, truth, trials, points)
    with checkpoint(options, (), [name], truth, LOCKSTEP_SOURCES) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "navigation drives", console)
        result = make_result(
            "navigation",
            METRICS,
            gather(outcomes, points, carrier, LAP),
            profile=name,
            seed=options.seed,
            trials=trials,
            more={"truth": truth},
            paper=PAPER,
        )
        draw(outcomes, points, carrier, options.out)
        publish(result, page_of(result, {}), options, console)
    return result


def failed(trial: Trial) -> bool:
    """Tell whether a drive did not arrive, or somebody had to arm again: a campaign keeps its recording."""
    return not trial.outcome["arrived"] or trial.outcome["stops"] > 0


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Navigation", CONCLUSION, INTRODUCTION, SECTIONS)


def plan(options: Options, profile: str, truth: str, trials: int, points: list[tuple[float, float]]) -> list[Job]:
    """Plan every drive, named METHOD/GROUND/TRIAL/START; both methods and all grounds use the same individuals."""
    first_seed = FIRST_SEED + options.seed * SEEDS_PER_RUN
    grounds = ("mud",) if options.quick else tuple(GROUNDS)
    starts = (QUICK_START,) if options.quick else STARTS
    job_options = {"profile": profile, "truth": truth, "points": [list(p) for p in points]}
    return [
        Job(
            f"{method}/{ground}/{trial}/{k}",
            method,
            first_seed + trial,
            job_options | {"way": method, "terrain": ground, "pose": list(_pose(start))},
        )
        for trial in range(trials)
        for ground in grounds
        for k, start in enumerate(starts)
        for method in METHODS
    ]


def _pose(start: tuple[float, float, float]) -> CarrierPose:
    return start[0], start[1], math.radians(start[2])
