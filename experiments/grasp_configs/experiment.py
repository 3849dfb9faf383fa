"""Paper A's grasping attempts and more: three sources of poses and three planners, with the whole machine on the bus.

The paper made 5 attempts with each of its 12 configurations.  Here ``--trials`` is the number of attempts per
configuration with our perception and our search (default 100: 1,200 attempts).  The first 5 of each repeat the paper's
60 on the nominal machine; the others alternate between that machine and calibrated individuals.  Every other pair of
the ablation gets a twentieth of the attempts, at least 5, on the nominal machine.  ``--quick`` leaves out all of these
but paper A's chain; the page then keeps the published ones and names their commit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean, median
from types import MappingProxyType
from typing import Any, Final

from rich.console import Console

from autonomy.grasp.planners import GRASP_PLANNERS
from experiments.common import overview, plugins, pool
from experiments.common.individuals import calibrated
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, evaluated, make_result, rate
from experiments.common.result_page import Page, Section, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint, sampled_unless_given
from experiments.common.workers import Trial
from experiments.common.worlds import profile_named
from experiments.grasp_configs.grasp_categories import ALL_LOGS, PILES
from experiments.grasp_configs.metrics import CONCLUSION, INTRODUCTION, METRICS, compared, sections
from experiments.grasp_configs.plots import draw_chain, draw_table
from experiments.grasp_configs.pose_sources import CAMERA, POSE_SOURCES, TRUE
from experiments.grasp_configs.trial import NETWORKS, attempt, planner_named, weights_of
from runtime.errors import InputRefused
from sim.scenes.arrangements import CONFIGURATIONS

PAPER: Final = {"paper60_success": 59 / 60, "optimal": 48 / 59}
"""Paper A, section IV-C: the simulated trials."""
ATTEMPTS, PAPER_ATTEMPTS, SHARE = 100, 5, 20
MACHINES: Final = 5
"""Individuals that alternate with the nominal machine."""
FIRST_MACHINE: Final = 70_000
FIRST_SEED: Final = 20_000
"""These scenes were not looked at while the planner was developed (those had seeds from 7000 on)."""
PLANNERS: Final = ("search", *NETWORKS)
BEST: Final = ("ours", "search")
PAPER_CHAIN: Final = ("faithful", "cnn")
PUBLISHED_TRIALS: Final = "results/grasp-configs/trials.jsonl.xz"
"""Outcomes of all attempts, in the docs."""


def machines_of(options: Options, attempts: int) -> list[Job]:
    """List the calibration jobs of the individuals that the attempts need."""
    job_options, first_seed = (
        {"profile": options.profile, "truth": sampled_unless_given(options.truth)},
        FIRST_MACHINE + options.seed,
    )
    count = min(MACHINES, max(0, attempts - PAPER_ATTEMPTS - 1))
    return [Job(f"machine/{i}", "calibration", first_seed + i, job_options) for i in range(count)]


def jobs_of(
    options: Options,
    pairs: Sequence[tuple[str, str]],
    attempts: int,
    machines: Mapping[str, Any] = MappingProxyType({}),
    alike: bool = False,
) -> list[Job]:
    """List all attempts' jobs: ``attempts`` of each configuration for the first pair, a twentieth for the others.

    ``alike``: every pair gets all attempts, on the same scenes and machines.

    ``machines``: the calibrated individuals by the names of their jobs; without any, the nominal machine makes all.
    """
    jobs = []
    for pair in pairs:
        whole = alike or pair == pairs[0]
        count = attempts if whole else max(min(PAPER_ATTEMPTS, attempts), attempts // SHARE)
        for number in CONFIGURATIONS:
            for k in range(count):
                job_options = {"profile": options.profile, "truth": options.truth, "configuration": number}
                job_options |= {"poses": pair[0], "planner": pair[1]}
                seed = FIRST_SEED + 1000 * options.seed + k
                turn = (k - PAPER_ATTEMPTS) % (MACHINES + 1) if k >= PAPER_ATTEMPTS and whole else 0
                machine = machines.get(f"machine/{turn - 1}")
                if machine is not None and machine["profile"] is not None:
                    job_options |= {
                        "truth": sampled_unless_given(options.truth),
                        "text": machine["profile"],
                        "scene": seed,
                    }
                    seed = FIRST_MACHINE + options.seed + turn - 1
                jobs.append(Job(f"{'.'.join(pair)}/{number}/{k}", "grasp", seed, job_options))
    return jobs


def pairs_of(profile: str) -> list[tuple[str, str]]:
    """List the pairs of the ablation whose weights exist; the evaluated pair comes first, then paper A's chain.

    A machine without the camera gets true poses: what is tried then is planning, crane and grapple.
    """
    sources = POSE_SOURCES if sees(profile) else (TRUE,)
    ready = [(poses, planner) for poses in sources for planner in PLANNERS if weights_of(poses, planner)]
    first = BEST if BEST in ready else (TRUE, "search")
    return [first, *sorted((p for p in ready if p != first), key=lambda pair: pair != PAPER_CHAIN)]


def sees(profile: str) -> bool:
    """Tell whether the machine has the camera that detects the logs."""
    return CAMERA in profile_named(profile).cameras


def gather(outcomes: dict[str, dict[str, Any]], first: tuple[str, str]) -> dict[str, float]:
    """Compute the metrics of every pair with its name as prefix, and of the evaluated pair without a prefix."""
    by_pair: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for name, o in outcomes.items():
        if name.startswith("machine/"):
            continue
        pair, _, k = name.split("/")
        by_pair.setdefault(pair, []).append((int(k), o))
    machines = [o for name, o in outcomes.items() if name.startswith("machine/")]
    metrics = {"uncalibrated": float(sum(m["profile"] is None for m in machines))}
    for pair, trials in by_pair.items():
        own = of_trials([o for _, o in trials], f"{pair}.")
        metrics |= own
        if pair == ".".join(first):
            metrics |= of_trials([o for _, o in trials], "")
            sixty = [at_first(o) for k, o in trials if k < PAPER_ATTEMPTS]
            metrics |= rate("paper60_success", sum(sixty), len(sixty))
            metrics["success_wilson_low"] = metrics["success_low"]
            for kind, sampled in (("nominal", False), ("individuals", True)):
                hits = [succeeded(o) for _, o in trials if o["individual"] is sampled]
                metrics |= rate(f"{kind}.success", sum(hits), len(hits)) if hits else {}
            metrics["stopped"] = float(sum(o["stops"] > 0 for _, o in trials))
            for number in CONFIGURATIONS:
                its = [o for _, o in trials if o["configuration"] == number]
                metrics |= rate(f"config{number}.success", sum(succeeded(o) for o in its), len(its))
                metrics[f"config{number}.first"] = _mean([float(at_first(o)) for o in its])
                metrics[f"config{number}.optimal"] = _share(its, "optimal")
                metrics[f"config{number}.logs"] = _mean([o["lifted"] for o in its])
    return metrics


def succeeded(outcome: Mapping[str, Any]) -> bool:
    """Tell whether at least one log was lifted and nobody had to arm again: a stop that needs a person is a failure."""
    return outcome["lifted"] > 0 and not outcome["stops"]


def at_first(outcome: Mapping[str, Any]) -> bool:
    """Tell whether the first closing of the jaws lifted at least one log, as the paper counts: one plan and closing."""
    return succeeded(outcome) and bool(outcome["closings"] == 1)


def failed(trial: Trial) -> bool:
    """Tell whether an attempt failed: a campaign keeps its recording."""
    return trial.job.kind == "grasp" and not succeeded(trial.outcome)


def evaluated_again(result: Result, trials: Mapping[str, Any]) -> Result:
    """Evaluate the saved result by today's reading of its published attempts; what was measured stays."""
    poses, planner = result.environment["judged"].split(" poses, ")
    return evaluated(result, METRICS, result.metrics | gather(dict(trials), (poses, planner)))


