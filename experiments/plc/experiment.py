"""The PLC experiment: compares the PLC path with the CAN path in lockstep, with the same jobs, seeds and machines."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from autonomy.crane_job.activity import Activity
from can_dbc.messages.crane import StateReport
from controller.config import Settings
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.guard.guard import Guard
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.recording import recorder_of
from experiments.common.registry import Options
from experiments.common.result import Metric, Result, make_result, mean, rate
from experiments.common.result_page import Page, Section, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.common.workers import Trial
from experiments.common.worlds import profile_named
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.plc import BridgedPlant, write_plc_profile
from machine.geometry.kinematics import pin_position
from machine.status.modes import Mode
from recorder.recorder import Recorder
from sim.plant import Plant

# -- One job on one command path in lockstep: success, accuracy and latency as plain data.


LIMIT_NS: Final = 150_000_000_000
SETTLE_NS: Final = 3_000_000_000
REST_NS: Final = 600_000_000
"""After this time at rest the reference should have been reached."""
NS_PER_MS: Final = 1e6
LIFT: Final = 1


@dataclass(slots=True)
class PathObserver:
    """Accuracy and latency of one job, sampled at every report and after every slice of the lockstep."""

    system: Lockstep
    plant: Plant
    rests_mm: list[float] = field(default_factory=list)
    squares: float = 0.0
    moments: int = 0
    behind: list[float] = field(default_factory=list)
    """True less estimated boom angle; ``speeds`` holds the speed of the boom at the same times."""
    speeds: list[float] = field(default_factory=list)
    delays_ms: list[float] = field(default_factory=list)
    _still_since_ns: int = 0
    _last: tuple[float, ...] = ()
    _rested: bool = False
    _commanded_ns: int | None = None
    _was_open: bool = False

    def report(self, report: StateReport) -> None:
        """Sample the accuracy, and the age of the controller's measurements."""
        if report.mode != Mode.ACTIVE:
            self._last = ()
            return
        true, reference = self.plant.joint_positions(), report.reference
        kin = self.plant.profile.kinematics
        error_mm = 1e3 * math.dist(pin_position(kin, true[:4]), pin_position(kin, reference[:4]))
        if reference != self._last:
            self._last, self._still_since_ns, self._rested = reference, report.stamp_ns, False
            self.squares += error_mm * error_mm
            self.moments += 1
            self.behind.append(true[LIFT] - report.position[LIFT])
            self.speeds.append(report.velocity[LIFT])
        elif not self._rested and report.stamp_ns - self._still_since_ns >= REST_NS:
            self._rested = True
            self.rests_mm.append(error_mm)

    def slice(self) -> None:
        """Measure how long the first opening command takes to reach the boom's valve."""
        plant = self.plant
        commanded = self.system._controller.crane.spools_pct[LIFT] != 0.0
        output = plant.plc.outputs[LIFT] if isinstance(plant, BridgedPlant) else plant.valve.outputs_pct[LIFT]
        if not commanded:
            self._commanded_ns = None
        elif self._commanded_ns is None and not self._was_open and output == 0.0:
            self._commanded_ns = self.system.now_ns
        if self._commanded_ns is not None and output != 0.0:
            self.delays_ms.append((self.system.now_ns - self._commanded_ns) / NS_PER_MS)
            self._commanded_ns = None
        self._was_open = commanded


def perform(job: Job) -> dict[str, Any]:
    """Run one job on the path ``job.kind``."""
    path_name, name = job.kind, job.options["profile"]
    with tempfile.TemporaryDirectory() as directory:
        path = profile_path(name)
        if path_name == "references":
            path = write_plc_profile(name, "references", Path(directory))
        elif path_name == "valves":
            path = write_plc_profile(name, "valves", Path(directory))
        settings, guard = load_settings(path), build_guard(path)
        with recorder_of(job, settings.profile, path) as recorder:
            return _performed(job, settings, guard, recorder)


def _performed(job: Job, settings: Settings, guard: Guard, recorder: Recorder | None) -> dict[str, Any]:
    path_name, profile, truth = job.kind, settings.profile, job.options["truth"]
    if path_name == "can":
        plant = Plant(profile, job.seed, truth)
    else:
        plant = BridgedPlant(profile, job.seed, truth, transport="modbus" if path_name == "references" else "udp")
    try:
        activity = Activity(profile, settings.profile_hash)
        reports: list[Any] = []
        operator = Operator(settings.profile_hash, lambda *_: None)
        system = Lockstep(settings, guard, plant, activity, operator, Observer(recorder, reports))
        observer = PathObserver(system, plant)
        reports.append(observer.report)
        while not (activity.done or activity.failure or operator.gave_up) and system.now_ns < START_NS + LIMIT_NS:
            system.advance()
            observer.slice()
        ended_ns = system.now_ns
        while not plant.evaluate().success and system.now_ns < ended_ns + SETTLE_NS:
            system.advance()
        return {
            "success": bool(activity.done and plant.evaluate().success),
            "stops": operator.stops,
            "seconds": (ended_ns - START_NS) * 1e-9,
            "rests_mm": observer.rests_mm,
            "squares": observer.squares,
            "moments": observer.moments,
            "age_ms": 1e3 * slope(observer.speeds, observer.behind),
            "delays_ms": observer.delays_ms,
        }
    finally:
        plant.close()


