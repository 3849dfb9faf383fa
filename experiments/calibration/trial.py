"""One calibration of one individual machine in lockstep, compared with the hidden ground truth."""

from __future__ import annotations

import math
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from autonomy.calibration.plan import CalibrationPlan
from autonomy.calibration.profile_file import profile_changes, write_profile
from autonomy.calibration.result import CalibrationResult, JointResult, identify
from autonomy.calibration.survey import OFFSETS
from autonomy.calibration.turn_fit import TurnFit
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, joint_motion
from can_dbc.messages.crane import GrappleCommand, OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.calibration.tip import tip_errors
from experiments.common.pool import Job
from experiments.common.worlds import profile_named, trial_world
from hil.calibration import run_lockstep
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from machine.status.modes import Mode
from runtime.errors import InputRefused
from sim.plant import Plant
from sim.world import STEP_S

# -- True angle of a rotator without an encoder when a planner commands quarter turns, with any profile of its
# machine.
#
# Controller, guard, bus and plant are those of every lockstep run; the turns go through the control laws, as a
# planner's do. The plant is built from the profile as shipped: a calibration changes the controller's profile, not
# the machine.


QUARTER_RAD: Final = pi / 2
TURNS_RAD: Final = (QUARTER_RAD, 0.0, -QUARTER_RAD, 0.0)
"""End angles of the turns in order: two to either side."""
REST_NS: Final = 1_500_000_000
LEASE_NS: Final = 200_000_000
LONGEST_S: Final = 60.0


class _Turner:
    """A planner that only turns the rotator; ``turned_rad`` are the true angles of the completed turns."""

    def __init__(self, profile: Profile, plant: Plant) -> None:
        self.turned_rad: list[float] = []
        self._arm, self._plant = Arm(profile), plant
        self._stream = SetpointStream(profile_hash(profile), LEASE_NS)
        self._motion: Trajectory = hold((0.0,) * len(JOINTS))
        self._begun_ns: int | None = None
        self._from_rad = 0.0

    @property
    def done(self) -> bool:
        return len(self.turned_rad) == len(TURNS_RAD)

    def step(self, now_ns: int, report: StateReport | None, logs: object) -> bytes | None:
        if report is not None and report.mode in (Mode.ARMED, Mode.ACTIVE) and not self.done:
            self._proceed(report, now_ns)
        if self._begun_ns is None or self.done or not self._stream.due(now_ns):
            return None
        return self._stream.datagram(now_ns, self._motion, (now_ns - self._begun_ns) * 1e-9, GrappleCommand.NEUTRAL)

    def _proceed(self, report: StateReport, now_ns: int) -> None:
        angle_rad = self._plant.joint_positions()[Joint.ROT]
        if self._begun_ns is not None:
            if now_ns < self._begun_ns + int(self._motion.duration_s * 1e9) + REST_NS:
                return
            self.turned_rad.append(angle_rad - self._from_rad)
            if self.done:
                return
        start = self._motion.goal if self._begun_ns is not None else (*report.position[: Joint.ROT], 0.0)
        goal = (*start[: Joint.ROT], TURNS_RAD[len(self.turned_rad)])
        self._motion, self._begun_ns, self._from_rad = joint_motion(self._arm, start, goal), now_ns, angle_rad


def turn_errors(job: Job, path: Path) -> list[float]:
    """Measure the relative error of the true angle of every commanded turn in `TURNS_RAD`, with the profile in a file.

    Raises:
        InputRefused: the machine did not make all turns.
    """
    profile = load_profile(path)
    plant = Plant(profile_named(job.options["profile"]), seed=job.seed, truth=job.options["truth"], logs=0)
    try:
        turner, digest = _Turner(profile, plant), profile_hash(profile)
        system = Lockstep(
            Settings(profile, digest, profile.rate_hz),
            build_guard(path),
            plant,
            turner,
            Operator(digest, _pressed, max_stops=0),
            Observer(None, []),
        )
        while not turner.done and system.now_ns < START_NS + int(LONGEST_S * 1e9):
            system.advance()
    finally:
        plant.close()
    if not turner.done:
        raise InputRefused(
            "experiment.quarter-turns", f"only {len(turner.turned_rad)} of {len(TURNS_RAD)} quarter turns were made"
        )
    before = (0.0, *TURNS_RAD)
    asked = [b - a for a, b in zip(before, TURNS_RAD, strict=False)]
    return [true / want - 1.0 for true, want in zip(turner.turned_rad, asked, strict=True)]


def _pressed(action: OperatorAction, report: StateReport) -> None:
    """Print nothing: the operator is emulated."""


# -- One calibration of one individual machine in lockstep, compared with the hidden ground truth


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
    error_report = {
        **facts,
        "implausible": [problem.sentence for problem in result.implausible],
        "joints": joints,
        **_survey_errors(truth, result),
    }
    if result.implausible:
        return error_report
    with TemporaryDirectory() as folder:
        out = Path(folder) / "calibrated.toml"
        write_profile(profile_path(name), out, profile_changes(profile, result), "today")
        if result.turns is not None:
            error_report["rotator"] = _rotator_errors(job, profile, truth, result.turns, out)
        return {**error_report, "tip": tip_errors(job, profile, load_profile(out))}


def _rotator_errors(job: Job, profile: Profile, truth: Any, turns: TurnFit, calibrated: Path) -> dict[str, Any]:
    """Compute the errors of a rotator without an encoder against its true valve, and of commanded quarter turns."""
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
            100.0 * (identified - true)
            for identified, true in zip(r.valve.deadbands, (valve.deadband_plus, valve.deadband_minus), strict=True)
        ],
        "hysteresis_pct": 100.0 * (r.valve.hysteresis - valve.hysteresis),
        "gain": [identified / true - 1.0 for identified, true in zip(r.valve.full_speeds, real, strict=True)],
        "delay_ms": math.nan if r.delay is None else 1e3 * (r.delay.delay_s - valve.delay_s),
        "repeat_pct": [100.0 * x for x in r.repeats],
        "residual": r.valve.residual,
        "response_s": list(r.responses_s),
        "profile": _profile_errors(profile, valve, which, real),
    }


def _profile_errors(profile: Profile, valve: Any, which: Joint, real: list[float]) -> dict[str, list[float]]:
    """Compute the errors of the profile before calibration."""
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
    """Measure the full speed of the plant where the calibration states it, measured without bus, controller and
    sensors.

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
        function_index = world.functions.index(name)

        def run(seconds: float, spool: float) -> None:
            commands = [0.0] * len(world.functions)
            commands[function_index] = spool
            for _ in range(round(seconds / STEP_S)):
                world.step(commands)

        run(REST_S, 0.0)
        run(RUN_S, side * TESTED_SPOOL)
        start_position = world.q[name]
        run(TIMED_S, side * TESTED_SPOOL)
        return float(abs(world.q[name] - start_position) / TIMED_S / share)


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
