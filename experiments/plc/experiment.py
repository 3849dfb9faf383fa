"""The PLC path beside the CAN path: the same jobs, seeds and individual machines, in lockstep; accuracy and latency.

Ways: ``can`` (valve node on crane0), ``references`` (a PLC closes the joint loops, Modbus/TCP), ``valves`` (a PLC
passes our commands on, cyclic UDP).  All times are virtual: the figures say what the path costs, not what a host does.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from autonomy.crane_job.activity import Activity
from can_dbc.messages.crane import StateReport
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Figure, Result, judged, mean, rate
from experiments.common.result_page import Section, tell
from experiments.common.trials import checkpoint
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.plc.bridged_plant import BridgedPlant
from hil.plc.profile import write_plc_profile
from machine.kinematics import pin_position
from machine.modes import Mode
from sim.plant import Plant

TRIALS: Final = 20
QUICK_TRIALS: Final = 1
LIMIT_NS: Final = 150_000_000_000
SETTLE_NS: Final = 3_000_000_000
REST_NS: Final = 600_000_000
"""A reference that has rested for so long is to have been reached."""
NS_PER_MS: Final = 1e6
LIFT: Final = 1
WAYS: Final = {
    "can": "CAN, valve node",
    "references": "PLC closes the loops, Modbus/TCP",
    "valves": "PLC passes valves on, UDP",
}


def _figures(way: str, words: str) -> Iterator[Figure]:
    yield Figure(
        f"{way}_success", f"Logs in the bunk: {words}", "%", "Of the trials; by the plant's judge.", scale=100.0
    )
    yield Figure(f"{way}_stops", f"Stops in all trials: {words}", "", "The stand-in operator arms again after each.")
    yield Figure(f"{way}_seconds", f"Time of a job: {words}", "s", "Mean of the trials.")
    yield Figure(f"{way}_rest_mm", f"Pin at rest, mean: {words}", "mm",
                 "Hanger pin by the true joints against the reference that rested for 0.6 s.")  # fmt: skip
    yield Figure(f"{way}_rest_max_mm", f"Pin at rest, greatest: {words}", "mm", "Of all rests of all trials.")
    yield Figure(f"{way}_track_mm", f"Pin in motion, RMS: {words}", "mm", "Against the reference of the same moment.")
    yield Figure(f"{way}_command_ms", f"Command to valve: {words}", "ms",
                 "From the controller's first opening of the boom's valve to the output's; mean.")  # fmt: skip
    yield Figure(f"{way}_measured_ms", f"Age of a measurement: {words}", "ms",
                 "Slope of true less estimated boom angle over its speed; no offset counts.")  # fmt: skip


ACCURACY: Final = Section(
    "Both paths in one table",
    "Every trial draws another individual machine and another log; the three ways get the same ones.",
    tuple(f for way, words in WAYS.items() for f in _figures(way, words)),
    (),
)
FIGURES: Final = tuple(
    Figure(f.name, f.title, f.unit, f.how, 1.0, None, f.scale) if f.name.endswith("_success") else f
    for f in ACCURACY.figures
)
SECTIONS: Final = (Section(ACCURACY.title, ACCURACY.text, FIGURES, ()),)


@dataclass(slots=True)
class Watch:
    """What is read off one job, report by report and slice by slice."""

    system: Lockstep
    plant: Plant
    rests_mm: list[float] = field(default_factory=list)
    squares: float = 0.0
    moments: int = 0
    behind: list[float] = field(default_factory=list)
    """True less estimated boom angle, and in ``speeds`` the boom's speed then."""
    speeds: list[float] = field(default_factory=list)
    delays_ms: list[float] = field(default_factory=list)
    _still_since_ns: int = 0
    _last: tuple[float, ...] = ()
    _rested: bool = False
    _asked_ns: int | None = None
    _was_open: bool = False

    def report(self, report: StateReport) -> None:
        """Accuracy, and the age of what the controller knows."""
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
        """How long the boom's valve takes to hear of an opening."""
        plant = self.plant
        asked = self.system._controller.spools[LIFT] != 0.0
        output = plant.plc.outputs[LIFT] if isinstance(plant, BridgedPlant) else plant.valve.outputs_pct[LIFT]
        if not asked:
            self._asked_ns = None
        elif self._asked_ns is None and not self._was_open and output == 0.0:
            self._asked_ns = self.system.now_ns
        if self._asked_ns is not None and output != 0.0:
            self.delays_ms.append((self.system.now_ns - self._asked_ns) / NS_PER_MS)
            self._asked_ns = None
        self._was_open = asked