def slope(x: list[float], y: list[float]) -> float:
    """Compute the slope of the least-squares line through (x, y); NaN if all x are equal."""
    mean_x, mean_y = mean(x), mean(y)
    square = sum((a - mean_x) ** 2 for a in x)
    return sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / square if square else math.nan


# -- Metrics of the PLC experiment with their limits, and the page that shows them.


PATHS: Final = {
    "can": "CAN, valve node",
    "references": "PLC closes the loops, Modbus/TCP",
    "valves": "PLC forwards valve commands, UDP",
}
"""Command paths by the prefix of their metrics."""
CONCLUSION: Final = (
    "Over CAN {can_success} of the logs end in the bunk, with a PLC that closes the loops {references_success}, and "
    "with a PLC that forwards valve commands {valves_success}.",
    "The pin comes to rest {can_rest_mm} from its reference over CAN, {references_rest_mm} and {valves_rest_mm} "
    "through the PLC; a command reaches the valve after {can_command_ms}, {references_command_ms} and "
    "{valves_command_ms}.",
)
INTRODUCTION: Final = (
    "On paper A's machine a PLC sits between the computer and the valves. The same jobs run over CAN and through the "
    "PLC in both of its roles: closing the joint loops (Modbus/TCP), and forwarding valve commands (cyclic UDP). All "
    "times are virtual, so they show the cost of the path, not of the host."
)


def _metrics(path: str, title: str) -> Iterator[Metric]:
    yield Metric(
        f"{path}_success",
        f"Logs in the bunk: {title}",
        "%",
        "Share of the trials, by the plant's ground truth.",
        least=1.0,
    )
    yield Metric(f"{path}_stops", f"Stops in all trials: {title}", "", "The emulated operator arms again after each.")
    yield Metric(f"{path}_seconds", f"Duration of a job: {title}", "s", "Mean of the trials.")
    yield Metric(
        f"{path}_rest_mm",
        f"Error of the pin at rest, mean: {title}",
        "mm",
        "Hanger pin by the true joints against a reference that has rested for 0.6 s.",
    )
    yield Metric(f"{path}_rest_max_mm", f"Error of the pin at rest, largest: {title}", "mm", "All rests of all trials.")
    yield Metric(
        f"{path}_track_mm", f"Error of the pin in motion, RMS: {title}", "mm", "Against the reference at the same time."
    )
    yield Metric(
        f"{path}_command_ms",
        f"Latency from command to valve: {title}",
        "ms",
        "From the controller's first command that opens the boom's valve to the output; mean.",
    )
    yield Metric(
        f"{path}_measured_ms",
        f"Age of a measurement: {title}",
        "ms",
        "Slope of true less estimated boom angle over its speed, so that offsets do not count.",
    )


SECTIONS: Final = (
    Section(
        "CAN and PLC compared",
        "Every trial draws another individual machine and another log; the three paths get the same ones.",
        tuple(m for path, title in PATHS.items() for m in _metrics(path, title)),
    ),
)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)


def gather(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Compute the metrics of all paths; outcomes are named PATH-NUMBER."""
    metrics: dict[str, float] = {}
    for path in PATHS:
        trials = [o for name, o in outcomes.items() if name.startswith(f"{path}-")]
        rests = [e for t in trials for e in t["rests_mm"]]
        metrics |= rate(f"{path}_success", sum(t["success"] for t in trials), len(trials))
        metrics |= {
            f"{path}_stops": float(sum(t["stops"] for t in trials)),
            f"{path}_seconds": mean([t["seconds"] for t in trials]),
            f"{path}_rest_mm": mean(rests),
            f"{path}_rest_max_mm": max(rests, default=math.nan),
            f"{path}_track_mm": math.sqrt(mean([t["squares"] / max(1, t["moments"]) for t in trials])),
            f"{path}_command_ms": mean([d for t in trials for d in t["delays_ms"]]),
            f"{path}_measured_ms": mean([t["age_ms"] for t in trials]),
        }
    return metrics


# -- The PLC experiment


TRIALS: Final = 20
QUICK_TRIALS: Final = 1


def run(options: Options, console: Console) -> Result:
    """Run all trials on all paths; write ``options.out`` and, if requested, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    common = {"profile": options.profile, "truth": options.truth}
    jobs = [Job(f"{path}-{i}", path, options.seed + i, common) for i in range(trials) for path in PATHS]
    with checkpoint(options, (), [options.profile], options.truth, LOCKSTEP_SOURCES) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "plc trials", console)
        result = make_result(
            "plc",
            METRICS,
            gather(outcomes),
            profile=profile_named(options.profile).name,
            seed=options.seed,
            trials=trials,
            more={"truth": options.truth},
        )
        publish(result, page_of(result, {}), options, console)
    return result


def failed(trial: Trial) -> bool:
    """Tell whether the log is not in the bunk, or somebody had to arm again: a campaign keeps its recording."""
    return not trial.outcome["success"] or trial.outcome["stops"] > 0


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("PLC path and CAN path", CONCLUSION, INTRODUCTION, SECTIONS)
