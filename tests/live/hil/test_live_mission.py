"""A mission as processes on SocketCAN, in simulated time: planner, controller, guard, plant, recorder.

On the way the planner's process is frozen for longer than its lease: the machine stands, and goes on only when the
operator has armed it again.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.hil.short_missions import mission_file
from tests.live.host.lab_runs import in_simulated_time

FROZEN = """
import os, signal, sys, time
from pathlib import Path
from rich.console import Console
import hil.missions.live as live
from autonomy.missions.mission_file import load_mission
from hil.harness.live import LiveOptions
from machine.loading.profile_file import load_profile

class Frozen(live.LiveMission):
    at_s = None

    def _receive(self):
        super()._receive()
        now, planner = time.monotonic(), self._processes.children.get("autonomy")
        if self._states and self._states[-1][1] == "SEARCH" and self.at_s is None and self._seconds > 4.0:
            self.at_s = now
            planner.process.send_signal(signal.SIGSTOP)
            self._display.event("FREEZE")
        elif self.at_s is not None and self.at_s > 0.0 and now > self.at_s + 5.0:
            self.at_s = 0.0
            planner.process.send_signal(signal.SIGCONT)
            self._display.event("THAW")

file, out = Path(sys.argv[1]), Path(sys.argv[2])
live.LiveMission = Frozen
options = LiveOptions("aoro_fc8", load_profile("aoro_fc8"), 1, "nominal", "vcan", out, 0, 300.0, 20)
mission = load_mission(file, route_wanted=True).mission
summary = live.run_live_mission(file, mission, options, "ours", 0, Console())
summary.save(out / "summary.json")
sys.exit(summary.exit_code)
"""


@pytest.mark.timeout(900)
@pytest.mark.bears(math.inf)
def test_a_log_is_loaded_although_the_planner_freezes_on_the_route(tmp_path: Path) -> None:
    path, out = mission_file(tmp_path / "mission.geojson", (8.0, 3.6, 80.0)), tmp_path / "run"
    lines, told = in_simulated_time(out, "-c", FROZEN, path, out)
    assert told["finished"] and told["in_bunk"] == told["loaded"] == told["logs"] == 1
    assert told["stops"] == 1, "the lease ran out once, and nothing else was wrong"
    freeze, thaw = (next(i for i, line in enumerate(lines) if word in line) for word in ("FREEZE", "THAW"))
    stopped = next(i for i, line in enumerate(lines) if "STOP: " in line)
    assert freeze < stopped < thaw
    seconds = [float(lines[i].split()[0]) for i in (freeze, stopped)]
    assert seconds[1] - seconds[0] < 0.2 + 0.2, "within the lease"
    assert any("ARM" in line.split() for line in lines[stopped:]), "the operator's button"
