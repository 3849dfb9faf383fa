"""A short mission on the plant, with both activity managers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from autonomy.grasp.planners import PlannerChoice
from hil.missions.summary import MissionSummary
from host.exit_codes import ExitCode
from tests.hil.short_missions import mission_file
from timberhand.cli import app


def test_a_file_that_is_no_mission_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.geojson"
    path.write_text("{}")
    result = CliRunner().invoke(app, ["mission", "run", str(path), "--lockstep", "--out", str(tmp_path / "run")])
    assert getattr(result.exception, "exit_code", None) == ExitCode.CONFIGURATION and str(path) in str(result.exception)


def test_a_machine_without_a_carrier_drives_no_mission(tmp_path: Path) -> None:
    path = mission_file(tmp_path / "mission.geojson")
    result = CliRunner().invoke(
        app, ["mission", "run", str(path), "--lockstep", "--profile", "palms_471", "--out", str(tmp_path / "run")]
    )
    assert getattr(result.exception, "code", "") == "mission.stationary-machine"


@pytest.mark.parametrize(
    ("words", "detector", "planner", "cheats"),
    [
        ((), "ours", PlannerChoice("search", 1), False),
        (("--detector", "perfect"), "perfect", PlannerChoice("search", 1), True),
        (
            ("--detector", "paper-b", "--planner", "cnn", "--virtual-cameras", "3"),
            "faithful",
            PlannerChoice("cnn", 3),
            False,
        ),
    ],
)
def test_the_machine_sees_with_its_own_camera_and_perfect_sight_is_called_a_cheat(
    words: tuple[str, ...],
    detector: str,
    planner: tuple[str, int],
    cheats: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[object] = []

    def take_place(*arguments: object) -> MissionSummary:
        given.extend(arguments)
        return MissionSummary(True, "", 0, 0, 0, {}, 1.0, 0.0, 0, 0, (), str(tmp_path))

    monkeypatch.setattr("hil.missions.lockstep.run_mission", take_place)
    path = mission_file(tmp_path / "mission.geojson")
    done = CliRunner().invoke(app, ["mission", "run", str(path), "--lockstep", *words, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert detector in given and planner in given
    assert ("--detector perfect cheats" in done.output) is cheats


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("manager", ["own", "paper-b"])
def test_a_log_beside_the_route_is_brought_to_its_end(tmp_path: Path, manager: str) -> None:
    path = mission_file(tmp_path / "mission.geojson", (8.0, 3.6, 80.0))
    command = ["mission", "run", str(path), "--lockstep", "--manager", manager, "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(app, command)
    told = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert result.exit_code == 0, (told, result.output[-2000:])
    assert told["finished"] and told["in_bunk"] == told["loaded"] == told["logs"] == 1
    assert told["stops"] == told["refused"] == 0
    assert told["states"][-1][1] == "DONE"
    with (tmp_path / "run" / "run.mcap").open("rb") as file:
        maps = [message for _, _, message in make_reader(file).iter_messages(["/logs"])]
    assert len(maps) > told["seconds"] / 3, "the log map, as in a live run"
    assert len(maps[0].data) < max(len(found.data) for found in maps), "the log is found on the way"
