"""A machine from data alone: drafted from the example's answers, it does the job and replays."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from hil.demo.lockstep import run_lockstep
from hil.replay.recording import files_of
from hil.replay.replay import replay
from sim.individual import beside
from tests.machine.own_machine import NAME, made

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


def test_the_log_lands_in_the_bunk_and_the_recording_replays(tmp_path: Path) -> None:
    profile = made(tmp_path / "mine")
    truth = beside(str(profile), NAME, "nominal")
    summary = run_lockstep(str(profile), 3, truth, tmp_path / "run", 120.0, Console(file=io.StringIO()))
    assert summary.in_bunk, summary.verdict
    assert (summary.stops, summary.refused_setpoints) == (0, 0)
    assert replay(files_of(tmp_path / "run"), profile=str(profile)).agrees
