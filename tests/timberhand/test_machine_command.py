"""``timberhand machine``: what `new` drafts passes `check`, and what is broken or contradictory is named."""

from __future__ import annotations

import errno
import json
import shutil
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from host.exit_codes import CommandFailed, ExitCode
from machine.draft.questions import answers_text, example
from tests.codes import coded
from tests.machine.own_machine import NAME, answers, made
from timberhand.cli import app
from timberhand.commands.machine import _ask as asked
from timberhand.machine_files import check, make

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def drafted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example's files, which a test copies before it changes them."""
    return made(tmp_path_factory.mktemp("drafted")).parent


@pytest.fixture
def profile(drafted: Path, tmp_path: Path) -> Path:
    """A copy of the example's files; returns its profile."""
    return shutil.copytree(drafted, tmp_path / "mine") / f"{NAME}.toml"


def problems(profile: Path) -> list[str]:
    return [finding.code for finding in check(str(profile)) if not finding.note]


@st.composite
def machines(draw: st.DrawFn) -> list[tuple[str, Any]]:
    """Changes of the example's answers that are another plausible loader."""
    scale = draw(st.floats(0.8, 1.25))
    nodes = draw(st.permutations([2, 3, 4, 6]))
    bits = draw(st.integers(13, 18))
    changes: list[tuple[str, Any]] = [
        ("kinematics.a2_m", 3.3 * scale),
        ("kinematics.d4_m", 2.55 * draw(st.floats(0.9, 1.2))),
        ("kinematics.theta1_offset_rad", draw(st.floats(-3.0, 3.0))),
        ("kinematics.a3_m", draw(st.floats(-0.1, 0.25))),
        ("masses.boom_kg", 270.0 * scale**2),
        ("joints.lift.delay_s", draw(st.floats(0.03, 0.2))),
        ("joints.tilt.deadband_pct", draw(st.floats(2.0, 30.0))),
        ("grapple.opening_m", draw(st.floats(1.1, 1.6))),
        ("rate_hz", draw(st.sampled_from([100, 200, 250]))),
    ]
    for joint, node in zip(("slew", "lift", "tilt", "rot"), nodes, strict=True):
        sign = draw(st.sampled_from([-1, 1]))
        changes.append((f"joints.{joint}.encoder", {"node": node, "total_counts": 1 << bits, "direction": sign}))
    if draw(st.booleans()):
        changes.append(("joints.rot.encoder", None))
    return changes


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(changes=machines())
def test_whatever_new_drafts_passes_check(changes: list[tuple[str, Any]]) -> None:
    with TemporaryDirectory() as folder:
        profile = made(Path(folder), *changes)
        found = problems(profile)
        assume(found != ["machine.out-of-reach"])  # a shorter crane may not reach the example's places
        assert found == []


def test_new_writes_every_file_and_says_what_comes_next(tmp_path: Path) -> None:
    told = RUNNER.invoke(app, ["machine", "questions"])
    (tmp_path / "answers.toml").write_text(told.stdout)
    arguments = ["machine", "new", str(tmp_path / "mine"), "--answers", str(tmp_path / "answers.toml")]
    drafted = RUNNER.invoke(app, arguments)
    assert drafted.exit_code == ExitCode.OK, drafted.output
    assert "python -m controller.guard.seal" in drafted.stdout
    suffixes = (".toml", ".answers.toml", ".envelope.toml", ".truth.toml", ".urdf")
    assert {p.name for p in (tmp_path / "mine").iterdir()} == {NAME + suffix for suffix in suffixes}
    again = RUNNER.invoke(app, arguments)
    assert isinstance(again.exception, CommandFailed) and again.exception.code == "machine.file-exists"
    assert problems(tmp_path / "mine" / f"{NAME}.toml") == ["guard.envelope-damaged"], "nobody has sealed it"


def test_new_without_answers_and_terminal_is_a_usage_error(tmp_path: Path) -> None:
    failed = RUNNER.invoke(app, ["machine", "new", str(tmp_path)]).exception
    assert isinstance(failed, CommandFailed)
    assert (failed.code, failed.exit_code) == ("machine.no-answers", ExitCode.USAGE)
    failed = RUNNER.invoke(app, ["machine", "new", str(tmp_path), "--urdf", "x", "--urdf-joints", "arm=q1"]).exception
    assert isinstance(failed, CommandFailed) and failed.code == "machine.urdf-joints"


