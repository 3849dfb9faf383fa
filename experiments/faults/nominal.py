"""Nominal work without faults: every stop is a false trip.

One job is a stretch of work on one individual machine.  The scenes of the campaign run with sampled truths and on rough
ground; the log job is that of `timberhand demo`, with another log for every stretch, over CAN and through a PLC; a
mission is paper B's with its own camera and another field every time, on individuals with the shipped profile and with
one of their own calibration, and on drawn ground.
"""

from __future__ import annotations

import gc
import tempfile
from pathlib import Path
from typing import Any, Final

from autonomy.crane_job.activity import Activity
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.missions.mission_file import load_mission
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.tick import Outputs
from experiments.common.individuals import calibrated
from experiments.common.mission_trial import PAPER_B, run_mission, shuffled
from experiments.common.pool import Job
from experiments.common.recording import RECORD
from experiments.common.worlds import profile_named
from experiments.faults.running import build
from experiments.faults.separation import Separation
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.missions.site import site_of
from hil.plc import BridgedPlant, Transport, write_plc_profile
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.reasons import pack
from sim.plant import Plant

STRETCH_S: Final = 300.0
STRETCHES_S: Final = {"log": 30.0, "mission": 1000.0}
"""What is done whole takes longer than this."""
LOG_LIMIT_S: Final = 150.0
MISSION_LIMIT_S: Final = 2700.0
SETTINGS: Final = {
    "crane palms_471": ("nominal", "flat", 2.0),
    "crane palms_471 physics": ("sampled", "flat", 1.0),
    "crane aoro_fc8": ("nominal", "flat", 1.0),
    "crane aoro_fc8 physics": ("sampled", "rough", 0.2),
    "drive aoro_fc8": ("nominal", "flat", 1.0),
    "drive aoro_fc8 physics": ("sampled", "rough", 0.2),
    "log palms_471": ("sampled", "flat", 0.3),
    "log aoro_fc8": ("sampled", "flat", 0.15),
    "log palms_471 plc references": ("sampled", "flat", 0.1),
    "log palms_471 plc valves": ("sampled", "flat", 0.1),
    "mission aoro_fc8": ("nominal", "flat", 2.0),
    "mission aoro_fc8 individual": ("sampled", "flat", 2.0),
    "mission aoro_fc8 calibrated": ("sampled", "flat", 2.0),
    "mission aoro_fc8 ground": ("nominal", "drawn", 2.0),
}
"""Scene to truth, ground, and its part of the hours relative to the others."""


class _Trips:
    """Counts transitions from work into a stop, and sees how near the monitors come to one."""

    def __init__(self, system: Lockstep) -> None:
        self.found: list[tuple[float, str]] = []
        self.working_ticks = 0
        self.separation = Separation(system.controller, system.guard, START_NS)
        self._system = system
        self._mode: Mode = Mode.BOOT
        system.observer.on_outputs += [self.outputs, self.separation.outputs]

    def outcome(self, scene: str, seed: int) -> dict[str, Any]:
        """Return what has been counted."""
        system = self._system
        return {
            "scene": scene,
            "seed": seed,
            "seconds": (system.now_ns - START_NS) * 1e-9,
            "working_s": self.working_ticks * system.period_ns * 1e-9,
            "trips": self.found,
            "shares": self.separation.shares,
        }

    def outputs(self, outputs: Outputs, now_ns: int) -> None:
        """Evaluate the outputs of a tick."""
        mode = outputs.mode
        self.working_ticks += mode is Mode.ACTIVE
        if mode in (Mode.STOP, Mode.FAULT) and self._mode in (Mode.ARMED, Mode.ACTIVE):
            self.found.append(((now_ns - START_NS) * 1e-9, describe(pack(outputs.reason, outputs.detail))))
        self._mode = mode


def perform(job: Job) -> dict[str, Any]:
    """Run one stretch; options: scene, seconds."""
    scene, seconds = job.options["scene"], job.options["seconds"]
    truth, terrain, _ = SETTINGS[scene]
    if scene.startswith("log"):
        return _log_job(scene, job.seed, truth)
    if scene.startswith("mission"):
        return _mission(job, scene, truth, terrain)
    machine = build(scene, job.seed, truth, terrain)
    trips = _Trips(machine.system)
    gc.collect()
    gc.freeze()
    try:
        while machine.system.now_ns < START_NS + round(seconds * 1e9):
            machine.system.advance()
    finally:
        close = getattr(machine.plant, "close", None)
        if close is not None:
            close()
    return trips.outcome(scene, job.seed)


def _log_job(scene: str, seed: int, truth: str) -> dict[str, Any]:
    name, _, role = scene.removeprefix("log ").partition(" plc ")
    with tempfile.TemporaryDirectory() as directory:
        path = profile_path(name)
        if role:
            path = write_plc_profile(name, "references" if role == "references" else "valves", Path(directory))
        settings, guard = load_settings(path), build_guard(path)
    transport: Transport = "modbus" if role == "references" else "udp"
    plant: Plant = (
        BridgedPlant(settings.profile, seed, truth, transport=transport)
        if role
        else Plant(settings.profile, seed, truth)
    )
    try:
        activity = Activity(settings.profile, settings.profile_hash, grasp_selector=PlannerSelection(SamplingPlanner()))
        operator = Operator(settings.profile_hash, lambda *_: None, watches=True)
        system = Lockstep(settings, guard, plant, activity, operator, Observer())
        trips = _Trips(system)
        while not (activity.done or activity.failure) and system.now_ns < START_NS + round(LOG_LIMIT_S * 1e9):
            system.advance()
    finally:
        plant.close()
    return trips.outcome(scene, seed)


def _mission(job: Job, scene: str, truth: str, terrain: str) -> dict[str, Any]:
    """Run a whole mission; what it loaded and believes is in the outcome, too."""
    name = scene.split()[1]
    job_options = {"profile": name, "truth": truth, "way": "ours", "eyes": "ours", "limit_s": MISSION_LIMIT_S}
    job_options |= {key: job.options[key] for key in (RECORD,) if key in job.options}
    if scene.endswith("calibrated"):
        machine = calibrated(Job(job.name, "calibration", job.seed, job_options))
        if machine["profile"] is None:
            return {"scene": scene, "seed": job.seed, "seconds": 0.0, "failure": machine["failure"]}
        job_options["text"] = machine["profile"]
    mission = shuffled(load_mission(PAPER_B, route_wanted=True).mission, job.seed)
    site = site_of(mission, profile_named(name), job.seed, truth, terrain=terrain)
    trips: list[_Trips] = []
    mission_outcome = run_mission(
        Job(job.name, "mission", job.seed, job_options), mission, site, lambda run: trips.append(_Trips(run))
    )
    aboard = sum(log["in_bunk"] for log in mission_outcome["logs"])
    summary = {key: mission_outcome[key] for key in ("finished", "failure", "loaded", "stops", "given_up")}
    return trips[0].outcome(scene, job.seed) | summary | {"in_bunk": aboard}
