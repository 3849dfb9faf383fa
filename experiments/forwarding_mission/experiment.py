"""The forwarding-mission experiment: paper B's trial by both methods, then on more fields, ours on other machines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, Point
from experiments.common import pool
from experiments.common.individuals import calibrated
from experiments.common.mission_trial import (
    ACROSS_M,
    ALONG_M,
    PAPER_B,
    PAPER_B_ANGLED,
    TURN_DEG,
    run_mission,
    shuffled,
)
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, evaluated, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, print_failures, sampled_unless_given
from experiments.common.workers import Trial
from experiments.common.worlds import carrier_profile, profile_named
from experiments.forwarding_mission.metrics import CM, CONCLUSION, INTRODUCTION, METRICS, PAPER, gather, sections
from experiments.forwarding_mission.plots import draw
from hil.missions.site import site_of

TRIALS: Final = 20
"""Missions on sampled machines; each takes a quarter of an hour of simulated time."""
PAPER_B_TRIALS: Final = 9
"""Missions by paper B's method besides the one on the original field."""
MACHINES: Final = 5
"""Individuals that alternate."""
FIRST_SEED: Final = 60_000
FIRST_FIELD: Final = 60_500
SEEDS_PER_RUN: Final = 1000
DETECTORS: Final = {"ours": "ours", "paper-b": "faithful"}
"""Detector of each method."""
NOMINAL: Final = "machine/nominal"
LIMIT_S: Final = 5400.0
SOURCES: Final = (*LOCKSTEP_SOURCES, "docs/examples/paper_b.geojson", "docs/examples/paper_b_angled.geojson")
PUBLISHED_TRIALS: Final = "results/forwarding-mission/trials.jsonl.xz"
"""Outcomes of all missions, in the docs."""


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    name, truth = carrier_profile(options.profile), sampled_unless_given(options.truth)
    check_truth(name, truth)
    trials = 0 if options.quick else options.trials or TRIALS
    machines = calibrations(options, name, truth, MACHINES if trials else 0)
    with checkpoint(options, (), [name], truth, SOURCES, PUBLISHED_TRIALS) as trial_store:
        outcomes = pool.run(perform, machines, trial_store, options.workers, "calibrations", console)
        jobs = [*trial(options, name, outcomes), *missions(options, name, truth, trials, outcomes)]
        outcomes |= pool.run(perform, jobs, trial_store, options.workers, "missions", console)
        result = make_result(
            "forwarding-mission",
            METRICS,
            gather(outcomes),
            profile=name,
            seed=options.seed,
            trials=trials,
            more={"truth": truth, "eyes": DETECTORS["ours"], "machines": str(max(0, len(machines) - 1))},
            paper=PAPER,
        )
        draw(outcomes, options.out)
        print_failures(outcomes, console)
        publish(result, page_of(result, outcomes), options, console)
        trial_store.publish()
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page; ``trials``: outcomes of the missions, for the error table."""
    driven = round(result.metrics.get("missions", 1.0)) - 1
    introduction = INTRODUCTION.format(
        paper_b=max(0, round(result.metrics.get("faithful.missions", 1.0)) - 1),
        driven=driven,
        machines=min(int(result.environment["machines"]), driven),
        along=CM * ALONG_M,
        across=CM * ACROSS_M,
        turn=TURN_DEG,
    )
    return Page("Forwarding mission", CONCLUSION, introduction, sections(trials))


def evaluated_again(result: Result, trials: Mapping[str, Any]) -> Result:
    """Evaluate the saved result by today's reading of its published missions; what was measured stays."""
    return evaluated(result, METRICS, gather(dict(trials)))


def failed(trial: Trial) -> bool:
    """Tell whether a mission did not end, or left a log neither in the bunk nor at a landing: a campaign records it."""
    lost = [log for log in trial.outcome.get("logs", ()) if not (log["in_bunk"] or log["landed"])]
    return trial.job.kind == "mission" and bool(lost or not trial.outcome["finished"])


