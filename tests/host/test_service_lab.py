"""The services under a real systemd in user-mode Linux: the whole lab, and what it is built from."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from host.service_lab.host import missing
from host.service_lab.trial import MOVING

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_controller_and_guard_die_and_lose_their_bus_and_the_valves_are_neutral() -> None:
    if fault := missing():
        pytest.skip(f"service lab: {fault}")
    done = subprocess.run(
        [sys.executable, "-m", "host.service_lab", "--timeout", "900"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert result["failed"] == [], done.stderr
    assert done.returncode == 0
    ways = {"kill", "hang", "stop", "guard_kill", "guard_hang", "down", "unplugged"}
    assert {trial["way"] for trial in result["trials"]} == ways
    figures = result["figures"]
    assert figures["controller_locked_kb"] > 0 and figures["guard_locked_kb"] > 0
    if result["inconclusive"]:
        pytest.skip(f"inconclusive: {result['inconclusive']}")


def test_the_states_that_count_as_moving_are_the_valve_nodes_own() -> None:
    from sim.nodes.valve import ValveState

    assert set(MOVING) == {ValveState.ACTIVE, ValveState.RAMP}
