"""The one-log job on virtual time: the log lands in the bunk, and equal seeds give equal bytes."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pytest
from rich.console import Console

from hil.demo.lockstep import run_lockstep
from hil.demo.summary import Summary
from hil.replay.recording import files_of
from hil.replay.replay import replay
from host.exit_codes import ExitCode
from tests.codes import numbers_in

pytestmark = pytest.mark.long


def job(seed: int, directory: Path, limit_s: float = 120.0, machine: str = "palms_471") -> Summary:
    return run_lockstep(machine, seed, "nominal", directory, limit_s, Console(file=io.StringIO()))


def digest(directory: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(directory.iterdir())}


def test_the_log_lands_in_the_bunk_and_the_recording_replays(tmp_path: Path) -> None:
    summary = job(101, tmp_path / "run")
    assert summary.in_bunk, summary.verdict
    assert summary.exit_code is ExitCode.OK
    assert summary.stops == 0
    assert numbers_in(summary.grasp)[:3] == [1, 0, 1], "one log, the first, of one"
    assert (tmp_path / "run" / "crane0.log").read_text().count("\n") > 50_000
    result = replay(files_of(tmp_path / "run"))
    assert result.agrees, result
    assert result.ticks == summary.ticks


def test_the_forwarder_loads_its_log_at_its_driving_height(tmp_path: Path) -> None:
    summary = job(104, tmp_path / "run", machine="aoro_fc8")
    assert summary.in_bunk, summary.verdict
    assert (summary.exit_code, summary.stops) == (ExitCode.OK, 0)


def test_equal_seeds_give_equal_bytes_and_different_seeds_do_not(tmp_path: Path) -> None:
    first, again, other = (job(s, tmp_path / n, 4.0) for s, n in ((5, "a"), (5, "b"), (6, "c")))
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    assert digest(tmp_path / "a")["crane0.log"] != digest(tmp_path / "c")["crane0.log"]
    assert first.ticks == again.ticks
    assert first.ticks == other.ticks


def test_an_unfinished_job_is_reported_as_unfinished(tmp_path: Path) -> None:
    summary = job(5, tmp_path / "short", 4.0)
    assert not summary.in_bunk
    assert summary.exit_code is ExitCode.FIGURE_MISSED
    assert 4 in numbers_in(summary.failure) and summary.verdict
