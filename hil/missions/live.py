"""A whole mission live: the planner's process runs the activity manager, the plant's process has the site.

With a detector other than the perfect one, the plant serves its front camera, and a process of its own detects the logs
in the pictures with the camera's surveyed mount (`hil.missions.detectors` has the same in lockstep).
"""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console

from autonomy.calibration.profile_file import Change, write_profile
from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from autonomy.manager.tally import Load
from autonomy.missions.model import ForwardingMission
from controller.guard.__main__ import profile_path
from hil.calibration import surveyed_profile
from hil.harness.display import Display
from hil.harness.live import LiveOptions, LiveRun
from hil.missions.detectors import CAMERA, PERFECT, check_camera
from hil.missions.site import site_of
from hil.missions.summary import MissionSummary, report_loads
from host.exit_codes import CommandFailed, ExitCode
from sim.instruments import seen_with

SITE: Final = "site.json"
SURVEYED_PROFILE: Final = "surveyed.toml"
LOCALIZERS: Final = {"ours": "ours", "faithful": "paper-b"}
"""Names of the detectors' methods on the command line of `autonomy.perception`."""


def _with_camera(options: LiveOptions, detector: str) -> LiveOptions:
    """Return the options with the camera that a detector needs.

    Raises:
        InputRefused: the machine has no front camera.
    """
    if detector == PERFECT:
        return options
    check_camera(options.profile)
    return replace(options, camera=CAMERA)


def write_surveyed(options: LiveOptions, path: Path) -> Path:
    """Write the profile with the front camera as a survey before the run finds it; the detector alone gets it.

    Raises:
        ValueError: the truth cannot be used, or the file cannot be written.
    """
    truth = seen_with(options.truth, options.seed, options.profile.name)
    surveyed_camera = surveyed_profile(options.profile, truth, CAMERA, options.seed).cameras[CAMERA]
    changed: list[Change] = [
        (("cameras", CAMERA, "position_m"), [round(v, 5) for v in surveyed_camera.position_m], "surveyed"),
        (("cameras", CAMERA, "rpy_rad"), [round(v, 6) for v in surveyed_camera.rpy_rad], "surveyed"),
        (("cameras", CAMERA, "depth_scale"), round(surveyed_camera.depth_scale, 6), "surveyed"),
    ]
    path.unlink(missing_ok=True)
    write_profile(Path(profile_path(options.profile_name)), path, changed, "before the run")
    return path


class LiveMission(LiveRun[MissionSummary]):
    """Runs the mission of ``file``; ``logs`` > 0 lays that many along the route instead of those of the mission.

    ``terrain`` is the kind of ground, one of `sim.ground.terrain.KINDS`, ``detector`` a detector of
    `hil.missions.detectors`.

    Raises:
        InputRefused: the machine cannot drive the mission.
    """

    def __init__(
        self,
        options: LiveOptions,
        display: Display,
        file: Path,
        mission: ForwardingMission,
        manager: str,
        logs: int,
        terrain: str = "flat",
        detector: str = PERFECT,
        planner: PlannerChoice = OUR_PLANNER,
    ) -> None:
        super().__init__(_with_camera(options, detector), display)
        site = options.directory / SITE
        site_of(mission, options.profile, options.seed, options.truth, logs, terrain).save(site)
        self.plant_arguments = ("--site", site)
        self.planner_arguments = ("--mission", file, "--manager", manager, *planner.arguments())
        if detector != PERFECT:
            self.planner_arguments += ("--memory",)
            surveyed = write_surveyed(options, options.directory / SURVEYED_PROFILE)
            self.detector_arguments = ("--profile", surveyed, "--driving", "--localizer", LOCALIZERS[detector])
        self._states: list[tuple[float, str]] = []
        self._mission = mission

    def _on_message(self, name: str, message: dict[str, Any]) -> None:
        match name, message.get("event"):
            case "autonomy", "state":
                self._states.append((round(self._seconds, 2), str(message["state"])))
                self._display.phase(str(message["state"]))
                self._display.event(f"  {message['words']}")
            case "autonomy", "load":
                self._display.event(f"{message['logs']} logs on board")
            case "autonomy", "remark":
                self._display.event(str(message["texts"][-1]), "yellow")
            case "autonomy", "order":
                refused = f": refused, {message['refused']}" if "refused" in message else ""
                self._display.event(f"operator command: {message.get('order', 'unknown')}{refused}", "magenta")
            case "autonomy", "phase":
                pass  # phases of the crane job; the states of the manager are shown instead
            case _:
                super()._on_message(name, message)

    def _summarize(self, sim_port: int) -> MissionSummary:
        lying = self._request(sim_port, "verdict")["logs"]
        outcome, options = self._outcome, self._options
        loads = msgspec.convert(outcome.get("loads", []), list[Load])
        report_loads(options.directory, loads, self._mission, options.profile, datetime.now(UTC), time.monotonic_ns())
        return MissionSummary(
            finished=self._done,
            failure=self._failure,
            logs=len(lying),
            in_bunk=sum(log["in_bunk"] for log in lying),
            loaded=int(outcome.get("loaded", 0)),
            given_up={int(log["log"]): str(log["reason"]) for log in outcome.get("given_up", ())},
            seconds=self._seconds,
            driven_m=float(outcome.get("driven_m", 0.0)),
            stops=self._operator.stops,
            refused=self._report.refused if self._report else 0,
            states=tuple(self._states),
            directory=str(self._options.directory),
            remarks=tuple(map(str, outcome.get("remarks", ()))),
        )


def run_live_mission(
    file: Path,
    mission: ForwardingMission,
    options: LiveOptions,
    manager: str,
    logs: int,
    console: Console,
    terrain: str = "flat",
    detector: str = PERFECT,
    planner: PlannerChoice = OUR_PLANNER,
) -> MissionSummary:
    """Run the mission as separate processes in real time.

    Raises:
        CommandFailed: machine or mission cannot be used, or a process cannot start or dies.
    """
    options.directory.mkdir(parents=True, exist_ok=True)
    title = f"{options.profile.title}: {mission.name or 'a mission'}, live, seed {options.seed}"
    with Display(console, title) as display:
        try:
            run = LiveMission(options, display, file, mission, manager, logs, terrain, detector, planner)
        except ValueError as error:
            raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
        return run.run()
