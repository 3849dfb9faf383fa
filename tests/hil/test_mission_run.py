"""A short mission on the plant, both ways, and the page of the activity manager."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from autonomy.manager.state_chart import diagram, page
from autonomy.manager.transition_table import OURS, PAPER_B
from host.exit_codes import ExitCode
from tests.hil.short_missions import mission_file
from timberhand.cli import app

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_of_the_activity_manager_is_as_the_code_has_it() -> None:
    assert (DOCS / "activity.md").read_text() == page(), "run `timberhand mission states --docs docs`"


@pytest.mark.parametrize("table", [PAPER_B, OURS], ids=["paper_b", "ours"])
def test_every_change_is_in_the_diagram(table) -> None:
    text = diagram(table)
    for (begin, event), end in table.items():
        line = next(x for x in text.splitlines() if x.strip().startswith(f"{begin.name} --> {end.name} "))
        assert event.name.lower().replace("_", " ") in line


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


@pytest.mark.slow
@pytest.mark.computed
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
