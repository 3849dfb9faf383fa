"""The command that finds where a camera sits, as a technician runs it."""

from __future__ import annotations

import json
import shutil
from math import radians
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from typer.testing import CliRunner

from autonomy.perception.camera.frame import optical_pose
from host.exit_codes import ExitCode
from machine.geometry.optics import intrinsics
from machine.loading.profile_file import load_profile, profile_hash
from runtime.errors import TimberhandError
from tests.codes import exit_code_of
from timberhand.cli import app

PALMS = load_profile("palms_471")
AT_DEG = (10.0, 43.0, -92.0, 0.3)
SCALE = 0.993


def table(lines: int = 12) -> list[dict[str, float]]:
    """What a stick camera that is 2 cm and a degree off sees of targets, and where these are."""
    rng = np.random.default_rng(5)
    camera, pin = PALMS.cameras["stick"], intrinsics(PALMS.cameras["stick"])
    x, y, z = camera.position_m
    roll, pitch, yaw = camera.rpy_rad
    true = replace(camera, position_m=(x + 0.02, y, z - 0.01), rpy_rad=(roll, pitch + 0.017, yaw - 0.01))
    pose = optical_pose(PALMS, true, [*map(radians, AT_DEG[:3]), AT_DEG[3], 0.0])
    found = []
    for _ in range(lines):
        u, v, deep = rng.uniform(60, pin.width_px - 60), rng.uniform(60, pin.height_px - 60), rng.uniform(3.0, 8.0)
        at = pose.to_base(pin.deproject(u, v, deep))
        found.append({"u_px": u, "v_px": v, "x_m": at[0], "y_m": at[1], "z_m": at[2], "depth_m": SCALE * deep})
    return found


def written(path: Path, rows: list[dict[str, float]], **changed: str) -> Path:
    names = list(rows[0])
    lines = [",".join(changed.get(name, name) for name in names)]
    lines += [",".join(f"{row[name]:.6f}" for name in names) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def run(folder: Path, targets: Path, *more: str) -> object:
    words = ["survey-camera", "stick", str(targets), "--profile", "palms_471", "--out", str(folder / "mine.toml")]
    return CliRunner().invoke(app, [*words, *more])


def test_mount_and_scale_go_into_a_new_profile(tmp_path: Path) -> None:
    targets = written(tmp_path / "targets.csv", table())
    found = run(tmp_path, targets, "--joints", "{} {} {} {}".format(*AT_DEG), "--json")
    assert found.exit_code == 0, found.output
    mine, was = load_profile(tmp_path / "mine.toml").cameras["stick"], PALMS.cameras["stick"]
    assert np.subtract(mine.position_m, was.position_m) == pytest.approx([0.02, 0.0, -0.01], abs=0.003)
    assert np.subtract(mine.rpy_rad, was.rpy_rad) == pytest.approx([0.0, 0.017, -0.01], abs=0.001)
    assert mine.depth_scale == pytest.approx(SCALE, abs=1e-4)
    assert json.loads(found.stdout)["targets"] == 12
    assert "[cal]" in (tmp_path / "mine.toml").read_text(encoding="utf-8")


def test_a_camera_that_nobody_surveyed_leaves_the_machines_hash_as_it_was() -> None:
    assert b"depth_scale" not in msgspec.json.encode(PALMS), "recordings carry the hash of this content"
    other = replace(PALMS.cameras["stick"], depth_scale=1.01)
    assert profile_hash(replace(PALMS, cameras={**PALMS.cameras, "stick": other})) != profile_hash(PALMS)


@pytest.mark.parametrize(
    ("case", "code", "words"),
    [
        ("few", ExitCode.FIGURE_MISSED, "6"),
        ("mixed", ExitCode.FIGURE_MISSED, ""),
        ("nobody says where the crane stands", ExitCode.USAGE, "--joints"),
        ("three joints", ExitCode.USAGE, "--joints"),
        ("a comma for a point", ExitCode.CONFIGURATION, ":3: y_m"),
        ("a column without a name", ExitCode.CONFIGURATION, ":1: "),
        ("no file", ExitCode.CONFIGURATION, "nowhere.csv"),
        ("a scale that cannot be", ExitCode.FIGURE_MISSED, ""),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence_and_nothing_is_written(
    case: str, code: ExitCode, words: str, tmp_path: Path
) -> None:
    rows, joints, changed = table(), "{} {} {} {}".format(*AT_DEG), {}
    if case == "few":
        rows = rows[:5]
    elif case == "mixed":
        places = [{k: row[k] for k in ("x_m", "y_m", "z_m")} for row in rows]
        rows = [row | place for row, place in zip(rows, reversed(places), strict=True)]
    elif case == "a scale that cannot be":
        rows = [row | {"depth_m": 1.3 * row["depth_m"]} for row in rows]
    elif case == "a column without a name":
        changed = {"v_px": "v"}
    targets = written(tmp_path / "targets.csv", rows, **changed)
    if case == "a comma for a point":
        lines = targets.read_text(encoding="utf-8").splitlines()
        cells = lines[2].split(",")
        lines[2] = ",".join([*cells[:3], '"4,2"', *cells[4:]])
        targets.write_text("\n".join(lines), encoding="utf-8")
    elif case == "no file":
        targets = tmp_path / "nowhere.csv"
    more = [] if case.startswith("nobody") else ["--joints", "1 2 3" if case == "three joints" else joints]
    found = run(tmp_path, targets, *more)
    assert isinstance(found.exception, TimberhandError)
    assert exit_code_of(found.exception) is code and words in str(found.exception)
    assert not (tmp_path / "mine.toml").exists()


def test_a_profile_that_exists_is_kept_and_no_figure_is_missed(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text("mine")
    targets = written(tmp_path / "targets.csv", table())
    found = run(tmp_path, targets, "--joints", "{} {} {} {}".format(*AT_DEG))
    assert isinstance(found.exception, TimberhandError) and found.exception.code == "calibration.profile-exists"
    assert exit_code_of(found.exception) is ExitCode.CONFIGURATION
    assert (tmp_path / "mine.toml").read_text() == "mine"


def test_the_envelope_of_a_machine_of_ones_own_goes_with_its_profile(tmp_path: Path) -> None:
    own, folder = tmp_path / "own", tmp_path / "surveyed"
    own.mkdir()
    shutil.copy("machine/palms_471.toml", own / "mine.toml")
    (own / "palms_471.envelope.toml").write_text("ours")
    targets = written(tmp_path / "targets.csv", table())
    joints = "{} {} {} {}".format(*AT_DEG)
    words = ["survey-camera", "stick", str(targets), "--profile", str(own / "mine.toml"), "--joints", joints]
    found = CliRunner().invoke(app, [*words, "--out", str(folder / "mine.toml")])
    assert found.exit_code == 0, found.output
    assert (folder / "palms_471.envelope.toml").read_text() == "ours"
