"""Does it work in a world that it has never seen?  Truths at both ends of every parameter, then all drawn.

``--trials`` is the number of drawn machines, and of missions, at most `MISSIONS`; every end is one machine.
``--quick``: the combination of late and wide valves, one drawn machine and one short mission.
"""

from __future__ import annotations

import io
import math
import random
import shutil
import tempfile

# -- One machine with one truth: calibrated, then some logs or a mission with what the calibration has written.
#
# Outcome: whether a profile was written, and if not, what was said; how wrong its valves are against the truth; and
# for every job whether the log lies in the bunk, whether the machine says so, its closings, stops and time.
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from autonomy.calibration.profile_file import profile_changes, write_profile
from autonomy.calibration.result import CalibrationResult, identify
from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.model import ForwardingMission, Point
from controller.guard.__main__ import profile_path
from experiments.common import pool
from experiments.common.individuals import DATE
from experiments.common.mission_trial import run_mission
from experiments.common.pool import Job
from experiments.common.recording import RECORD
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.common.workers import Trial
from experiments.common.worlds import carrier_profile, profile_named
from experiments.generalization.matrix import (
    COMBINED,
    DRAWN,
    MISSION,
    UNSEEN,
    ground_of,
    names,
    nominal_file,
    title_of,
    write_truth,
)
from experiments.generalization.metrics import (
    CONCLUSION,
    INTRODUCTION,
    OVERALL,
    gather,
    sections,
    sentences,
    succeeded,
)
from hil.calibration import run_lockstep as calibrate
from hil.demo.lockstep import run_lockstep as load_one_log
from hil.missions.site import site_of
from hil.replay.recording import PROFILE_FILE
from machine.loading.profile_file import carry_envelope
from machine.profile import Carrier
from runtime.errors import InputRefused
from runtime.plot_style import MOSS, STEEL, sheet

LIMIT_S: Final = 180.0
SCENES: Final = 100
"""At most so many scenes of a machine: those of two machines are never the same."""
WRONG_DEADBAND: Final = 0.03
"""A dead-band in a written profile that is off by more of the stroke is wrong without a word."""
WRONG_DELAY_S: Final = 0.03


def tried(job: Job) -> dict[str, Any]:
    """Run a trial.

    Options: profile, around (the choice whose truth is changed), truth (of `matrix`), and what the calibrated machine
    does then: the kind "generalization" loads ``jobs`` single logs, seen through ``camera`` ("" for true poses), the
    kind "mission" drives one with ``logs`` logs.
    """
    o = job.options
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        truth, content = write_truth(nominal_file(o["profile"], o["around"]), o["truth"], job.seed, folder)
        outcome = calibrate(o["profile"], str(truth), job.seed, surveyed=True)
        report: dict[str, Any] = {"truth": o["truth"], "seconds": outcome.seconds, "said": "", "jobs": [], "wrong": []}
        if outcome.failure is not None or outcome.calibration is None:
            return {**report, "calibrated": False, "said": outcome.failure or "no plan"}
        known = profile_named(o["profile"])
        result = identify(known, outcome.calibration.found)
        if result.implausible:
            return {**report, "calibrated": False, "said": "; ".join(p.sentence for p in result.implausible)}
        path = folder / "calibrated.toml"
        try:
            write_profile(profile_path(o["profile"]), path, profile_changes(known, result), DATE)
            carry_envelope(profile_path(o["profile"]), folder)
        except InputRefused as error:
            return {**report, "calibrated": False, "said": str(error)}
        report |= {"calibrated": True, "wrong": wrong_values(result, content)}
        if job.kind == MISSION:
            return {**report, MISSION: driven(job, truth, path.read_text(encoding="utf-8"))}
        runs = [Path(o.get(RECORD, folder)) / f"job-{k}" for k in range(o["jobs"])]
        scenes = scenes_of(job.seed, o["jobs"])
        return {
            **report,
            "jobs": [_loaded(path, truth, s, o["camera"], run) for s, run in zip(scenes, runs, strict=True)],
        }


def scenes_of(seed: int, jobs: int) -> range:
    """Return the seeds of a machine's scenes."""
    return range(SCENES * seed, SCENES * seed + jobs)


def _loaded(profile: Path, truth: Path, seed: int, camera: str, folder: Path) -> dict[str, Any]:
    """Load one log from the ground into the bunk."""
    console = Console(file=io.StringIO())
    folder.mkdir(parents=True)
    shutil.copyfile(profile, folder / PROFILE_FILE)
    summary = load_one_log(str(profile), seed, str(truth), folder, LIMIT_S, console, camera)
    return {
        "in_bunk": summary.in_bunk,
        "says_done": not summary.failure,
        "stops": summary.stops,
        "closings": summary.closings,
        "refused": summary.refused_setpoints,
        "seconds": summary.seconds,
        "said": summary.failure or summary.verdict,
    }