def of_trials(trials: Sequence[dict[str, Any]], prefix: str) -> dict[str, float]:
    """Compute success, share of optimal grasps, logs per grasp, and times of some trials."""
    up = [o for o in trials if at_first(o)]
    piles = [o["lifted"] for o in trials if o["configuration"] in PILES]
    all_of = [o["lifted"] == o["logs"] for o in trials if o["configuration"] in ALL_LOGS]
    planned = [o for o in trials if math.isfinite(o["plan_ms"])]
    return {
        **rate(f"{prefix}success", sum(map(succeeded, trials)), len(trials)),
        **rate(f"{prefix}first_closing", len(up), len(trials)),
        **rate(f"{prefix}optimal", sum(o["category"] == "optimal" for o in up), len(up)),
        **{f"{prefix}{c.lower()}": float(sum(o["category"] == c for o in up)) for c in ("NI", "SE", "MA")},
        f"{prefix}logs_per_grasp_10_12": _mean(piles),
        f"{prefix}all_logs": _mean([float(a) for a in all_of]),
        f"{prefix}plan_ms": _median([o["see_ms"] + o["plan_ms"] for o in planned]),
        f"{prefix}perceive_ms": _median([o["see_ms"] for o in trials]),
        f"{prefix}choose_ms": _median([o["plan_ms"] for o in planned]),
    }


def published_ablation(docs: Path | None, measured_pairs: Collection[tuple[str, str]]) -> tuple[dict[str, float], str]:
    """Read the published metrics of the other pairs and their commit; ({}, "") without any."""
    saved = None if docs is None else overview.results_in(docs).get("grasp-configs")
    if saved is None:
        return {}, ""
    pairs = {".".join(pair) for pair in product(POSE_SOURCES, PLANNERS) if pair not in measured_pairs}
    pair_metrics = {name: value for name, value in saved.metrics.items() if name.rpartition(".")[0] in pairs}
    return pair_metrics, saved.environment.get("ablation", saved.commit) if pair_metrics else ""