def perform(job: Job) -> dict[str, Any]:
    """One job on one way."""
    way, name, truth = job.kind, job.options["profile"], job.options["truth"]
    with tempfile.TemporaryDirectory() as directory:
        path = profile_path(name)
        if way == "references" or way == "valves":
            path = write_plc_profile(name, way, Path(directory))
        settings, guard = load_settings(path), build_guard(path)
    profile = settings.profile
    if way == "can":
        plant = Plant(profile, job.seed, truth)
    else:
        plant = BridgedPlant(profile, job.seed, truth, transport="modbus" if way == "references" else "udp")
    try:
        activity = Activity(profile, settings.profile_hash)
        reports: list[Any] = []
        operator = Operator(settings.profile_hash, lambda *_: None)
        system = Lockstep(settings, guard, plant, activity, operator, Observer(None, reports))
        watch = Watch(system, plant)
        reports.append(watch.report)
        while not (activity.done or activity.failure or operator.gave_up) and system.now_ns < START_NS + LIMIT_NS:
            system.advance()
            watch.slice()
        ended_ns = system.now_ns
        while not plant.judge().success and system.now_ns < ended_ns + SETTLE_NS:
            system.advance()
        return {
            "success": bool(activity.done and plant.judge().success), "stops": operator.stops,
            "seconds": (ended_ns - START_NS) * 1e-9, "rests_mm": watch.rests_mm, "squares": watch.squares,
            "moments": watch.moments, "age_ms": 1e3 * slope(watch.speeds, watch.behind),
            "delays_ms": watch.delays_ms,
        }  # fmt: skip
    finally:
        plant.close()


def slope(x: list[float], y: list[float]) -> float:
    """Of the straight line of least squares through (x, y)."""
    mean_x, mean_y = mean(x), mean(y)
    square = sum((a - mean_x) ** 2 for a in x)
    return sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / square if square else math.nan


def gather(outcomes: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The metrics of all ways."""
    metrics: dict[str, float] = {}
    for way in WAYS:
        trials = [o for name, o in outcomes.items() if name.startswith(f"{way}-")]
        rests = [e for t in trials for e in t["rests_mm"]]
        metrics |= rate(f"{way}_success", sum(t["success"] for t in trials), len(trials))
        metrics |= {
            f"{way}_stops": float(sum(t["stops"] for t in trials)),
            f"{way}_seconds": mean([t["seconds"] for t in trials]),
            f"{way}_rest_mm": mean(rests),
            f"{way}_rest_max_mm": max(rests, default=math.nan),
            f"{way}_track_mm": math.sqrt(mean([t["squares"] / max(1, t["moments"]) for t in trials])),
            f"{way}_command_ms": mean([d for t in trials for d in t["delays_ms"]]),
            f"{way}_measured_ms": mean([t["age_ms"] for t in trials]),
        }
    return metrics


def run(options: Options, console: Console) -> Result:
    """All trials on all ways; writes ``options.out`` and, when asked, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    plain = {"profile": options.profile, "truth": options.truth}
    jobs = [Job(f"{way}-{i}", way, options.seed + i, plain) for i in range(trials) for way in WAYS]
    with checkpoint(options, jobs, [options.profile], options.truth) as kept:
        outcomes = pool.run(perform, jobs, kept, options.workers, "plc trials", console)
        result = judged(
            "plc", FIGURES, gather(outcomes), profile=load_settings(profile_path(options.profile)).profile.name,
            seed=options.seed, trials=trials, more={"truth": options.truth},
        )  # fmt: skip
        tell(result, "The PLC path beside the CAN path", INTRODUCTION, SECTIONS, options, console)
    return result


INTRODUCTION: Final = (
    "On paper A's machine a PLC stands between the computer and the valves. The same jobs go over CAN and through the "
    "PLC, in both roles. `timberhand experiment plc --docs docs` measures everything and writes the page; no number is "
    "typed."
)
