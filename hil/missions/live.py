"""A whole mission live: the planner's process runs the activity manager, the plant's process has the site."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console

from autonomy.manager.tally import Load
from autonomy.missions.model import ForwardingMission
from hil.harness.display import Display
from hil.harness.live import LiveOptions, LiveRun
from hil.missions.forwarded_report import report_loads
from hil.missions.site import site_of
from hil.missions.summary import MissionSummary
from host.exit_codes import CommandFailed, ExitCode

SITE: Final = "site.json"


class LiveMission(LiveRun[MissionSummary]):
    """Runs the mission of ``file``; ``logs`` > 0 lays that many along the route instead of those of the mission.

    Raises:
        SetupError: the machine cannot drive the mission.
    """

    def __init__(
        self, options: LiveOptions, display: Display, file: Path, mission: ForwardingMission, manager: str, logs: int
    ) -> None:
        super().__init__(options, display)
        site = options.directory / SITE
        site_of(mission, options.profile, options.seed, options.truth, logs).save(site)
        self.plant_arguments = ("--site", site)
        self.planner_arguments = ("--mission", file, "--manager", manager)
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
        )


def run_live_mission(
    file: Path, mission: ForwardingMission, options: LiveOptions, manager: str, logs: int, console: Console
) -> MissionSummary:
    """Run the mission as separate processes in real time.

    Raises:
        CommandFailed: machine or mission cannot be used, or a process cannot start or dies.
    """
    options.directory.mkdir(parents=True, exist_ok=True)
    title = f"{options.profile.title}: {mission.name or 'a mission'}, live, seed {options.seed}"
    with Display(console, title) as display:
        try:
            run = LiveMission(options, display, file, mission, manager, logs)
        except ValueError as error:
            raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
        return run.run()
