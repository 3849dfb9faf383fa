"""The services under a real systemd in user-mode Linux."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from host.service_lab.host import missing

ROOT = Path(__file__).parents[3]


@pytest.mark.timeout(5000)
@pytest.mark.bears(math.inf)
def test_a_log_is_loaded_and_the_valves_are_neutral_after_every_failure_of_controller_guard_and_bus() -> None:
    if fault := missing():
        pytest.skip(f"service lab: {fault}")
    done = subprocess.run(
        [sys.executable, "-m", "host.service_lab", "--timeout", "2400"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert result["failed"] == [], done.stderr
    assert done.returncode == 0
    ways = {"kill", "hang", "stop", "guard_kill", "guard_hang", "down", "unplugged"}
    assert {trial["way"] for trial in result["trials"]} == ways
    figures = result["figures"]
    assert figures["controller_locked_kb"] > 0 and figures["guard_locked_kb"] > 0
    assert {"update_refused_s", "update_stays_s", "update_return_s"} <= figures.keys()
    seen = {f"perception_{name}" for name in ("seen_s", "kill_back_s", "hang_back_s", "pulled_told_s", "pulled_back_s")}
    assert seen <= figures.keys()
    assert "loading_loaded_s" in figures
