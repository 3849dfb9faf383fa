"""Nominal work without faults: every stop is a false trip.

One job is a stretch of work on one individual machine.  The scenes of the campaign run with sampled truths and on rough
ground; the log job is that of `timberhand demo`, with another log for every stretch, over CAN and through a PLC.
"""

from __future__ import annotations

import gc
import tempfile
from pathlib import Path
from typing import Any, Final

from autonomy.crane_job.activity import Activity
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.tick import Outputs
from experiments.common.pool import Job
from experiments.faults.running import build
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.plc.bridged_plant import BridgedPlant, Transport
from hil.plc.profile import write_plc_profile
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.reasons import pack
from sim.plant import Plant

STRETCH_S: Final = 300.0
LOG_S: Final = 30.0
"""A log job takes longer than this."""
LOG_LIMIT_S: Final = 150.0
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
}
"""Scene to truth, ground, and its part of the hours relative to the others."""


class _Trips:
    """Counts transitions from work into a stop."""

    def __init__(self) -> None:
        self.found: list[tuple[float, str]] = []
        self.working_ticks = 0
        self._mode: Mode = Mode.BOOT

    def outputs(self, outputs: Outputs, now_ns: int) -> None:
        """The outputs of a tick."""
        mode = outputs.mode
        self.working_ticks += mode is Mode.ACTIVE
        if mode in (Mode.STOP, Mode.FAULT) and self._mode in (Mode.ARMED, Mode.ACTIVE):
            self.found.append(((now_ns - START_NS) * 1e-9, describe(pack(outputs.reason, outputs.detail))))
        self._mode = mode


def perform(job: Job) -> dict[str, Any]:
    """One stretch; options: scene, seconds."""
    scene, seconds = job.options["scene"], job.options["seconds"]
    truth, terrain, _ = SETTINGS[scene]
    if scene.startswith("log"):
        return _log_job(scene, job.seed, truth)
    machine = build(scene, job.seed, truth, terrain)
    trips = _Trips()
    gc.collect()
    gc.freeze()
    machine.system._observer.on_outputs.append(trips.outputs)
    try:
        while machine.system.now_ns < START_NS + round(seconds * 1e9):
            machine.system.advance()
    finally:
        close = getattr(machine.plant, "close", None)
        if close is not None:
            close()
    return _outcome(scene, job.seed, machine.system, trips)


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
    trips = _Trips()
    try:
        activity = Activity(settings.profile, settings.profile_hash, grasp_selector=PlannerSelection(SamplingPlanner()))
        operator = Operator(settings.profile_hash, lambda *_: None, watches=True)
        system = Lockstep(settings, guard, plant, activity, operator, Observer(on_outputs=[trips.outputs]))
        while not (activity.done or activity.failure) and system.now_ns < START_NS + round(LOG_LIMIT_S * 1e9):
            system.advance()
    finally:
        plant.close()
    return _outcome(scene, seed, system, trips)


def _outcome(scene: str, seed: int, system: Lockstep, trips: _Trips) -> dict[str, Any]:
    return {
        "scene": scene, "seed": seed, "seconds": (system.now_ns - START_NS) * 1e-9,
        "working_s": trips.working_ticks * system.period_ns * 1e-9, "trips": trips.found,
    }  # fmt: skip
