"""The one-log job with the camera on the stick, in virtual time: our machine, and paper A's."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from autonomy.grasp.planners import PlannerChoice
from hil.demo.lockstep import run_lockstep
from hil.plc import write_plc_profile
from host.exit_codes import ExitCode


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_log_detected_by_a_camera_lands_in_the_bunk(seed: int, tmp_path: Path) -> None:
    summary = run_lockstep("palms_471", seed, "nominal", tmp_path, 120.0, Console(file=io.StringIO()), "stick")
    assert summary.in_bunk, f"{summary.verdict} {summary.failure}"
    assert summary.exit_code is ExitCode.OK


def test_paper_as_machine_lays_the_log_into_the_bunk(tmp_path: Path) -> None:
    """Camera on the stick, virtual scene, network of Table I, and the PLC's PD at 50 Hz on 0.1 degrees."""
    profile, planner = write_plc_profile("palms_471", "references", tmp_path), PlannerChoice("cnn")
    run = tmp_path / "run"
    quiet = Console(file=io.StringIO())
    summary = run_lockstep(str(profile), 1, "nominal", run, 120.0, quiet, "stick", planner=planner)
    assert summary.exit_code is ExitCode.OK, f"{summary.verdict} {summary.failure}"
    assert summary.stops == 0
