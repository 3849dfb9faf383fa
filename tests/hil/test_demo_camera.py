"""The one-log job with the camera on the stick, in virtual time."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from hil.demo.lockstep import run_lockstep
from host.exit_codes import ExitCode

pytestmark = pytest.mark.long


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_log_detected_by_a_camera_lands_in_the_bunk(seed: int, tmp_path: Path) -> None:
    summary = run_lockstep("palms_471", seed, "nominal", tmp_path, 120.0, Console(file=io.StringIO()), "stick")
    assert summary.in_bunk, f"{summary.verdict} {summary.failure}"
    assert summary.exit_code is ExitCode.OK
