"""Foreign methods by entry point: the example package of the docs is installed, found, and compared with ours."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from autonomy.grasp.planners import GRASP_PLANNERS
from autonomy.perception.camera.frame import RgbdFrame
from experiments.common import plugins
from experiments.common.plugins import SeenLog
from experiments.common.registry import Options
from experiments.grasp_configs import pose_sources
from experiments.grasp_configs.experiment import compare, jobs_of
from host.exit_codes import ExitCode
from runtime.errors import InputRefused
from tests.codes import coded
from timberhand.cli import app

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "extend"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, installed as a researcher installs it."""
    there = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "install"]
    copy = there / "source"
    shutil.copytree(EXAMPLE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([*pip, "--no-deps", "--no-build-isolation", "--target", there / "lib", copy], check=True)
    return there / "lib"


@pytest.fixture
def installed(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(package))


@pytest.mark.usefixtures("installed")
def test_an_unknown_or_broken_method_is_refused_with_what_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputRefused, match="pca", check=coded("plugin.unknown")):
        plugins.load(GRASP_PLANNERS, "pac")
    broken = tmp_path / "broken-1.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Name: broken\nVersion: 1\n")
    (broken / "entry_points.txt").write_text(f"[{GRASP_PLANNERS}]\nbroken = not_there:Planner\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputRefused, check=coded("plugin.unusable")):
        plugins.load(GRASP_PLANNERS, "broken")
    options = Options(1, "nominal", "palms_471", tmp_path / "out", planner="pca", docs=tmp_path)
    with pytest.raises(InputRefused, check=coded("plugin.no-page")):
        compare(options, Console(quiet=True))
    refused = CliRunner().invoke(app, ["experiment", "navigation", "--quick", "--planner", "pca"])
    assert refused.exit_code == ExitCode.USAGE


@pytest.mark.usefixtures("installed")
def test_another_content_of_the_method_is_another_run() -> None:
    name, value, digest = plugins.identity(GRASP_PLANNERS, "pca")
    assert (name, value, len(digest)) == ("my-crane0.1", "my_crane.planner:PcaPlanner", 64)
    assert plugins.identity(GRASP_PLANNERS, "") == ()


def test_both_methods_meet_the_same_scenes(tmp_path: Path) -> None:
    options = Options(1, "nominal", "palms_471", tmp_path)
    jobs = jobs_of(options, (("ours", "pca"), ("ours", "search")), 7, alike=True)
    foreign, ours = ([j for j in jobs if j.options["planner"] == name] for name in ("pca", "search"))
    assert len(foreign) == len(ours) == 7 * 12
    assert [(j.seed, j.options["configuration"]) for j in foreign] == [
        (j.seed, j.options["configuration"]) for j in ours
    ]


def test_what_a_foreign_detector_sees_reaches_the_planner_in_the_base_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    pose = SimpleNamespace(rotation=turn, to_base=lambda p: turn @ p + np.array([1.0, 2.0, 3.0]))
    frame = RgbdFrame("stick", 0, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2)), None)  # type: ignore[arg-type]

    def detector(got: RgbdFrame) -> Sequence[SeenLog]:
        assert got is frame
        return [SeenLog((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 3.0, 0.2)]

    camera = SimpleNamespace(detect=lambda *_: pose_sources.Pictures((frame,), pose, ()))  # type: ignore[arg-type]
    monkeypatch.setattr(pose_sources, "_Surveyed", lambda *_: camera)
    source = pose_sources.ForeignPerception(detector, None, None, 0)  # type: ignore[arg-type]
    (seen,) = source.detect(0, ()).logs
    assert seen.center_m == (1.0, 3.0, 3.0) and seen.axis == (-1.0, 0.0, 0.0) and seen.length_m == 3.0


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("installed")
def test_the_example_is_compared_with_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.grasp_configs.experiment.CONFIGURATIONS", (1, 4))
    options = replace(Options(1, "nominal", "palms_471", tmp_path, planner="pca", detector="true"), trials=1)
    result = compare(options, Console(quiet=True))
    assert result.metrics["true.pca.success_n"] == result.metrics["ours.search.success_n"] == 2.0
    assert result.metrics["ours.search.success"] == 1.0
    assert result.metrics["true.pca.success"] >= 0.5 and result.limits == {}
    not_run = {f"{method}.logs_per_grasp_10_12" for method in ("true.pca", "ours.search")}
    assert set(result.missed) <= not_run, "configurations 10 to 12 were left out"
