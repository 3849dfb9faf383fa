"""The experiments by name.

Each module has ``run(options, console) -> Result`` and ``page_of(result, trials) -> Page``; it is imported when it is
used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

from rich.console import Console

from experiments.common.result import Result


@dataclass(frozen=True, slots=True)
class Options:
    """Options of the command line.

    ``trials``, ``repetitions`` and ``minutes``: None is the default of the experiment.  ``docs``: folder whose page is
    rewritten.  ``bus``: bus of a live experiment (wire or vcan).  ``data``: folder with data to evaluate.
    """

    seed: int
    truth: str
    profile: str
    out: Path
    trials: int | None = None
    quick: bool = False
    workers: int = 1
    docs: Path | None = None
    minutes: float | None = None
    repetitions: int | None = None
    bus: str = "wire"
    data: Path | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """The question that an experiment answers, and its module."""

    sentence: str
    module: str


EXPERIMENTS: Final = {
    "plant": Entry(
        "Does the simulated machine behave like steel, oil and wood? Grasps, closed-form physics, endurance, speed.",
        "experiments.plant.experiment",
    ),
    "calibration": Entry(
        "Does calibration recover the hidden truth? Dead-bands, gains, dead times, zeros, sag; many individuals.",
        "experiments.calibration.experiment",
    ),
    "joint-tracking": Entry(
        "Which joint law tracks best, rests nearest and closes its valves? Four laws, both machines, disturbances.",
        "experiments.joint_tracking.experiment",
    ),
    "crane-accuracy": Entry(
        "How near does the tip come to its goal, by encoders and truly? Paper B's four goals, calibrated machines.",
        "experiments.crane_accuracy.experiment",
    ),
    "timing": Entry(
        "Does the controller wake on time and cost little? Compared with cyclictest and a sleep loop, quiet and "
        "loaded.",
        "experiments.timing.experiment",
    ),
    "rates": Entry(
        "Does the whole forwarder run at 1 kHz? Cost against frames and joints, cranes on one processor.",
        "experiments.timing.rates",
    ),
    "vcan": Entry(
        "Are live runs on SocketCAN quiet? Demos and missions in a row, with the clock of each and the host's steal.",
        "experiments.vcan.experiment",
    ),
    "plc": Entry(
        "Does a PLC between crane0 and the valves work as well? Both roles compared with CAN: logs, accuracy, latency.",
        "experiments.plc.experiment",
    ),
    "grasp-network": Entry(
        "Is it paper A's network, what has it learnt, how fast is it? Parameters, Cornell folds, latency.",
        "experiments.grasp_network.experiment",
    ),
    "detector": Entry(
        "Are logs found in worlds unlike those of the training? mAP of boxes and masks; photographs.",
        "experiments.detector.experiment",
    ),
    "log-localization": Entry(
        "How precisely is a log located? Paper B's approach to logs at 0, 45 and 90 degrees: its pipeline and ours.",
        "experiments.log_localization.experiment",
    ),
    "grasp-configs": Entry(
        "How many grasps succeed, how good are they? Paper A's twelve configurations, camera to lift, three planners.",
        "experiments.grasp_configs.experiment",
    ),
    "navigation": Entry(
        "Does the machine follow its path? Paper B's four waypoints, six starts, mud, slope; both methods.",
        "experiments.navigation.experiment",
    ),
    "forwarding-mission": Entry(
        "Does the forwarder load 24 logs by itself? Paper B's trial by both methods; other fields, other machines.",
        "experiments.forwarding_mission.experiment",
    ),
    "productivity": Entry(
        "How much wood per hour? Single logs, piles, unloading; compared with the shortest possible time and "
        "operators.",
        "experiments.productivity.experiment",
    ),
    "faults": Entry(
        "Is every fault of the catalogue answered in time, and does work without faults go on? 45 faults at random "
        "moments; nominal hours.",
        "experiments.faults.experiment",
    ),
    "soak": Entry(
        "Does memory stay constant and is no frame lost in half an hour at the control rate?",
        "experiments.timing.soak",
    ),
}


def load(name: str) -> Callable[[Options, Console], Result]:
    """The ``run`` function of an experiment."""
    runner: Callable[[Options, Console], Result] = import_module(EXPERIMENTS[name].module).run
    return runner
