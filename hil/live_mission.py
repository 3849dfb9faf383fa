"""A whole mission live: the planner's process runs the activity manager, the plant's has the site of the mission."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console

from autonomy.manager.tally import Load
from autonomy.missions.model import ForwardingMission
from hil.display import Display
from hil.forwarded_report import report_loads
from hil.live import LiveOptions, LiveRun
from hil.mission import MissionSummary
from hil.mission_site import site_of
from host.exits import Exit, Stopped

SITE: Final = "site.json"


class LiveMission(LiveRun[MissionSummary]):
    """Does the mission of ``file``; ``logs`` more than 0: so many along the route instead of those of the mission.

    Raises:
        ValueError: the machine cannot do it.
    """

    def __init__(
        self, options: LiveOptions, display: Display, file: Path, mission: ForwardingMission, way: str, logs: int
    ) -> None:
        super().__init__(options, display)
        site = options.directory / SITE
        site_of(mission, options.profile, options.seed, options.truth, logs).save(site)
        self.plant_is_told = ("--site", site)
        self.planner_is_told = ("--mission", file, "--way", way)
        self._states: list[tuple[float, str]] = []
        self._mission = mission

    def _heard(self, name: str, message: dict[str, Any]) -> None:
        match name, message.get("event"):
            case "autonomy", "state":
                self._states.append((round(self._seconds, 2), str(message["state"])))
                self._display.phase(str(message["state"]))
                self._display.event(f"  {message['words']}")
            case "autonomy", "load":
                self._display.event(f"{message['logs']} logs on board")
            case "autonomy", "order":
                refused = f": refused, {message['refused']}" if "refused" in message else ""
                self._display.event(f"a person orders {message.get('order', 'something')}{refused}", "magenta")
            case "autonomy", "phase":
                pass  # of the crane: within the state, and in the planner's own lines
            case _:
                super()._heard(name, message)

    def _summary(self, sim_port: int) -> MissionSummary:
        lying = self._ask(sim_port, "verdict")["logs"]
        told, options = self._outcome, self._options
        loads = msgspec.convert(told.get("loads", []), list[Load])
        report_loads(options.directory, loads, self._mission, options.profile, datetime.now(UTC), time.monotonic_ns())
        return MissionSummary(
            finished=self._done,
            failure=self._failure,
            logs=len(lying),
            in_bunk=sum(log["in_bunk"] for log in lying),
            loaded=int(told.get("loaded", 0)),
            given_up={int(log["log"]): str(log["reason"]) for log in told.get("given_up", ())},
            seconds=self._seconds,
            driven_m=float(told.get("driven_m", 0.0)),
            stops=self._operator.stops,
            refused=self._report.refused if self._report else 0,
            states=tuple(self._states),
            directory=str(self._options.directory),
        )


def run_live_mission(
    file: Path, mission: ForwardingMission, options: LiveOptions, way: str, logs: int, console: Console
) -> MissionSummary:
    """The mission as separate processes in real time.

    Raises:
        Stopped: machine or mission cannot be used, or a process cannot start or dies.
    """
    options.directory.mkdir(parents=True, exist_ok=True)
    title = f"{options.profile.title}: {mission.name or 'a mission'}, live, seed {options.seed}"
    with Display(console, title) as display:
        try:
            run = LiveMission(options, display, file, mission, way, logs)
        except ValueError as error:
            raise Stopped(Exit.CONFIGURATION, str(error)) from None
        return run.run()
