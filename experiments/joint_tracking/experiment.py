"""The joint-tracking experiment: plans the trials, runs them on all cores, evaluates and publishes the result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import check_truth, checkpoint, sampled_unless_given
from experiments.common.worlds import profile_named
from experiments.joint_tracking.individuals import CORNERS
from experiments.joint_tracking.metrics import BASELINES, INTRODUCTION, LAWS, MACHINES, SLIDING, conclusion, sections
from experiments.joint_tracking.plots import draw
from experiments.joint_tracking.trial import CHANGES, perform

TRIALS: Final = 6
QUICK_TRIALS: Final = 1
FIRST_SEED: Final = 1000
"""These machines were not looked at while the laws were tuned."""
SEEDS_PER_RUN: Final = 1000
STATES: Final = {"calibrated": True, "shipped": False}
CALIBRATED: Final = ("cycle", "steps", "ramps", "pick_up", "pump", "dip", "wide", "corner", "matched")
SHIPPED: Final = ("cycle", "wide", "corner")
QUICK_CORNERS: Final = (7,)
TRACED: Final = "aoro"
COUNTED: Final = ("diverged", "alarms")
WORST: Final = ("rest_m", "settle_s", "wobble_m", "tip_peak_m")


def machines(options: Options) -> dict[str, str]:
    """Choose profiles by short name; a profile given by the caller replaces the shipped one of its kind."""
    kind = "palms" if profile_named(options.profile).carrier is None else "aoro"
    return {**MACHINES, kind: options.profile}


def plan(options: Options, trials: int) -> list[Job]:
    """Plan every job of the run."""
    first_seed = FIRST_SEED + options.seed * SEEDS_PER_RUN
    numbers = {
        "corner": QUICK_CORNERS if options.quick else range(len(CORNERS)),
        "matched": range(len(CHANGES) * trials),
    }
    jobs = []
    for short, profile in machines(options).items():
        # Unless the caller gives a truth, every trial is another individual: one machine says little about a law.
        same = profile == options.profile and options.truth not in ("nominal", "sampled")
        common_options = {"profile": profile, "truth": options.truth if same else "sampled"}
        for (state, calibrated), law in product(STATES.items(), LAWS):
            kinds: tuple[str, ...] = CALIBRATED if calibrated else SHIPPED
            if options.quick and law != own_law(profile):
                kinds = ("cycle",) if calibrated else ()
            for kind in kinds:
                for i in numbers.get(kind, range(trials)):
                    job_options: dict[str, Any] = {"corner": i} if kind == "corner" else {}
                    if kind == "matched":
                        job_options |= {"change": list(CHANGES)[i % len(CHANGES)]}
                    if short == TRACED and kind == "cycle" and calibrated and i == 0:
                        job_options["trace"] = True
                    job_options |= {**common_options, "law": law, "calibrated": calibrated}
                    jobs.append(Job(f"{short}/{law}/{state}/{kind}/{i}", kind, first_seed + i, job_options))
        for i in range(trials):
            job_options = {"trace": True} if short == TRACED and i == 0 else {}
            job_options |= {**common_options, "law": own_law(profile), "calibrated": True}
            jobs.append(Job(f"{short}/stop/{i}", "stop", first_seed + i, job_options))
    return jobs


def own_law(profile: str) -> str:
    """Name the law of the slew of a profile, which represents all joints."""
    return profile_named(profile).joints["slew"].law.kind


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    check_truth(options.profile, options.truth)
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    jobs = plan(options, trials)
    profiles = machines(options)
    with checkpoint(options, (), profiles.values(), options.truth, ["controller"]) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "joint-tracking trials", console)
        metrics = gather(outcomes)
        result = make_result(
            "joint-tracking",
            [m for s in sections(laws_of(profiles), metrics) for m in s.metrics],
            metrics,
            profile=", ".join(profiles.values()),
            seed=options.seed,
            trials=trials,
            more={"truth": sampled_unless_given(options.truth)},
        )
        draw(metrics, outcomes, profiles, options.out)
        publish(result, page_of(result, {}), options, console)
    return result


def laws_of(profiles: Mapping[str, str]) -> dict[str, str]:
    """Name the law of each profile, by the short name of its machine."""
    return {short: own_law(profile) for short, profile in profiles.items()}


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    profiles = dict(zip(MACHINES, result.profile.split(", "), strict=True))
    laws = laws_of(profiles)
    return Page("Joint control laws", conclusion(laws), INTRODUCTION, sections(laws, result.metrics))


def gather(outcomes: Mapping[str, Any]) -> dict[str, float]:
    """Compute the means over the trials of each kind; machine, law, state and scenario are in the name.

    Some metrics also have their worst value.  Over all trials of a law: the share of valves closed and of motions that
    did not settle in each state, and how many of its machines with twice the spread diverged.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for name, outcome in outcomes.items():
        groups.setdefault("_".join(name.split("/")[:-1]), []).append(outcome)
    metrics: dict[str, float] = {}
    for group, trials in groups.items():
        for key in trials[0]:
            if key == "trace":
                continue
            values = [v for t in trials for v in (t[key] if isinstance(t[key], list) else [t[key]])]
            metrics[f"{group}_{key}"] = float(sum(values)) if key in COUNTED else sum(values) / len(values)
            if key in WORST:
                metrics[f"{group}_{key}_max"] = float(max(values))
    metrics |= _compared(metrics)
    return {k: v for k, v in (metrics | _over_all(outcomes)).items() if not math.isnan(v)}


