"""The one-log job on virtual time: the log lands in the bunk of several machines; equal seeds give equal bytes."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pytest
from rich.console import Console

from autonomy.grasp.planners import PlannerChoice
from hil.demo.lockstep import run_lockstep
from hil.demo.summary import Summary
from hil.plc import write_plc_profile
from hil.replay.recording import files_of
from hil.replay.replay import replay
from host.exit_codes import ExitCode
from sim.individual import beside
from tests.codes import numbers_in
from tests.machine.own_machine import NAME, made


def job(seed: int, directory: Path, limit_s: float = 120.0, machine: object = "palms_471", *more: object) -> Summary:
    screen = Console(file=io.StringIO())
    return run_lockstep(str(machine), seed, "nominal", directory, limit_s, screen, *more)


def digest(directory: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(directory.iterdir())}


@pytest.mark.long
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


@pytest.mark.long
def test_the_forwarder_loads_its_log_at_its_driving_height(tmp_path: Path) -> None:
    summary = job(104, tmp_path / "run", machine="aoro_fc8")
    assert summary.in_bunk, summary.verdict
    assert (summary.exit_code, summary.stops) == (ExitCode.OK, 0)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Summary]:
    """A job that ends after 4 s."""
    directory = tmp_path_factory.mktemp("short") / "run"
    return directory, job(5, directory, 4.0)


@pytest.mark.long
def test_equal_seeds_give_equal_bytes_and_different_seeds_do_not(short: tuple[Path, Summary], tmp_path: Path) -> None:
    directory, first = short
    again, other = (job(s, tmp_path / n, 4.0) for s, n in ((5, "b"), (6, "c")))
    assert digest(directory) == digest(tmp_path / "b")
    assert digest(directory)["crane0.log"] != digest(tmp_path / "c")["crane0.log"]
    assert first.ticks == again.ticks == other.ticks


@pytest.mark.long
def test_an_unfinished_job_is_reported_as_unfinished(short: tuple[Path, Summary]) -> None:
    _, summary = short
    assert not summary.in_bunk
    assert summary.exit_code is ExitCode.FIGURE_MISSED
    assert 4 in numbers_in(summary.failure) and summary.verdict


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_log_detected_by_a_camera_lands_in_the_bunk(seed: int, tmp_path: Path) -> None:
    summary = job(seed, tmp_path, 120.0, "palms_471", "stick")
    assert summary.in_bunk, f"{summary.verdict} {summary.failure}"
    assert summary.exit_code is ExitCode.OK


def test_paper_as_machine_lays_the_log_into_the_bunk(tmp_path: Path) -> None:
    """Camera on the stick, virtual scene, network of Table I, and the PLC's PD at 50 Hz on 0.1 degrees."""
    profile, quiet = write_plc_profile("palms_471", "references", tmp_path), Console(file=io.StringIO())
    planner = PlannerChoice("cnn")
    summary = run_lockstep(str(profile), 1, "nominal", tmp_path / "run", 120.0, quiet, "stick", planner=planner)
    assert summary.exit_code is ExitCode.OK, f"{summary.verdict} {summary.failure}"
    assert summary.stops == 0


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_machine_from_data_alone_does_the_job_and_replays(tmp_path: Path) -> None:
    """Drafted from the answers of the example."""
    profile = made(tmp_path / "mine")
    truth = beside(str(profile), NAME, "nominal")
    summary = run_lockstep(str(profile), 3, truth, tmp_path / "run", 120.0, Console(file=io.StringIO()))
    assert summary.in_bunk, summary.verdict
    assert (summary.stops, summary.refused_setpoints) == (0, 0)
    assert replay(files_of(tmp_path / "run"), profile=str(profile)).agrees