def wrong_values(result: CalibrationResult, truth: dict[str, Any]) -> list[str]:
    """List what the written profile has wrong of the valves, in words; nobody was told."""
    wrong = []
    for joint, one in result.joints.items():
        name = joint.name.lower()
        valve = truth["functions"][name]["valve"]
        true = (valve["deadband_plus"], valve["deadband_minus"])
        for side, seen, real in zip(("plus", "minus"), one.valve.deadbands, true, strict=True):
            if abs(seen - real) > WRONG_DEADBAND:
                wrong.append(f"{name} {side}: dead-band {100 * seen:.1f} %, true {100 * real:.1f} %")
        if one.delay is not None and abs(one.delay.delay_s - valve["delay_s"]) > WRONG_DELAY_S:
            wrong.append(f"{name}: dead time {one.delay.delay_s:.3f} s, true {valve['delay_s']:.3f} s")
    return wrong


# -- Does it work in a world that it has never seen? Truths at both ends of every parameter, then all drawn


DRAWN_MACHINES: Final = 20
JOBS: Final = 3
"""Logs that every calibrated machine loads."""
MISSIONS: Final = 20
MISSION_LIMIT_S: Final = 3600.0
LEG_M: Final = 20.0
MOST_TURN_DEG: Final = 35.0
MISSION_LOGS: Final = 8
FIRST_SEED: Final = 96_000
SEEDS_PER_RUN: Final = 1000
FIRST_MISSION: Final = 500
"""Missions have seeds of their own from here on, so that their machines do not depend on the number of drawn ones."""
CAMERA: Final = "stick"
"""Detects the logs where the machine has it; elsewhere the plant reports them."""


def jobs_of(options: Options) -> list[Job]:
    """Make one trial for every truth; missions are of the shipped forwarder where the profile does not drive."""
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
    with checkpoint(options, (), [options.profile], options.truth, LOCKSTEP_SOURCES) as trial_store:
        outcomes = pool.run(tried, jobs, trial_store, options.workers, "machines", console)
        for name, outcome in outcomes.items():
            for sentence in sentences(outcome):
                console.print(f"{name}: {sentence}", highlight=False)
        metrics = gather(list(outcomes.values()))
        draw(options.out / "truths.png", truths, metrics)
        result = make_result(
            "generalization",
            OVERALL,
            metrics,
            profile=profile_named(options.profile).name,
            seed=options.seed,
            trials=len(jobs),
            more={"judged": f"{jobs[0].options['camera'] or 'true'} poses; on missions the machine's own cameras"},
        )
        publish(result, page_of(result, outcomes), options, console)
    return result


def failed(trial: Trial) -> bool:
    """Tell whether a calibrated machine left a log outside the bunk or needed a person: a campaign records its jobs."""
    mission = trial.outcome.get(MISSION)
    driven = mission is None or (mission["in_bunk"] == mission["logs"] and not mission["stops"])
    return not (driven and all(map(succeeded, trial.outcome["jobs"])))


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("A world it has never seen", CONCLUSION, INTRODUCTION, sections(result))


def draw(path: Path, truths: Sequence[str], metrics: Mapping[str, float]) -> None:
    """Draw a bar for every truth: the share of its logs in the bunk, hollow where no profile was written."""
    with sheet(path, 1, 8.0, 0.6 + 0.28 * len(truths)) as axis:
        for y, name in enumerate(truths):
            if metrics.get(f"{name}.calibrated", 0.0) > 0.0:
                axis.barh(y, 100.0 * metrics.get(f"{name}.success", 0.0), color=MOSS)
            else:
                axis.barh(y, 100.0, fill=False, edgecolor=STEEL, hatch="//")
        axis.set(yticks=range(len(truths)), yticklabels=[title_of(n) for n in truths], xlim=(0.0, 100.0))
        axis.set(xlabel="logs in the bunk [%]")
        axis.margins(y=0.01)
        axis.invert_yaxis()


def driven(job: Job, truth: Path, text: str) -> dict[str, Any]:
    """Drive the mission of a job with the calibrated profile ``text``; the places of its logs are not in it.

    Options: profile, truth (its number chooses the ground), logs (their number).
    """
    o = job.options
    profile = profile_named(o["profile"])
    assert profile.carrier is not None, "a mission is for a machine that drives"
    mission = drawn_mission(profile.carrier, job.seed)
    site = site_of(mission, profile, job.seed, str(truth), o["logs"], ground_of(o["truth"]))
    options = o | {"truth": str(truth), "text": text, "way": "ours", "eyes": "ours", "limit_s": MISSION_LIMIT_S}
    mission_outcome = run_mission(Job(job.name, MISSION, job.seed, options), mission, site)
    return {
        "ground": ground_of(o["truth"]),
        "logs": len(mission_outcome["logs"]),
        "believed": mission_outcome["loaded"],
        "in_bunk": sum(log["in_bunk"] for log in mission_outcome["logs"]),
        "given_up": len(mission_outcome["given_up"]),
        **{
            key: mission_outcome[key]
            for key in ("finished", "failure", "stops", "refused", "seconds", "driven_m", "remarks")
        },
    }


def drawn_mission(carrier: Carrier, seed: int) -> ForwardingMission:
    """Draw a route of two legs with a turn between them; nothing is said of the logs."""
    rng = random.Random(f"unseen route {seed}")
    plane = LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg)
    turn = math.radians(rng.uniform(-MOST_TURN_DEG, MOST_TURN_DEG))
    ends = ((0.0, 0.0), (LEG_M, 0.0), (LEG_M * (1.0 + math.cos(turn)), LEG_M * math.sin(turn)))
    return ForwardingMission("unseen", tuple(Point(*plane.geodetic(*at)[:2]) for at in ends))
