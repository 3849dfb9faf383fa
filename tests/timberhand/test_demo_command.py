"""``timberhand demo``: which run it is, decided from options and from a look at the computer; what is refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from autonomy.grasp.planners import PlannerChoice
from hil.demo.summary import Summary
from host.exit_codes import CommandFailed, ExitCode
from host.lateness import NEED
from host.real_time import BEARABLE_NS, BEARABLE_STOLEN, Finding
from timberhand.cli import app
from timberhand.commands.demo import paced_or_live

QUIET = Finding(BEARABLE_NS, NEED, BEARABLE_STOLEN)
BUSY = Finding(BEARABLE_NS + 1, NEED, 0.0)


@pytest.mark.parametrize("finding", [BUSY, Finding(0, NEED - 0.1, 0.0), Finding(0, NEED, BEARABLE_STOLEN + 1e-6)])
def test_a_computer_that_cannot_hold_the_period_gets_a_paced_run_where_there_is_one(finding: Finding) -> None:
    assert paced_or_live(QUIET, live_only=False) == (False, "")
    paced, sentence = paced_or_live(finding, live_only=False)
    assert paced and sentence
    paced, sentence = paced_or_live(finding, live_only=True)
    assert not paced and sentence


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """What each run of the command is given; none takes place."""
    seen: list[tuple[object, ...]] = []

    def run(*words: object, **more: object) -> Summary:
        seen.append((*words, *more.values()))
        return Summary(True, "", "", 1.0, 0, 200, 0, 0, 0, "", 1, "")

    for kind in ("live", "lockstep", "paced"):
        monkeypatch.setattr(f"hil.demo.{kind}.run_{kind}", partial(run, kind))
    return seen


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch, given: list[tuple[object, ...]]) -> Callable[[], list[object]]:
    """The looks, and then the runs of the command."""
    looks: list[object] = []

    def look() -> Finding:
        looks.append("look")
        return BUSY

    monkeypatch.delenv("TIMBERHAND_LAB", raising=False)
    monkeypatch.setattr("host.real_time.look", look)
    return lambda: looks + [kind for kind, *_ in given]


@pytest.mark.parametrize(
    ("words", "kinds"),
    [
        ("--bus wire", ["look", "paced"]),
        ("--bus wire --camera stick", ["look", "paced"]),
        ("--bus wire --plc", ["look", "paced"]),
        ("--bus wire --plc --plc-link udp", ["look", "live"]),
        ("--bus wire --live", ["live"]),
        ("--no-live", ["paced"]),
        ("--lockstep", ["lockstep"]),
    ],
)
def test_the_look_is_taken_only_where_it_decides(
    words: str, kinds: list[str], ran: Callable[[], list[object]], tmp_path: Path
) -> None:
    done = CliRunner().invoke(app, ["demo", *words.split(), "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert ran() == kinds


@pytest.mark.parametrize("kind", ["lockstep", "no-live", "live"])
def test_the_planner_and_paper_as_machine_reach_the_run(
    kind: str, given: list[tuple[object, ...]], tmp_path: Path
) -> None:
    words = ["demo", f"--{kind}", "--out", str(tmp_path), *(["--bus", "wire"] if kind == "live" else [])]
    CliRunner().invoke(app, [*words, "--planner", "cnn-physical", "--virtual-cameras", "3"])
    CliRunner().invoke(app, [*words, "--paper-a"])
    own, paper_a = given
    assert PlannerChoice("cnn-physical", 3) in own
    for value in (PlannerChoice("cnn", 1), "stick", str(tmp_path / "palms_471_plc.toml")):
        assert value in paper_a


def test_inside_the_lab_no_look_is_taken(
    ran: Callable[[], list[object]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TIMBERHAND_LAB", "uml")
    CliRunner().invoke(app, ["demo", "--bus", "wire", "--out", str(tmp_path)])
    assert ran() == ["live"]


@pytest.mark.parametrize(
    ("free", "detector", "kind"), [(2.0, "perfect", "live"), (2.0, "own", "paced"), (2.6, "own", "live")]
)
def test_a_computer_that_holds_the_period_runs_live(
    free: float,
    detector: str,
    kind: str,
    ran: Callable[[], list[object]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr("host.real_time.look", lambda: msgspec.structs.replace(QUIET, free=free))
    CliRunner().invoke(app, ["demo", "--bus", "wire", "--detector", detector, "--out", str(tmp_path)])
    assert ran() == [kind]


@pytest.mark.parametrize(
    ("words", "camera"),
    [
        ("--lockstep", "stick"),
        ("--lockstep --camera d435", "d435"),
        ("--lockstep --detector perfect", ""),
        ("--lockstep --profile aoro_fc8", ""),
    ],
)
def test_a_camera_that_sees_the_cranes_work_finds_the_log(
    words: str, camera: str, given: list[tuple[object, ...]], tmp_path: Path
) -> None:
    done = CliRunner().invoke(app, ["demo", *words.split(), "--out", str(tmp_path)])
    assert [arguments[7] for arguments in given] == [camera]
    assert ("the planner is told" in done.output) is (camera == "")


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("--lockstep --live", "demo.live-lockstep"),
        ("--lockstep --no-live", "demo.live-lockstep"),
        ("--bus vcan --live", "demo.live-vcan"),
        ("--bus vcan --no-live", "demo.live-vcan"),
        ("--no-live --plc --plc-link udp", "demo.paced-udp"),
        ("--no-live --inject encoder-lift:stuck@1s", "demo.inject-live"),
        ("--bus wire --inject encoder-stuck@1", "demo.inject-live"),
        ("--planner nobody", "planner.unknown"),
        ("--virtual-cameras 5", "planner.no-virtual-camera"),
        ("--planner cnn --virtual-cameras 0", "planner.virtual-cameras"),
        ("--paper-a --planner cnn-physical", "demo.paper-a"),
        ("--paper-a --plc-role valves", "demo.paper-a"),
    ],
)
def test_what_would_be_ignored_is_refused(
    words: str, code: str, ran: Callable[[], list[object]], tmp_path: Path
) -> None:
    refused = CliRunner().invoke(app, ["demo", *words.split(), "--out", str(tmp_path / "run")])
    assert isinstance(refused.exception, CommandFailed)
    assert (refused.exception.code, refused.exception.exit_code) == (code, ExitCode.USAGE)
    assert ran() == [] and not (tmp_path / "run").exists()
