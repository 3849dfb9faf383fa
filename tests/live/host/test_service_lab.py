"""The services under a real systemd in user-mode Linux."""

from __future__ import annotations

import math

import pytest

from host.service_lab.host import missing
from tests.live.host.lab_runs import completed


@pytest.mark.timeout(5000)
@pytest.mark.bears(math.inf)
def test_a_log_is_loaded_and_the_valves_are_neutral_after_every_failure_of_controller_guard_and_bus() -> None:
    if fault := missing():
        pytest.skip(f"service lab: {fault}")
    result = completed("host.service_lab", 2400)
    ways = {"kill", "hang", "stop", "guard_kill", "guard_hang", "down", "unplugged"}
    assert {trial["way"] for trial in result["trials"]} == ways
    figures = result["figures"]
    assert figures["controller_locked_kb"] > 0 and figures["guard_locked_kb"] > 0
    assert {"update_refused_s", "update_stays_s", "update_return_s"} <= figures.keys()
    seen = {f"perception_{name}" for name in ("seen_s", "kill_back_s", "hang_back_s", "pulled_told_s", "pulled_back_s")}
    assert seen <= figures.keys()
    assert "loading_loaded_s" in figures
