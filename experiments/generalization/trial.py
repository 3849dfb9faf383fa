"""One machine with one truth: calibrated, then some logs or a mission with what the calibration has written.

Outcome: whether a profile was written, and if not, what was said; how wrong its valves are against the truth; and for
every job whether the log lies in the bunk, whether the machine says so, its closings, stops and time.
"""

from __future__ import annotations

import io
import shutil
import tempfile
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from autonomy.calibration.profile_file import ProfileNotWritten, profile_changes, write_profile
from autonomy.calibration.result import CalibrationResult, identify
from controller.guard.__main__ import profile_path
from experiments.common.individuals import DATE
from experiments.common.pool import Job
from experiments.common.recording import RECORD
from experiments.common.worlds import profile_named
from experiments.generalization.matrix import nominal_file, write_truth
from experiments.generalization.mission import MISSION, driven
from hil.calibration.crane import run_lockstep as calibrate
from hil.demo.lockstep import run_lockstep as load_one_log
from hil.replay.recording import PROFILE_FILE
from machine.loading.beside import carry_envelope

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
        found: dict[str, Any] = {"truth": o["truth"], "seconds": outcome.seconds, "said": "", "jobs": [], "wrong": []}
        if outcome.failure is not None or outcome.calibration is None:
            return {**found, "calibrated": False, "said": outcome.failure or "no plan"}
        known = profile_named(o["profile"])
        result = identify(known, outcome.calibration.found)
        if result.implausible:
            return {**found, "calibrated": False, "said": "; ".join(p.sentence for p in result.implausible)}
        path = folder / "calibrated.toml"
        try:
            write_profile(profile_path(o["profile"]), path, profile_changes(known, result), DATE)
            carry_envelope(profile_path(o["profile"]), folder)
        except ProfileNotWritten as error:
            return {**found, "calibrated": False, "said": str(error)}
        found |= {"calibrated": True, "wrong": wrong_values(result, content)}
        if job.kind == MISSION:
            return {**found, MISSION: driven(job, truth, path.read_text(encoding="utf-8"))}
        runs = [Path(o.get(RECORD, folder)) / f"job-{k}" for k in range(o["jobs"])]
        scenes = scenes_of(job.seed, o["jobs"])
        return {
            **found,
            "jobs": [_loaded(path, truth, s, o["camera"], run) for s, run in zip(scenes, runs, strict=True)],
        }


def scenes_of(seed: int, jobs: int) -> range:
    """The seeds of a machine's scenes."""
    return range(SCENES * seed, SCENES * seed + jobs)


def _loaded(profile: Path, truth: Path, seed: int, camera: str, folder: Path) -> dict[str, Any]:
    """One log from the ground into the bunk."""
    console = Console(file=io.StringIO())
    folder.mkdir(parents=True)
    shutil.copyfile(profile, folder / PROFILE_FILE)
    summary = load_one_log(str(profile), seed, str(truth), folder, LIMIT_S, console, camera)
    return {
        "in_bunk": summary.in_bunk, "says_done": not summary.failure, "stops": summary.stops,
        "closings": summary.closings, "refused": summary.refused_setpoints, "seconds": summary.seconds,
        "said": summary.failure or summary.verdict,
    }  # fmt: skip


def wrong_values(result: CalibrationResult, truth: dict[str, Any]) -> list[str]:
    """What the written profile has wrong of the valves, in words; nobody was told."""
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