def _share(trials: Sequence[dict[str, Any]], category: str) -> float:
    up = [o for o in trials if at_first(o)]
    return _mean([float(o["category"] == category) for o in up])


def _median(values: Sequence[float]) -> float:
    return median(values) if values else math.nan


def _mean(values: Sequence[float]) -> float:
    return fmean(values) if values else math.nan


def run(options: Options, console: Console) -> Result:
    """Run all attempts; write ``options.out`` and, if requested, the docs.

    Raises:
        InputRefused: a foreign planner or detector cannot be used.
    """
    if options.planner or options.detector:
        return compare(options, console)
    pairs = pairs_of(options.profile)
    attempts = options.trials or (1 if options.quick else ATTEMPTS)
    calibrations = machines_of(options, attempts)
    with checkpoint(options, (), [options.profile], options.truth, LOCKSTEP_SOURCES, PUBLISHED_TRIALS) as trial_store:
        machines = pool.run(calibrated, calibrations, trial_store, options.workers, "calibrations", console)
        measured = [pair for pair in pairs if pair in (pairs[0], PAPER_CHAIN)] if options.quick else pairs
        jobs = jobs_of(options, measured, attempts, machines)
        outcomes = machines | pool.run(attempt, jobs, trial_store, options.workers, "grasping attempts", console)
        saved_metrics, since = published_ablation(options.docs, measured) if options.quick else ({}, "")
        more = {"truth": options.truth, "judged": " poses, ".join(pairs[0])} | ({"ablation": since} if since else {})
        result = make_result(
            "grasp-configs",
            METRICS,
            saved_metrics | gather(outcomes, pairs[0]),
            profile=options.profile,
            seed=options.seed,
            trials=len(jobs),
            more=more,
            paper=PAPER,
        )
        if sees(options.profile):
            draw_chain(options.out / "chain.png", options.profile, options.truth, FIRST_SEED)
        draw_table(options.out / "configurations.png", outcomes, ".".join(pairs[0]))
        _print_failures(outcomes, ".".join(pairs[0]), console)
        publish(result, page_of(result, {}), options, console)
        trial_store.publish()
    return result


def compare(options: Options, console: Console) -> Result:
    """Compare a foreign planner or detector with ours on the same attempts; the limits are for ours, and judge neither.

    Raises:
        InputRefused: there is no such planner or detector, or a page is asked for, which is that of ours.
    """
    if options.detector and not sees(options.profile):
        raise InputRefused(
            "grasp-configs.no-camera",
            f"{options.profile} has no camera {CAMERA!r} for a detector; leave out --detector",
        )
    ours = pairs_of(options.profile)[0]
    foreign = (options.detector or ours[0], options.planner or ours[1])
    if options.docs is not None:
        raise InputRefused("plugin.no-page", "the page shows our own methods: leave out --docs")
    if options.planner:
        planner_named(options.planner)
    if options.detector and options.detector not in POSE_SOURCES:
        plugins.load(plugins.LOG_DETECTORS, options.detector)
    besides = plugins.identity(GRASP_PLANNERS, options.planner)
    besides += plugins.identity(plugins.LOG_DETECTORS, options.detector)
    attempts = options.trials or (1 if options.quick else PAPER_ATTEMPTS)
    with checkpoint(options, besides, [options.profile], options.truth, LOCKSTEP_SOURCES) as trial_store:
        machines = pool.run(
            calibrated, machines_of(options, attempts), trial_store, options.workers, "calibrations", console
        )
        jobs = jobs_of(options, (foreign, ours), attempts, machines, alike=True)
        outcomes = pool.run(attempt, jobs, trial_store, options.workers, "grasping attempts", console)
        metrics = gather(outcomes, foreign)
        shown_metrics = [m for pair in (foreign, ours) for m in compared(*pair)]
        result = make_result(
            "grasp-configs",
            shown_metrics,
            metrics,
            profile=options.profile,
            seed=options.seed,
            trials=len(jobs),
            more={"truth": options.truth, "judged": " poses, ".join(foreign)},
            paper=PAPER,
        )
        publish(
            result,
            Page("A foreign method", (), "", (Section("Foreign and ours", "", tuple(shown_metrics)),)),
            options,
            console,
        )
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    since = result.environment.get("ablation", "")
    return Page("Grasping logs in twelve configurations", CONCLUSION, INTRODUCTION, sections(since))


def _print_failures(outcomes: dict[str, dict[str, Any]], pair: str, console: Console) -> None:
    for name, o in outcomes.items():
        if name.startswith(f"{pair}/") and o["category"] == "failed":
            console.print(f"{name}: {o['failure'] or o['reason']}", highlight=False, soft_wrap=True)
