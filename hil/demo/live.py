"""The one-log job live: every part of the machine is a process of its own, in real time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from rich.console import Console

from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from hil.demo.summary import Summary, is_settled, outcome_sentence
from hil.harness.display import Display
from hil.harness.live import LiveOptions, LiveRun
from machine.loading.profile_file import load_profile

SETTLE_S: Final = 10.0  # a bowed log rocks in the bunk for seconds


class OneLogRun(LiveRun[Summary]):
    """The planner lays the log chosen by the seed into the bunk."""

    def _summarize(self, sim_port: int) -> Summary:
        self._display.event("waiting for the plant's evaluation")
        limit = time.monotonic() + SETTLE_S
        verdict = self._request(sim_port, "verdict")
        while not is_settled(verdict) and time.monotonic() < limit:
            time.sleep(0.2)
            verdict = self._request(sim_port, "verdict")
        last = self._report
        return Summary(
            in_bunk=bool(verdict["success"]),
            verdict=outcome_sentence(verdict),
            failure=self._failure,
            seconds=self._seconds,
            stops=self._operator.stops,
            ticks=round(self._seconds * self._options.profile.rate_hz) - (last.missed_ticks if last else 0),
            missed_ticks=last.missed_ticks if last else 0,
            frames=last.frames_received if last else 0,
            refused_setpoints=last.refused if last else 0,
            grasp=self._grasp,
            closings=self._closings,
            directory=str(self._options.directory),
        )


def run_live(
    name: str,
    seed: int,
    truth: str,
    bus: str,
    directory: Path,
    page: int,
    limit_s: float,
    max_stops: int,
    console: Console,
    plc_link: str = "modbus",
    camera: str = "",
    foxglove_port: int = 0,
    planner: PlannerChoice = OUR_PLANNER,
) -> Summary:
    """Run the job as separate processes in real time.

    Raises:
        CommandFailed: a process cannot start or dies.
    """
    profile = load_profile(name)
    directory.mkdir(parents=True, exist_ok=True)
    options = LiveOptions(
        name, profile, seed, truth, bus, directory, page, limit_s, max_stops, plc_link, camera, foxglove_port
    )
    with Display(console, f"{profile.title}: one log into the bunk, live, seed {seed}") as display:
        run = OneLogRun(options, display)
        run.planner_arguments += planner.arguments()
        return run.run()