def test_on_a_terminal_every_question_is_asked_until_its_answer_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = {"kinematics.a2_m": ["long", "3.1"], "joints.rot.drive.bore_m": ["-"]}

    def prompt(text: str, default: str) -> str:
        left = typed.get(text.partition(":")[0])
        return left.pop(0) if left else default

    monkeypatch.setattr("typer.prompt", prompt)
    raw = asked({"joints": {"slew": {"lower": -1.0}}})
    assert typed["kinematics.a2_m"] == [] and raw["kinematics"]["a2_m"] == 3.1
    assert "lower" not in raw["joints"]["slew"], "the URDF has answered that"
    assert "bore_m" not in raw["joints"]["rot"]["drive"] and raw["name"] == NAME


def test_answers_that_no_profile_allows_write_nothing(tmp_path: Path) -> None:
    with pytest.raises(CommandFailed, match=r"joints.slew.lower", check=coded("profile.wrong-values")):
        make(answers(("joints.slew.lower", 3.0)), "answers", tmp_path / "mine")
    with pytest.raises(CommandFailed, match=r"joints.slew.encoder", check=coded("profile.wrong-values")):
        make(answers(("joints.slew.encoder.node", 33)), "answers", tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


BROKEN: list[tuple[str, str, str, str, str]] = [
    (".toml", "d4_m = 2.55 ", "d4_m = 2.75 ", "machine.other-geometry", "stick_m is 2.55"),
    (".toml", "d4_m = 2.55 ", "d4_m = 2.75 ", "machine.other-urdf", "d4_m is 2.5500"),
    (".toml", "node = 6 ", "node = 7 ", "config.encoder-node", "use node 6"),
    (".toml", "pick_center_m = [3.2, -4.0]", "pick_center_m = [7.9, -1.0]", "machine.out-of-reach", "do not get there"),
    (".toml", "ground_z_m = -1.1 ", "ground_z_m = -1.6 ", "machine.other-ground", "over it"),
    (".toml", "speed_limit = 0.4 ", "speed_limit = 0.5 ", "guard.profile-exceeds-envelope", "reduce it"),
    (".toml", 'name = "truck_loader"', 'name = "Truck"', "profile.name-not-plain", "Truck"),
    (".truth.toml", "lift = 1.15 ", "lift = 1.45 ", "truth.home", "outside the profile's range"),
    (".truth.toml", "arm_at = [-2.93, 2.93]", "arm_at = [-2.5, 2.5]", "truth.stops", "would hit them"),
    (".truth.toml", "area_a = 0.00125 ", "area_a = 0.0025 ", "truth.flow", "another cylinder"),
    (".truth.toml", "[encoders.slew]", "[encoders.swing]", "truth.missing-part", "[encoders] has no slew"),
    (".truth.toml", 'machine = "truck_loader"', 'machine = "tractor"', "truth.other-machine", "tractor"),
    (".urdf", 'name="tilt"', 'name="stick"', "answers.urdf-joint", "there is no joint 'tilt'"),
]


@pytest.mark.parametrize(("file", "old", "new", "code", "words"), BROKEN, ids=[f"{b[0]}-{b[3]}" for b in BROKEN])
def test_check_names_what_is_broken(profile: Path, file: str, old: str, new: str, code: str, words: str) -> None:
    path = profile.with_name(f"{NAME}{file}")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    found = {finding.code: finding.sentence for finding in check(str(profile)) if not finding.note}
    assert words in found[code]


def test_what_is_missing_is_a_problem_only_where_nothing_runs_without_it(profile: Path) -> None:
    profile.with_name(f"{NAME}.truth.toml").unlink()
    profile.with_name(f"{NAME}.urdf").unlink()
    assert problems(profile) == []
    assert "machine.no-truth" in [finding.code for finding in check(str(profile))]
    profile.with_name(f"{NAME}.envelope.toml").unlink()
    assert problems(profile) == ["guard.envelope-missing"]


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_the_shipped_machines_pass(name: str) -> None:
    told = RUNNER.invoke(app, ["machine", "check", name, "--json"])
    assert told.exit_code == ExitCode.OK
    assert all(finding["note"] for finding in json.loads(told.stdout)["findings"])


def test_a_full_disk_leaves_no_part_of_a_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, folder = Path.write_text, tmp_path / "mine"

    def full(path: Path, text: str, **options: str) -> int:
        if path.parent == folder and path.suffix == ".urdf":
            write(path, text[:100], **options)
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, text, **options)

    raw = tomllib.loads(answers_text(example()))
    with monkeypatch.context() as patch, pytest.raises(CommandFailed, check=coded("machine.unwritable")):
        patch.setattr(Path, "write_text", full)
        make(raw, "answers", folder)
    assert list(folder.iterdir()) == []
    assert make(raw, "answers", folder).is_file()
