"""The plant experiment: plans the trials, runs them on all cores, evaluates and publishes the result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result, mean, rate
from experiments.common.result_page import Page, publish
from experiments.common.trials import check_truth, checkpoint
from experiments.common.worlds import carrier_profile, profile_named
from experiments.plant import bench, grasps, runs
from experiments.plant.metrics import CONCLUSION, INTRODUCTION, METRICS, SECTIONS
from experiments.plant.plots import draw

TRIALS: Final = 200
QUICK_TRIALS: Final = 2
SHIFT_S: Final = 3600.0
QUICK_SHIFT_S: Final = 30.0
SEEDS_PER_RUN: Final = 100_000

GRASPS: Final = {
    "single": {"scene": "single", "logs": 1, "across_m": 0.0, "turned_rad": 0.0, "unload": True},
    "pile3": {"scene": "pile", "logs": 3, "across_m": 0.0, "turned_rad": 0.0, "unload": False},
    "yaw90": {"scene": "single", "logs": 1, "across_m": 0.0, "turned_rad": math.pi / 2, "unload": False},
    "off1m": {"scene": "single", "logs": 1, "across_m": 1.0, "turned_rad": 0.0, "unload": False},
}
CRANE: Final = {
    "sag": runs.sag,
    "boom_stop": runs.boom_stop,
    "pendulum": runs.pendulum,
    "slew_stop": runs.slew_stop,
    "sharing": runs.sharing,
    "cylinder": runs.cylinder,
    "left_alone": runs.left_alone,
    "falling": runs.falling,
}
CARRIER: Final = {"turning": runs.turning, "braking": runs.braking}
FUNCTIONS: Final = {"shift": runs.shift, **dict.fromkeys(GRASPS, grasps.grasp), **CRANE, **CARRIER}


def perform(job: Job) -> Any:
    """Run one job in the current process."""
    return FUNCTIONS[job.kind](job)


def plan(options: Options, trials: int) -> list[Job]:
    """Plan every job of the run, the longest first."""
    seed = options.seed * SEEDS_PER_RUN
    common = {"profile": options.profile, "truth": options.truth, "quick": options.quick}
    shift_s = QUICK_SHIFT_S if options.quick else SHIFT_S
    jobs = [Job("shift", "shift", seed, {**common, "seconds": shift_s})]
    jobs += [Job(kind, kind, seed, common) for kind in CRANE]
    # A truth file belongs to one machine; with a fixed crane's file the carrier uses the shipped truth.
    other = carrier_profile(options.profile)
    same = other == options.profile or options.truth in ("nominal", "sampled")
    under = {**common, "profile": other, "truth": options.truth if same else "nominal"}
    jobs += [Job(kind, kind, seed, under) for kind in CARRIER]
    jobs += [
        Job(f"{kind}/{i}", kind, seed + i, {**common, **grasp_options})
        for i in range(trials)
        for kind, grasp_options in GRASPS.items()
    ]
    return jobs


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file or a scene cannot be used.
    """
    check_truth(options.profile, options.truth)
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    jobs = plan(options, trials)
    with checkpoint(options, (), [options.profile], options.truth) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "plant trials", console)
        metrics, traces = gather(outcomes)
        speed, noisy, costs = bench.measure(options.profile, options.truth, options.quick, console)
        metrics |= speed
        traces |= costs
        result = make_result(
            "plant",
            METRICS,
            metrics,
            profile=profile_named(options.profile).name,
            seed=options.seed,
            trials=trials,
            more={"truth": options.truth},
            noisy=noisy,
        )
        draw(metrics, traces, options.out)
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Plant experiment", CONCLUSION, INTRODUCTION, SECTIONS)


def gather(outcomes: dict[str, Any]) -> tuple[dict[str, float], dict[str, Any]]:
    """Gather the metrics and traces of all jobs."""
    by_kind: dict[str, list[Any]] = {}
    for name, outcome in outcomes.items():
        by_kind.setdefault(name.split("/")[0], []).append(outcome)
    metrics: dict[str, float] = {}
    traces: dict[str, Any] = {}
    for kind in ("shift", *CRANE, *CARRIER):
        metrics |= by_kind[kind][0]["metrics"]
        traces |= by_kind[kind][0].get("traces", {})
    single, pile, yaw90, off1m = (by_kind[kind] for kind in GRASPS)
    lifted = [t for t in single if t["held"] == 1]
    metrics |= rate("single_success", len(lifted), len(single))
    metrics |= rate("pile3_success", sum(t["held"] == 3 for t in pile), len(pile))
    metrics |= rate("pile3_any", sum(t["held"] > 0 for t in pile), len(pile))
    metrics |= rate("unload_success", sum(t["in_bunk"] for t in lifted), len(lifted))
    metrics |= rate("yaw90_lifted", sum(t["raised"] > 0 for t in yaw90), len(yaw90))
    metrics |= rate("off1m_lifted", sum(t["raised"] > 0 for t in off1m), len(off1m))
    good = [t for t in (*single, *pile) if t["held"]]
    wrong = [*yaw90, *off1m]
    metrics |= {
        "penetration_max_m": max((t["penetration_m"] for t in good), default=math.nan),
        "penetration_wrong_max_m": max(t["penetration_m"] for t in wrong),
        "log_speed_max_m_s": max((t["log_speed_m_s"] for t in good), default=math.nan),
        "peak_bar_max": max(t["peak_bar"] for t in (*single, *pile)),
        "load_cell_error": mean([abs(t["load_kg"] / t["true_load_kg"] - 1.0) for t in good]),
        "grasp_energy_j": mean([t["energy_j"] for t in lifted]),
        "grasp_time_s": mean([t["time_s"] for t in lifted]),
    }
    traces["good"] = [[t["penetration_m"], t["log_speed_m_s"], t["true_load_kg"], t["load_kg"]] for t in good]
    return metrics, traces
