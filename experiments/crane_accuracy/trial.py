"""The two kinds of jobs: calibrate an individual machine, and run the motions of a variant on it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from controller.guard.__main__ import profile_path
from experiments.common.individuals import calibrated
from experiments.common.minimum_time import full_limits, minimum_time_s
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from experiments.crane_accuracy import measure
from experiments.crane_accuracy.plan import LAWS, UNCOMPENSATED, UNSHAPED, Visit
from experiments.crane_accuracy.reach_cycles import Run
from experiments.crane_accuracy.testbed import AccuracyTestbed, Samples
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile
from machine.profile import Profile


def perform(job: Job) -> dict[str, Any]:
    """A job of either kind."""
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
    """The profile of a variant: another law on every joint, or no sag model."""
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
        found = measure.motion_metrics(
            testbed.trace(run, samples), np.array(run.commanded_m), np.array(run.goal_m), ended_s
        )
        off = np.mean(samples.position[-25:], axis=0) - np.array(run.motion.goal)
        motions.append({
            **facts, **found, "failed": False, "planned_s": run.motion.duration_s, "minimum_s": shortest[key],
            "joints": off[: Joint.ROT].tolist(),
        })  # fmt: skip
    outcome = {
        "motions": motions,
        "missing": len(testbed.cycles.visits) - len(motions),
        "stops": testbed.operator.stops,
    }
    if traced is not None and traced < len(motions) and not motions[traced]["failed"]:
        outcome["trace"] = _curves(testbed, testbed.cycles.runs[traced], testbed.samples[traced])
    return outcome


def _curves(testbed: AccuracyTestbed, run: Run, samples: Samples) -> dict[str, Any]:
    """Curves of one motion for the plot."""
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
