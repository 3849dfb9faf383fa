"""The experiments by name.

Each module has ``run(options, console) -> Result`` and ``page_of(result, trials) -> Page``; it is imported when it is
used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Final

from rich.console import Console

from experiments.common.result import Result
from experiments.common.workers import Workers


@dataclass(frozen=True, slots=True)
class Options:
    """Options of the command line.

    ``trials``, ``repetitions`` and ``minutes``: None is the default of the experiment.  ``docs``: folder whose page is
    rewritten.  ``bus``: bus of a live experiment (wire or vcan).  ``data``: folder with data to evaluate.
    ``keeps_trials``: whether the finished trials stay on the disk after a complete run.
    ``planner``, ``detector``: foreign methods to compare with ours, by entry point (`experiments.common.plugins`).
    """

    seed: int
    truth: str
    profile: str
    out: Path
    trials: int | None = None
    quick: bool = False
    workers: Workers = field(default_factory=Workers)
    docs: Path | None = None
    minutes: float | None = None
    repetitions: int | None = None
    bus: str = "wire"
    data: Path | None = None
    keeps_trials: bool = False
    planner: str = ""
    detector: str = ""

    def selection(self) -> str:
        """Return what of these the command line must say to select the same trials."""
        said = {"--seed": self.seed if self.seed != 1 else None, "--trials": self.trials}
        return "".join(f" {name} {v}" for name, v in said.items() if v is not None) + " --quick" * self.quick


@dataclass(frozen=True, slots=True)
class Entry:
    """The question that an experiment answers, its module, and the folders and files on which its figures depend.

    Where all outcomes are published, the figures are computed anew whenever the page is written, so only what decides
    the outcomes is a source: some definitions of a module stand as ``FILE:NAME,NAME``.

    ``live``: it measures this computer in real time, so it is no campaign and runs alone.  ``clocked``: values of an
    outcome that depend on the speed of the host; a campaign's table leaves them out.  ``scale``: work of the full run
    over that of the quick one, by its plan of trials; ``live_s``: duration of a live one [s].
    """

    sentence: str
    module: str
    sources: tuple[str, ...]
    live: bool = False
    clocked: tuple[str, ...] = ()
    scale: float = 1.0
    live_s: float = 0.0


_PLANT: Final = ("machine", "sim", "can_dbc")
_MACHINE: Final = (*_PLANT, "autonomy", "controller", "hil")
"""The whole machine in lockstep."""
_EYES: Final = ("autonomy/perception", "autonomy/networks.py", "autonomy/weights")
_CRANE: Final = (*_PLANT, "controller", "hil", "autonomy/motion", "autonomy/perception")
_CALIBRATED: Final = (*_CRANE, "autonomy/calibration")
_CRANE_JOB: Final = (*_CRANE, "autonomy/crane_job", "autonomy/grasp", "autonomy/missions/crane_job.py")
_LIVE: Final = ("machine", "can_dbc", "controller", "runtime", "recorder", "hil")


EXPERIMENTS: Final = {
    "plant": Entry(
        "Does the simulated machine behave like steel, oil and wood? Grasps, structure, hydraulics, endurance, speed.",
        "experiments.plant.experiment",
        (*_PLANT, "experiments/plant"),
        scale=40.0,
    ),
    "calibration": Entry(
        "Does calibration recover the hidden truth? Dead-bands, gains, dead times, zeros, sag; many individuals.",
        "experiments.calibration.experiment",
        (*_CALIBRATED, "experiments/calibration"),
        scale=20.0,
    ),
    "generalization": Entry(
        "Does it work in a world that it has never seen? Truths at both ends, all drawn; calibration, then logs.",
        "experiments.generalization.experiment",
        (*_MACHINE, "experiments/generalization"),
        scale=35.0,
    ),
    "joint-tracking": Entry(
        "Which joint law tracks best, rests nearest and closes its valves? Four laws, both machines, disturbances.",
        "experiments.joint_tracking.experiment",
        (*_PLANT, "controller", "experiments/joint_tracking"),
        scale=30.0,
    ),
    "crane-accuracy": Entry(
        "How near does the tip come to its goal, by encoders and truly? Paper B's four goals, calibrated machines.",
        "experiments.crane_accuracy.experiment",
        (*_CALIBRATED, "experiments/crane_accuracy"),
        scale=60.0,
    ),
    "timing": Entry(
        "Does the controller wake on time and cost little? Compared with cyclictest and a sleep loop, quiet and "
        "loaded.",
        "experiments.timing.experiment",
        (*_LIVE, "experiments/timing"),
        live=True,
        live_s=900.0,
    ),
    "rates": Entry(
        "Does the whole forwarder run at 1 kHz? Cost against frames and joints, cranes on one processor.",
        "experiments.timing.rates",
        (*_LIVE, "experiments/timing"),
        live=True,
        live_s=900.0,
    ),
    "vcan": Entry(
        "Are live runs on SocketCAN quiet? Demos and missions in a row, with the clock of each and the host's steal.",
        "experiments.vcan.experiment",
        (*_MACHINE, *_LIVE, "host/vcan_lab", "experiments/vcan"),
        live=True,
        live_s=3600.0,
    ),
    "plc": Entry(
        "Does a PLC between crane0 and the valves work as well? Both roles compared with CAN: logs, accuracy, latency.",
        "experiments.plc.experiment",
        (*_CRANE_JOB, "experiments/plc"),
        scale=20.0,
    ),
    "grasp-network": Entry(
        "Is it paper A's network, what has it learnt, how fast is it? Parameters, Cornell folds, latency.",
        "experiments.grasp_network.experiment",
        ("machine", "autonomy/grasp", *_EYES, "training", "experiments/grasp_network"),
        scale=40.0,
    ),
    "detector": Entry(
        "Are logs found in worlds unlike those of the training? mAP of boxes and masks; photographs.",
        "experiments.detector.experiment",
        (*_PLANT, *_EYES, "training", "experiments/detector"),
        scale=15.0,
    ),
    "log-localization": Entry(
        "How precisely is a log located? Paper B's approach to logs at 0, 45 and 90 degrees: its pipeline and ours.",
        "experiments.log_localization.experiment",
        (*_CALIBRATED, *_EYES, "experiments/log_localization"),
        scale=30.0,
    ),
    "grasp-configs": Entry(
        "How many grasps succeed, how good are they? Paper A's twelve configurations, camera to lift, three planners.",
        "experiments.grasp_configs.experiment",
        (
            *_CRANE_JOB,
            *_CALIBRATED,
            *_EYES,
            "experiments/grasp_configs/trial.py",
            "experiments/grasp_configs/pose_sources.py",
            "experiments/grasp_configs/grasp_categories.py",
            "experiments/grasp_configs/experiment.py:machines_of,jobs_of,MACHINES,FIRST_MACHINE,FIRST_SEED,PAPER_ATTEMPTS",
            "experiments/common/individuals.py",
        ),
        clocked=("see_ms", "plan_ms"),
        scale=155.0,
    ),
    "navigation": Entry(
        "Does the machine follow its path? Paper B's four waypoints, six starts, mud, slope; both methods.",
        "experiments.navigation.experiment",
        (
            *_PLANT,
            "controller",
            "hil",
            "autonomy/localization",
            "autonomy/navigation",
            "autonomy/perception",
            "experiments/navigation",
        ),
        scale=10.0,
    ),
    "parts": Entry(
        "What do single parts do? Movement primitives, swing arms and float valve, levelling, pictures while driving.",
        "experiments.parts.experiment",
        (*_MACHINE, "experiments/parts"),
        scale=5.0,
    ),
    "forwarding-mission": Entry(
        "Does the forwarder load 24 logs by itself? Paper B's trial by both methods; other fields, other machines.",
        "experiments.forwarding_mission.experiment",
        (
            *_MACHINE,
            "experiments/common/mission_trial.py",
            "experiments/common/individuals.py",
            "experiments/common/ground_truth_observer.py",
            "experiments/forwarding_mission/experiment.py:trial,calibrations,missions,perform,drive,short,MACHINES,"
            "FIRST_SEED,FIRST_FIELD,SEEDS_PER_RUN,DETECTORS,LIMIT_S,SHORT_M",
        ),
        scale=440.0,
    ),
    "productivity": Entry(
        "How much wood per hour? Single logs, piles, unloading; compared with the shortest possible time and "
        "operators.",
        "experiments.productivity.experiment",
        (*_MACHINE, "experiments/productivity"),
        scale=50.0,
    ),
    "faults": Entry(
        "Is every fault of the catalogue answered in time, and does work without faults go on? 45 faults at random "
        "moments; nominal hours.",
        "experiments.faults.experiment",
        (*_MACHINE, "experiments/faults"),
        scale=100.0,
    ),
    "soak": Entry(
        "Does memory stay constant and is no frame lost in half an hour at the control rate?",
        "experiments.timing.soak",
        (*_LIVE, "experiments/timing"),
        live=True,
        live_s=1800.0,
    ),
}


def load(name: str) -> Callable[[Options, Console], Result]:
    """Load the ``run`` function of an experiment."""
    runner: Callable[[Options, Console], Result] = import_module(EXPERIMENTS[name].module).run
    return runner
