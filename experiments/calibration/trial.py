"""One calibration of one individual machine in lockstep, compared with the hidden ground truth."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from autonomy.calibration.plan import CalibrationPlan
from autonomy.calibration.profile_file import profile_changes, write_profile
from autonomy.calibration.result import CalibrationResult, JointResult, identify
from autonomy.calibration.survey import OFFSETS
from autonomy.calibration.turn_fit import TurnFit
from controller.guard.__main__ import profile_path
from experiments.calibration.rotator import turn_errors
from experiments.calibration.tip import tip_errors
from experiments.common.pool import Job
from experiments.common.worlds import profile_named, trial_world
from hil.calibration.crane import run_lockstep
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from sim.world import STEP_S

TESTED_SPOOL: Final = 0.45
"""Spool at which the plant's own speed is measured: transients are short, and every joint has enough travel."""
REST_S, RUN_S, TIMED_S = 0.2, 2.0, 1.0


def calibrated(job: Job) -> dict[str, Any]:
    """Run a calibration; options: profile, truth.  Outcome: errors of all identified values, or the reason in
    ``failure``.
    """
    name, truth_name = job.options["profile"], job.options["truth"]
    profile = profile_named(name)
    outcome = run_lockstep(name, truth_name, job.seed, surveyed=True)
    facts: dict[str, Any] = {"seed": job.seed, "seconds": outcome.seconds, "failure": outcome.failure}
    if outcome.failure is not None or outcome.calibration is None or outcome.plan is None:
        return facts
    result = identify(profile, outcome.calibration.found)
    with trial_world(name, truth_name, job.seed) as world:
        truth = world.truth
    joints = {}
    for j, r in result.joints.items():
        joints[j.name.lower()] = _joint_errors(job, profile, outcome.plan, truth, j, r)
    found = {
        **facts,
        "implausible": [problem.sentence for problem in result.implausible],
        "joints": joints,
        **_survey_errors(truth, result),
    }
    if result.implausible:
        return found
    with TemporaryDirectory() as folder:
        out = Path(folder) / "calibrated.toml"
        write_profile(profile_path(name), out, profile_changes(profile, result), "today")
        if result.turns is not None:
            found["rotator"] = _rotator_errors(job, profile, truth, result.turns, out)
        return {**found, "tip": tip_errors(job, profile, load_profile(out))}


def _rotator_errors(job: Job, profile: Profile, truth: Any, turns: TurnFit, calibrated: Path) -> dict[str, Any]:
    """Errors of a rotator without an encoder against its true valve, and of commanded quarter turns."""
    valve, known = truth.functions["rot"].valve, profile.joints["rot"].valve
    deadbands, fulls = (valve.deadband_plus, valve.deadband_minus), (valve.full_speed_plus, valve.full_speed_minus)
    sides = (turns.plus, turns.minus)
    before = ((known.deadband_plus_pct, known.full_speed_plus), (known.deadband_minus_pct, known.full_speed_minus))
    return {
        "deadband_pct": [100.0 * (s.deadband - true) for s, true in zip(sides, deadbands, strict=True)],
        "gain": [s.full_speed / true - 1.0 for s, true in zip(sides, fulls, strict=True)],
        "quarter": turn_errors(job, calibrated),
        "profile": {
            "deadband_pct": [pct - 100.0 * true for (pct, _), true in zip(before, deadbands, strict=True)],
            "gain": [full / true - 1.0 for (_, full), true in zip(before, fulls, strict=True)],
            "quarter": turn_errors(job, Path(profile_path(job.options["profile"]))),
        },
    }


def _joint_errors(
    job: Job, profile: Profile, plan: CalibrationPlan, truth: Any, which: Joint, r: JointResult
) -> dict[str, Any]:
    valve = truth.functions[which.name.lower()].valve
    real = [real_full_speed(job, profile, plan, valve, which, side, r.valve.at) for side in (+1, -1)]
    return {
        "deadband_pct": [
            100.0 * (found - true)
            for found, true in zip(r.valve.deadbands, (valve.deadband_plus, valve.deadband_minus), strict=True)
        ],
        "hysteresis_pct": 100.0 * (r.valve.hysteresis - valve.hysteresis),
        "gain": [found / true - 1.0 for found, true in zip(r.valve.full_speeds, real, strict=True)],
        "delay_ms": math.nan if r.delay is None else 1e3 * (r.delay.delay_s - valve.delay_s),
        "repeat_pct": [100.0 * x for x in r.repeats],
        "residual": r.valve.residual,
        "response_s": list(r.responses_s),
        "profile": _profile_errors(profile, valve, which, real),
    }


def _profile_errors(profile: Profile, valve: Any, which: Joint, real: list[float]) -> dict[str, list[float]]:
    """Errors of the profile before calibration."""
    known = profile.joints[which.name.lower()].valve
    return {
        "deadband_pct": [
            known.deadband_plus_pct - 100.0 * valve.deadband_plus,
            known.deadband_minus_pct - 100.0 * valve.deadband_minus,
        ],
        "gain": [known.full_speed_plus / real[0] - 1.0, known.full_speed_minus / real[1] - 1.0],
        "delay_ms": [1e3 * (known.delay_s - valve.delay_s)],
    }


def real_full_speed(
    job: Job, profile: Profile, plan: CalibrationPlan, valve: Any, which: Joint, side: int, at: float
) -> float:
    """Full speed of the plant where the calibration states it, measured without bus, controller and sensors.

    The plant is driven past that place with a constant spool and timed; the true metering curve converts the speed to
    full spool.  A load that pushes the joint is included, as on a machine.
    """
    name = which.name.lower()
    deadband = valve.deadband_plus if side > 0 else valve.deadband_minus
    half = valve.hysteresis / 2.0
    share = ((TESTED_SPOOL - half - deadband) / (1.0 - half - deadband)) ** valve.exponent
    guess = share * (valve.full_speed_plus if side > 0 else valve.full_speed_minus)
    spec = profile.joints[name]
    pose = next(p.pose for p in plan.joints if p.joint is which)
    home = {j.name.lower(): float(q) for j, q in zip(Joint, pose, strict=True)}
    begin = at - side * guess * (RUN_S + TIMED_S / 2.0 - valve.delay_s)
    home[name] = min(max(begin, spec.lower), spec.upper)
    with trial_world(job.options["profile"], job.options["truth"], job.seed, home=home) as world:
        place = world.functions.index(name)

        def run(seconds: float, spool: float) -> None:
            commands = [0.0] * len(world.functions)
            commands[place] = spool
            for _ in range(round(seconds / STEP_S)):
                world.step(commands)

        run(REST_S, 0.0)
        run(RUN_S, side * TESTED_SPOOL)
        first = world.q[name]
        run(TIMED_S, side * TESTED_SPOOL)
        return float(abs(world.q[name] - first) / TIMED_S / share)


def _survey_errors(truth: Any, result: CalibrationResult) -> dict[str, Any]:
    if result.survey is None:
        return {}
    names = [j.name.lower() for j in OFFSETS]
    zeros = {n: o - truth.encoders[n].offset for n, o in zip(names, result.survey.offsets, strict=True)}
    stiffness = truth.structure.flex_pitch_nm_rad
    return {
        "zeros": zeros,
        "give": result.survey.sag.load_rad_nm * stiffness - 1.0,
        "moments_nm": list(result.survey.moments_nm),
        "zeros_before": {n: truth.encoders[n].offset for n in names},
        "before_mm": [1e3 * d for d in result.survey.before_m],
        "after_mm": [1e3 * d for d in result.survey.after_m],
    }
