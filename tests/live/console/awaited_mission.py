"""A live run that awaits its mission.

``python -m tests.live.console.awaited_mission FOREST --out DIR --console-port PORT``

Everything is as in `timberhand mission run` on the wire, but the planner waits for an upload, as on a machine, and no
stand-in presses ARM: the person at the page does both.  FOREST is a mission file whose logs lie in the forest; the
planner does not get it.  Uploads come from the folder ``missions`` beside the run.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console

from autonomy.missions.mission_file import load_mission
from can_dbc.messages.crane import OperatorAction, StateReport
from hil.harness import live
from hil.harness.display import Display
from hil.harness.live import LiveOptions
from hil.harness.operator import Operator
from hil.missions.live import LiveMission
from hil.missions.summary import MissionSummary
from machine.loading.profile_file import load_profile, profile_hash

PROFILE = "aoro_fc8"
LIMIT_S = 900.0
START_S = 240.0
"""The console starts with the lowest priority, and a busy host gives it little."""


class Bystander(Operator):
    """Presses nothing, and only counts the stops."""

    def __init__(self, code: int) -> None:
        super().__init__(code, _nothing, max_stops=sys.maxsize)

    def step(self, report: StateReport) -> bytes | None:
        super().step(report)
        return None


def _nothing(action: OperatorAction, report: StateReport) -> None:
    pass


class AwaitedMission(LiveMission):
    """`LiveMission` whose planner waits, and whose operator is at the page."""

    def __init__(self, options: LiveOptions, display: Display, forest: Path) -> None:
        super().__init__(options, display, forest, load_mission(forest).mission, "ours", 0)
        self.planner_arguments = ("--missions", "missions")
        self._operator = Bystander(profile_hash(options.profile))


def main() -> int:
    """Run it; the exit code is that of `timberhand mission run`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("forest", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--console-port", type=int, required=True)
    told = parser.parse_args()
    told.out.mkdir(parents=True)
    live.START_S = START_S
    options = LiveOptions(
        PROFILE, load_profile(PROFILE), 1, "nominal", "wire", told.out, told.console_port, LIMIT_S, sys.maxsize
    )
    try:
        with Display(Console(), "a mission of the page") as display:
            summary: MissionSummary = AwaitedMission(options, display, told.forest).run()
    except KeyboardInterrupt:
        return 130
    summary.save(told.out / "summary.json")
    return int(summary.exit_code)


if __name__ == "__main__":
    sys.exit(main())
