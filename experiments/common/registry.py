"""The experiments by name.  Each module has ``run(options, console) -> Result``, imported when it is asked for."""

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
    """What the command line says; ``trials``, ``repetitions`` and ``minutes`` None are the experiment's default,
    ``docs`` the folder to refresh, ``bus`` where the frames of a live experiment travel (wire or vcan), ``data`` a
    folder to judge on.
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
    """What an experiment is about, and where it is."""

    sentence: str
    module: str


EXPERIMENTS: Final = {
    "plant": Entry(
        "Does the simulated machine behave like steel, oil and wood? Grasps, closed-form physics, endurance, speed.",
        "experiments.plant.experiment",
    ),
    "calibration": Entry(
        "Does calibration recover what the plant hides? Dead-bands, gains, delays, zeros, sag; many individuals.",
        "experiments.calibration.experiment",
    ),
    "joint-tracking": Entry(
        "Which joint law follows best, rests nearest and quiets its valves? Four laws, both machines, disturbances.",
        "experiments.joint_tracking.experiment",
    ),
    "crane-accuracy": Entry(
        "How near does the tip come to its goal, by encoders and in truth? Paper B's four goals, calibrated machines.",
        "experiments.crane_accuracy.experiment",
    ),
    "timing": Entry(
        "Does the controller wake on time and cost little? Beside cyclictest and a plain loop, quiet and loaded.",
        "experiments.timing.experiment",
    ),
    "plc": Entry(
        "Does a PLC between crane0 and the valves do the job as well? Both roles beside CAN: logs, accuracy, latency.",
        "experiments.plc.experiment",
    ),
    "grasp-network": Entry(
        "Is it paper A's network, what has it learnt, what does a picture cost? Parameters, Cornell folds, latency.",
        "experiments.grasp_network.experiment",
    ),
    "detector": Entry(
        "Are logs found in worlds that look otherwise than those of the training? mAP of boxes and masks; photographs.",
        "experiments.detector.experiment",
    ),
    "log-localization": Entry(
        "Where is the log? Paper B's approach to two logs at 0, 45 and 90 degrees: its own pipeline and ours.",
        "experiments.log_localization.experiment",
    ),
    "grasp-configs": Entry(
        "How many grasps hold, how good are they? Paper A's twelve configurations, camera to lift, three planners.",
        "experiments.grasp_configs.experiment",
    ),
    "navigation": Entry(
        "Does the machine find its path and stay on it? Paper B's four waypoints, six starts, mud, slope; both ways.",
        "experiments.navigation.experiment",
    ),
    "forwarding-mission": Entry(
        "Does the forwarder bring in 24 logs alone? Paper B's trial both ways; other fields, other machines.",
        "experiments.forwarding_mission.experiment",
    ),
    "productivity": Entry(
        "How much wood in an hour? Single logs, piles, a full bunk unloaded; beside the shortest possible and people.",
        "experiments.productivity.experiment",
    ),
    "soak": Entry(
        "Does nothing grow and no frame get lost in half an hour at the control rate?",
        "experiments.timing.soak",
    ),
}


def load(name: str) -> Callable[[Options, Console], Result]:
    """The experiment's ``run``."""
    runner: Callable[[Options, Console], Result] = import_module(EXPERIMENTS[name].module).run
    return runner