def _compared(metrics: Mapping[str, float]) -> dict[str, float]:
    """Compare the sliding mode with the best PD or PID law: tracking error and chatter, undisturbed and changed."""
    ratios: dict[str, float] = {}
    for short, kind in product(MACHINES, ("cycle", "matched")):
        names = {law: f"{short}_{law}_calibrated_{kind}" for law in (*BASELINES, SLIDING)}
        if all(f"{name}_tip_rms_m" in metrics for name in names.values()):
            best = min(BASELINES, key=lambda law: metrics[f"{names[law]}_tip_rms_m"])
            for key, label in (("tip_rms_m", "rms"), ("chatter_pct_s", "chatter")):
                ratio = metrics[f"{names[SLIDING]}_{key}"] / metrics[f"{names[best]}_{key}"]
                ratios[f"{short}_{kind}_{label}_ratio"] = ratio
    return ratios


def _over_all(outcomes: Mapping[str, Any]) -> dict[str, float]:
    shares: dict[str, list[float]] = {}
    totals: dict[str, float] = {}
    for name, outcome in outcomes.items():
        short, law, *rest = name.split("/")
        for key in ("shut_share", "unsettled_share"):
            if key in outcome:
                known = shares.setdefault(f"{short}_{law}_{rest[0]}_{key}", [])
                known += [] if math.isnan(outcome[key]) else [outcome[key]]
        if rest[1:2] in (["wide"], ["corner"]):
            for key, value in (("machines", 1.0), ("diverged", float(outcome["diverged"]))):
                totals[f"{short}_{law}_twice_{key}"] = totals.get(f"{short}_{law}_twice_{key}", 0.0) + value
    for name, outcome in outcomes.items():
        short, kind, *_ = name.split("/")
        if kind == "stop":
            for key in outcome:
                if key.endswith("_damped_ring_m"):
                    plain = outcome[key.replace("damped", "plain")]
                    for how, values in (("damped", outcome[key]), ("plain", plain)):
                        ring = f"{short}_stop_{how}"
                        totals[ring] = totals.get(ring, 0.0) + sum(values)
    for short in {name.split("/")[0] for name in outcomes}:
        if plain := totals.pop(f"{short}_stop_plain", 0.0):
            totals[f"{short}_stop_damped_over_plain"] = totals.pop(f"{short}_stop_damped") / plain
    # If no motion settles, no valve is closed after settling: this counts as 0, not as a missing metric.
    return totals | {name: sum(values) / len(values) if values else 0.0 for name, values in shares.items()}
