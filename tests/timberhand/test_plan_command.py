"""``timberhand plan``: what it says of good and of bad files, its JSON, its exit codes, its pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from typer.testing import CliRunner

from host.exit_codes import ExitCode
from recorder.manifest import read
from recorder.recover import is_complete
from runtime.errors import TimberhandError
from runtime.plot_style import MOSS, OIL, RUST, TIMBER
from tests.autonomy.mission_texts import at, gpx, gpx_points
from tests.codes import exit_code_of, numbers_in
from timberhand.cli import app

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
PAPER_B = str(EXAMPLES / "paper_b.geojson")


def run(*arguments: str | Path) -> Any:
    """The result of a ``timberhand plan`` command."""
    return CliRunner().invoke(app, ["plan", *map(str, arguments)], env={"COLUMNS": "200"})


def failure(*arguments: str | Path) -> TimberhandError:
    """Why a command ended."""
    error = run(*arguments).exception
    assert isinstance(error, TimberhandError)
    return error


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.iterdir() if path.is_file()))
def test_every_shipped_example_is_fine(name: str) -> None:
    result = run("check", EXAMPLES / name)
    assert result.exit_code == 0 and name in result.output


def test_check_in_words_and_as_json() -> None:
    said = run("check", PAPER_B).output
    assert {4, 1, 12, 250.0, 2, 24} <= set(numbers_in(said))
    facts = json.loads(run("check", PAPER_B, "--json").output)
    assert (facts["waypoints"], facts["laps"], facts["logs"], facts["logs_to_fetch"]) == (4, 2, 12, 24)
    assert facts["length_m"] == pytest.approx(250.0, abs=0.05) and len(facts["corners"]) == 4


def test_a_bad_mission_ends_with_its_line_and_exit_code_3(tmp_path: Path) -> None:
    bad = tmp_path / "bad.gpx"
    bad.write_text('<gpx><rte>\n<rtept lat="19.9" lon="63.66"/>\n<rtept lat="19.901" lon="63.66"/></rte></gpx>')
    error = failure("check", bad)
    assert exit_code_of(error) == ExitCode.CONFIGURATION
    assert error.code == "mission.swapped-axes" and str(bad) in str(error)
    result = run("check", bad, "--json")
    assert result.exit_code == ExitCode.CONFIGURATION and json.loads(result.output)["codes"] == [error.code]


def test_strict_makes_warnings_fail() -> None:
    assert run("check", EXAMPLES / "route.gpx").exit_code == 0
    assert run("check", EXAMPLES / "route.gpx", "--strict").exit_code == ExitCode.CONFIGURATION


def test_strict_refuses_what_a_file_loses(tmp_path: Path) -> None:
    parts = ([at(0, 0), at(20, 0)], [at(40, 0), at(60, 0)])
    rows = "".join(f"<trkseg>{gpx_points('trkpt', part)}</trkseg>" for part in parts)
    (tmp_path / "t.gpx").write_bytes(gpx(f"<trk>{rows}</trk>"))
    said = json.loads(run("check", tmp_path / "t.gpx", "--json").output)
    assert said["warning_codes"] == ["mission.track-gap", "mission.no-fence"]
    assert len(said["warnings"]) == 2
    assert run("check", tmp_path / "t.gpx").exit_code == 0
    assert run("check", tmp_path / "t.gpx", "--strict").exit_code == ExitCode.CONFIGURATION


@pytest.mark.parametrize(
    ("words", "code", "exit_code"),
    [
        (("check", PAPER_B, "--profile", "palms_471"), "plan.stationary-machine", ExitCode.CONFIGURATION),
        (("check", PAPER_B, "--profile", "none"), "profile.unknown-name", ExitCode.CONFIGURATION),
        (("convert", PAPER_B, "m.dxf"), "plan.output-format", ExitCode.USAGE),
        (("convert", PAPER_B, "."), "plan.output-format", ExitCode.USAGE),
        (("convert", PAPER_B, "no/m.geojson"), "mission.not-written", ExitCode.CONFIGURATION),
        (("show", PAPER_B, "--png", "a.jpg"), "plan.map-format", ExitCode.USAGE),
        (("show", PAPER_B, "--png", "."), "plan.map-format", ExitCode.USAGE),
    ],
)
def test_what_cannot_be_done_is_refused(
    words: tuple[str, ...], code: str, exit_code: ExitCode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    error = failure(*words)
    assert (error.code, exit_code_of(error)) == (code, exit_code) and not list(tmp_path.iterdir())


def test_convert_with_a_harvest(tmp_path: Path) -> None:
    out = tmp_path / "m.geojson"
    said = run("convert", EXAMPLES / "site.kml", out, "--logs", EXAMPLES / "harvest.hpr").output
    assert {3, 2, 1, 7} <= set(numbers_in(said))
    assert json.loads(run("check", out, "--json").output)["logs"] == 7


@pytest.mark.parametrize(
    ("kind", "lost"), [("plan", "note logs not in m.plan"), ("gpx", "fences"), ("kml", "option laps")]
)
def test_convert_to_other_programs_says_what_is_lost(kind: str, lost: str, tmp_path: Path) -> None:
    out = tmp_path / f"m.{kind}"
    assert lost in run("convert", PAPER_B, out).output
    assert json.loads(run("check", out, "--json").output)["waypoints"] == 4


def test_show_draws_everything(tmp_path: Path) -> None:
    logs = EXAMPLES / "harvest.hpr"
    assert run("show", EXAMPLES / "site.kml", "--logs", logs, "--png", tmp_path / "a.png").exit_code == 0
    with Image.open(tmp_path / "a.png") as picture:
        inks = {color for _, color in picture.convert("RGB").getcolors(1 << 20)}
    assert {OIL, MOSS, RUST, TIMBER} <= {f"#{r:02x}{g:02x}{b:02x}" for r, g, b in inks}  # route, fence, keep-out, logs
    assert run("show", logs, "--png", tmp_path / "logs.png").exit_code == 0, "logs alone"


@pytest.mark.parametrize("name", ["a $\\x$ b", "50 $^$"])
def test_names_are_drawn_as_they_are(name: str, tmp_path: Path) -> None:
    mission = json.loads(Path(PAPER_B).read_text())
    mission["timberhand"]["name"] = name
    log = next(f for f in mission["features"] if f["properties"]["role"] == "log")
    mission["features"].append(log | {"properties": {"role": "landing", "name": name}})
    (tmp_path / "priced.geojson").write_text(json.dumps(mission))
    assert run("show", tmp_path / "priced.geojson", "--png", tmp_path / "a.png").exit_code == 0


def test_an_interrupted_demonstration_leaves_a_whole_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hil.demonstrations.demonstrate", interrupted)
    run("demonstrate", tmp_path / "a.csv", "--record", tmp_path / "by-hand")
    assert is_complete(tmp_path / "by-hand" / "run.mcap") and read(tmp_path / "by-hand").complete