def trial(options: Options, profile: str, machines: Mapping[str, Any]) -> list[Job]:
    """Plan a mission of the nominal machine on the original field by each method, and more by paper B's on others."""
    job_options: dict[str, Any] = {
        "profile": profile,
        "truth": "nominal",
        "file": str(PAPER_B_ANGLED),
        "shuffled": False,
        "short": options.quick,
        "text": machines[NOMINAL]["profile"] if NOMINAL in machines else None,
        "limit_s": LIMIT_S,
    }
    by_method = {method: {"way": method, "eyes": eyes} for method, eyes in DETECTORS.items()}
    methods = ("ours",) if options.quick else ("ours", "paper-b")
    first_missions = [
        Job(f"first/{method}", "mission", options.seed, job_options | by_method[method]) for method in methods
    ]
    first_field = FIRST_FIELD + SEEDS_PER_RUN * options.seed
    return first_missions + [
        Job(
            f"paper-b/{i}",
            "mission",
            options.seed + 1 + i,
            job_options | by_method["paper-b"] | {"shuffled": True, "field": first_field + i},
        )
        for i in range(0 if options.quick else min(PAPER_B_TRIALS, options.trials or PAPER_B_TRIALS))
    ]


def calibrations(options: Options, profile: str, truth: str, count: int) -> list[Job]:
    """List the calibration jobs of the nominal machine and the individuals; none for a quick run."""
    first_seed = FIRST_SEED + SEEDS_PER_RUN * options.seed
    job_options = {"profile": profile, "truth": truth}
    nominal = Job(NOMINAL, "calibration", options.seed, job_options | {"truth": "nominal"})
    return (
        [nominal, *(Job(f"machine/{i}", "calibration", first_seed + i, job_options) for i in range(count))]
        if count
        else []
    )


def missions(options: Options, profile: str, truth: str, trials: int, machines: Mapping[str, Any]) -> list[Job]:
    """Plan our missions on alternating individuals, each on its own field.

    The seed draws the individual; the field has a seed of its own.
    """
    first_seed = FIRST_SEED + SEEDS_PER_RUN * options.seed
    jobs = []
    for i in range(trials):
        text = machines[f"machine/{i % MACHINES}"]["profile"]
        if text is None:
            continue
        job_options: dict[str, Any] = {
            "profile": profile,
            "truth": truth,
            "file": str(PAPER_B),
            "shuffled": True,
            "text": text,
            "way": "ours",
            "eyes": DETECTORS["ours"],
            "field": first_seed + MACHINES + i,
            "limit_s": LIMIT_S,
        }
        jobs.append(Job(f"mission/{i}", "mission", first_seed + i % MACHINES, job_options))
    return jobs


SHORT_M: Final = 17.0


def perform(job: Job) -> dict[str, Any]:
    """Run a job of either kind."""
    return calibrated(job) if job.kind == "calibration" else drive(job)


def drive(job: Job) -> dict[str, Any]:
    """Drive one mission.

    ``options``: profile (shipped name), truth, way (method), eyes (detector), file (of the mission), shuffled (whether
    the logs are shifted, with the seed ``field``), short (whether only the first log is loaded), text (of the
    calibrated profile; None: as shipped), limit_s.
    """
    o = job.options
    mission = load_mission(Path(o["file"]), route_wanted=True).mission
    if o.get("short"):
        mission = short(mission)
    if o["shuffled"]:
        mission = shuffled(mission, o["field"])
    shipped = profile_named(o["profile"])
    site = site_of(mission, shipped, o.get("field", job.seed), o["truth"])
    return run_mission(job, mission, site)


def short(mission: ForwardingMission) -> ForwardingMission:
    """Shorten a mission: ``SHORT_M`` of the first leg, the first log, one lap."""
    first, second = mission.waypoints[:2]
    plane = LocalPlane(first.latitude_deg, first.longitude_deg)
    x, y, _ = plane.local(second.latitude_deg, second.longitude_deg)
    share = SHORT_M / math.hypot(x, y)
    lat, lon, _ = plane.geodetic(share * x, share * y)
    options = msgspec.structs.replace(mission.options, laps=1)
    return msgspec.structs.replace(
        mission, waypoints=(first, Point(lat, lon)), logs=mission.logs[:1], fences=(), options=options
    )
