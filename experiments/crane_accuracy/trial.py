"""The two kinds of jobs: calibrate an individual machine, and run the motions of a variant on it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import acos, degrees
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from autonomy.calibration.trace import BusTrace
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.common.individuals import calibrated
from experiments.common.minimum_time import full_limits, minimum_time_s
from experiments.common.pool import Job
from experiments.common.worlds import hang, profile_named
from experiments.crane_accuracy import measure
from experiments.crane_accuracy.measure import Trace
from experiments.crane_accuracy.plan import LAWS, UNCOMPENSATED, UNSHAPED, Visit
from experiments.crane_accuracy.reach_cycles import Phase, ReachCycles, Run
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from sim.plant import Plant

# -- The testbed: a machine on its virtual buses with the planner of the experiment, sampled while it moves.
#
# Controller, guard, CAN bytes and plant are those of every lockstep run (`hil.harness.lockstep`).  The plant is
# built from the profile as shipped: a calibration changes the controller's profile, not the machine.


CYCLE_S: Final = 60.0
"""Longer than any motion there and back with its rests; a machine that needs more has failed."""
MAX_REARM_COUNT: Final = 8
COMMANDS: Final = ("ValveCmdA", "ValveCmdB")


@dataclass(slots=True)
class Samples:
    """Samples of one motion at the controller's reports: time [ns], true and encoder pin [m], joints, lean [deg]."""

    stamps_ns: list[int] = field(default_factory=list)
    true_m: list[tuple[float, ...]] = field(default_factory=list)
    encoder_m: list[tuple[float, ...]] = field(default_factory=list)
    position: list[tuple[float, ...]] = field(default_factory=list)
    lean_deg: list[float] = field(default_factory=list)


class AccuracyTestbed:
    """``profile`` is the controller's, ``guard`` its file for the guard; the plant is built from ``shipped``."""

    def __init__(
        self,
        profile: Profile,
        guard: Path,
        shipped: Profile,
        truth: str,
        seed: int,
        visits: Sequence[Visit],
        shaped: bool = True,
    ) -> None:
        self.profile, self.samples = profile, list[Samples]()
        digest = profile_hash(profile)
        self.plant = Plant(shipped, seed=seed, truth=truth, logs=0)
        self.cycles = ReachCycles(profile, digest, visits, lambda kg: hang(self.plant.world, kg), shaped)
        self.operator = Operator(digest, _pressed, MAX_REARM_COUNT)
        settings = Settings(profile, digest, profile.rate_hz)
        self._system = Lockstep(
            settings, build_guard(guard), self.plant, self.cycles, self.operator, Observer(None, [self._look])
        )
        database = load("crane")
        self.bus = BusTrace(profile, database)
        keys = [database.message(name).key for name in COMMANDS]
        self._listener = InProcessBus(self._system.core, "surveyor", filters=keys)
        self._frames: list[Frame] = []

    def run(self) -> None:
        """Run until all motions are made, the operator gives up, or the time limit is reached."""
        limit_ns = START_NS + int(CYCLE_S * 1e9) * (2 + len(self.cycles.visits))
        system = self._system
        while not self.cycles.done and not self.operator.gave_up and system.now_ns < limit_ns:
            system.advance()

    def close(self) -> None:
        """Release the physics."""
        self.plant.close()

    def _look(self, report: StateReport) -> None:
        """Sample the ground truth; called with every report."""
        self._frames.clear()
        self._listener.drain(self._frames)
        cycles = self.cycles
        if cycles.phase is not Phase.OUT and cycles.phase is not Phase.REST:
            return
        self.bus.accept(self._frames)
        while len(self.samples) < len(cycles.runs):
            self.samples.append(Samples())
        samples = self.samples[-1]
        samples.stamps_ns.append(report.stamp_ns)
        samples.true_m.append(self.plant.tip())
        samples.encoder_m.append(pin_position(self.profile.kinematics, report.position))
        samples.position.append(report.position)
        _, (x, y, _, _) = self.plant.world.crane.pose("rotator")
        samples.lean_deg.append(degrees(acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))))

    def trace(self, run: Run, samples: Samples) -> Trace:
        """Return the trace of one motion with its rest."""
        time_s = (np.array(samples.stamps_ns) - run.begun_ns) * 1e-9
        command_s, shut = self._valves(run)
        return Trace(
            time_s, np.array(samples.encoder_m), np.array(samples.true_m), np.array(samples.lean_deg), command_s, shut
        )

    def spools(self, run: Run, which: Joint) -> tuple[np.ndarray, np.ndarray]:
        """Return times [s] and commands (-1 to 1) of the valve of one joint on the bus."""
        return self.bus.commands[which].between(run.begun_ns, run.over_ns or self._system.now_ns)

    def _valves(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Return times [s] of the commands, and whether the commands of all joints were exactly zero."""
        times, slew = self.spools(run, Joint.SLEW)
        shut = slew == 0.0
        for j in JOINTS:
            when, values = self.spools(run, j)
            at = np.searchsorted(when, times, side="right") - 1
            shut &= values[np.maximum(at, 0)] == 0.0
        return times, shut


def _pressed(action: OperatorAction, report: StateReport) -> None:
    """Print nothing: the operator is emulated."""


# -- The two kinds of jobs


def perform(job: Job) -> dict[str, Any]:
    """Run a job of either kind."""
    return calibrated(job) if job.kind == "calibration" else measured(job)


def measured(job: Job) -> dict[str, Any]:
    """Run the motions of one variant.

    Options: profile (shipped name), truth, variant, visits ((goal, load) pairs), text (of the profile to run; None: as
    shipped), and optionally ``trace``, the number of the motion whose curves are kept.
    """
    o = job.options
    shipped = profile_named(o["profile"])
    visits = [Visit(*v) for v in o["visits"]]
    with tempfile.TemporaryDirectory() as folder:
        path = profile_path(o["profile"])
        if o["text"] is not None:
            path = Path(folder) / "calibrated.toml"
            path.write_text(o["text"], encoding="utf-8")
        profile = varied(load_profile(path), o["variant"])
        testbed = AccuracyTestbed(profile, path, shipped, o["truth"], job.seed, visits, shaped=o["variant"] != UNSHAPED)
    try:
        testbed.run()
        return _outcome(testbed, o.get("trace"))
    finally:
        testbed.close()


def varied(profile: Profile, variant: str) -> Profile:
    """Make the profile of a variant: another law on every joint, or no sag model."""
    if variant == UNCOMPENSATED:
        return msgspec.structs.replace(profile, sag=None)
    if variant not in LAWS:
        return profile
    joints = {
        name: msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, kind=variant))
        for name, spec in profile.joints.items()
    }
    return msgspec.structs.replace(profile, joints=joints)


def _outcome(testbed: AccuracyTestbed, traced: int | None) -> dict[str, Any]:
    limits = full_limits(testbed.profile)
    shortest: dict[tuple[int, float], float] = {}
    motions = []
    for run, samples in zip(testbed.cycles.runs, testbed.samples, strict=True):
        facts: dict[str, Any] = {"goal": run.visit.goal, "load_kg": run.visit.load_kg, "believed_kg": run.load_kg}
        if run.failed or not run.over_ns:
            motions.append({**facts, "failed": True})
            continue
        key = (run.visit.goal, run.visit.load_kg)
        if key not in shortest:
            shortest[key] = minimum_time_s(np.array(run.motion.position), limits)
        ended_s = (run.ended_ns - run.begun_ns) * 1e-9
        motion_metrics = measure.motion_metrics(
            testbed.trace(run, samples), np.array(run.commanded_m), np.array(run.goal_m), ended_s
        )
        off = np.mean(samples.position[-25:], axis=0) - np.array(run.motion.goal)
        motions.append(
            {
                **facts,
                **motion_metrics,
                "failed": False,
                "planned_s": run.motion.duration_s,
                "minimum_s": shortest[key],
                "joints": off[: Joint.ROT].tolist(),
            }
        )
    outcome = {
        "motions": motions,
        "missing": len(testbed.cycles.visits) - len(motions),
        "stops": testbed.operator.stops,
    }
    if traced is not None and traced < len(motions) and not motions[traced]["failed"]:
        outcome["trace"] = _curves(testbed, testbed.cycles.runs[traced], testbed.samples[traced])
    return outcome


def _curves(testbed: AccuracyTestbed, run: Run, samples: Samples) -> dict[str, Any]:
    """Return the curves of one motion for the plot."""
    trace = testbed.trace(run, samples)
    reference = [run.motion.at(t)[0] for t in trace.time_s.tolist()]
    curves: dict[str, Any] = {
        "goal_m": list(run.goal_m),
        "load_kg": run.visit.load_kg,
        "time_s": trace.time_s.tolist(),
        "true_m": trace.true_m.tolist(),
        "encoder_m": trace.encoder_m.tolist(),
        "reference": [list(q) for q in reference],
        "lean_deg": trace.lean_deg.tolist(),
        "spools": {},
    }
    for j in JOINTS[: Joint.ROT]:
        times, values = testbed.spools(run, j)
        curves["spools"][j.name.lower()] = {"time_s": times[::4].tolist(), "percent": (100.0 * values[::4]).tolist()}
    return curves
