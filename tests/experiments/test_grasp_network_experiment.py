"""The grasp-network experiment and the command that trains its network."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from scipy.ndimage import binary_dilation
from typer.testing import CliRunner

from autonomy.grasp.network import PAPER, GraspNet, best_pixel, normalized_relief
from autonomy.networks import load
from experiments.common.registry import Options
from experiments.grasp_network import experiment, folds, latency
from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import TimberhandError
from tests.codes import coded, exit_code_of
from timberhand.commands import train
from training.grasp.cornell import load as load_samples

QUIET = Console(file=io.StringIO())


def options(out: Path, **more) -> Options:
    return Options(seed=1, truth="nominal", profile="palms_471", out=out, quick=True, **more)


def layout(folder: Path, numbers: tuple[int, ...]) -> Path:
    """Bars on a slanted table in the Cornell layout."""
    folder.mkdir(parents=True, exist_ok=True)
    v, u = np.mgrid[:480, :640]
    for n in numbers:
        angle = 0.5 * n
        c, s = math.cos(angle), math.sin(angle)
        depth = (1.0 + 0.0003 * v).astype(np.float32)
        depth[(abs(c * (u - 320) + s * (v - 240)) < 12) & (abs(-s * (u - 320) + c * (v - 240)) < 60)] *= 0.95
        Image.fromarray(depth).save(folder / f"pcd{n:04d}d.tiff", compression="tiff_deflate")
        corners = [(-20, -50), (20, -50), (20, 50), (-20, 50)]
        text = "".join(f"{320 + c * x - s * y} {240 + s * x + c * y}\n" for x, y in corners)
        (folder / f"pcd{n:04d}cpos.txt").write_text(text)
    return folder


def test_the_fastest_path_is_one_that_agrees() -> None:
    times = {"torch": [10.0, 10.0], "low": [4.0, 4.0], "mixed": [2.0, 2.0], "heads": [5.0, 5.0]}
    apart = {"torch": [(0.0, 0.0)], "low": [(1.0, 2.0)] * 2, "mixed": [(0.0, 3.1)] * 2, "heads": [(0.0, 0.0)]}
    found = latency.metrics(times, apart)
    assert found["latency_ratio"] == 0.4
    assert (found["argmax_px"], found["angle_deg"]) == (1.0, 2.0)
    assert found["mixed_ratio"] == 0.2 and found["mixed_angle_deg"] == 3.1


def test_rates_of_both_cross_validations() -> None:
    def trial(right: bool, own: bool) -> dict[str, bool]:
        return {"right": right, "own_size": own}

    outcomes = {"grouped-0": [trial(True, True)], "grouped-1": [trial(False, True)], "paper-0": [trial(True, True)] * 3}
    found = experiment.gather(outcomes)
    assert found["cornell_grouped"] == 0.5 and found["cornell_grouped_n"] == 2
    assert found["cornell_grouped_own_size"] == 1.0
    assert found["cornell_paper_split"] == 1.0 and 0.4 < found["cornell_paper_split_low"] < 0.5


def test_without_data_the_folds_are_skipped_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_DATA", str(tmp_path / "nowhere"))
    metrics: dict[str, float] = {}
    words, pictures = experiment._cornell(options(tmp_path), metrics, QUIET)
    assert words
    assert not pictures and not metrics


def test_any_folder_in_the_layout_is_evaluated(tmp_path: Path) -> None:
    folder = layout(tmp_path / "mine", (100, 500, 501))
    metrics: dict[str, float] = {}
    words, pictures = experiment._cornell(options(tmp_path, data=folder), metrics, QUIET)
    assert "--data" in words and pictures
    assert metrics["data_right_n"] == 3 and metrics["data_own_size"] >= metrics["data_right"]
    assert metrics["data_trained_on"] == 1


def test_a_folder_without_samples_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CommandFailed, check=coded("dataset.no-samples")) as stopped:
        experiment.run(options(tmp_path, data=tmp_path / "none"), QUIET)
    assert stopped.value.exit_code == ExitCode.CONFIGURATION


def test_a_checkpoint_belongs_to_its_seed_schedule_and_data(tmp_path: Path) -> None:
    few = load_samples(layout(tmp_path / "a", (1, 2)))
    other = load_samples(layout(tmp_path / "b", (1, 3)))
    names = {folds.identity(*of) for of in ((few, 1, 2), (few, 2, 2), (few, 1, 3), (other, 1, 2))}
    assert len(names) == 4 and folds.identity(few, 1, 2) in names


def test_the_shipped_weights_close_across_a_log() -> None:
    """They were never trained on one; it works because depth is relative to the ground."""
    net = GraspNet()
    for depth, _ in latency.log_scenes(3, 9)[::4]:  # one log each
        logs = binary_dilation(normalized_relief(depth) > 1.0, iterations=5)
        v, u = np.nonzero(logs)
        spread = np.cov(np.stack([u, v]))
        axis = np.linalg.eigh(spread)[1][:, 1]
        for grasp in (net.best(depth), best_pixel(net.maps(depth))):
            across = abs(axis[0] * math.cos(grasp.theta_rad) + axis[1] * math.sin(grasp.theta_rad))
            assert across < math.sin(math.radians(20.0))
            assert logs[round(grasp.v_px), round(grasp.u_px)]


def test_scenes_are_reproducible() -> None:
    first, again, other = latency.log_scenes(1, 2), latency.log_scenes(1, 2), latency.log_scenes(2, 2)
    assert all((a[0] == b[0]).all() for a, b in zip(first, again, strict=True))
    assert (first[0][0] != other[0][0]).any()


def test_train_needs_data() -> None:
    done = CliRunner().invoke(train.app, ["grasp", "--data", "/nowhere"])
    assert isinstance(done.exception, TimberhandError) and exit_code_of(done.exception) == ExitCode.CONFIGURATION
    assert done.exception.code == "dataset.no-samples" and "/nowhere" in str(done.exception)


@pytest.mark.long
def test_train_writes_weights_and_card(tmp_path: Path) -> None:
    folder = layout(tmp_path / "data", (7, 8))
    made = []
    for name in ("a", "b"):
        out = tmp_path / f"{name}.onnx"
        done = CliRunner().invoke(train.app, ["grasp", "--data", str(folder), "--epochs", "1", "--out", str(out)])
        assert done.exception is None, done.exception
        made.append(load(out, PAPER))
        assert out.with_suffix(".md").read_text()
    first, second = (weights.arrays() for weights in made)
    facts = made[0].facts
    assert all((first[k] == second[k]).all() for k in first)
    assert facts["numbers"] == "7 8" and facts["seed"] == "1"
    assert not list(tmp_path.glob("*.checkpoint"))


@pytest.mark.long
def test_the_whole_experiment_on_a_folder(tmp_path: Path) -> None:
    folder = layout(tmp_path / "mine", (200, 201))
    result = experiment.run(options(tmp_path / "out", data=folder, docs=tmp_path / "docs"), QUIET)
    assert result.metrics["parameters"] == 78_803
    assert result.metrics["argmax_px"] <= 3 and result.metrics["angle_deg"] <= 3
    assert "parameters" not in result.missed and "argmax_px" not in result.missed
    assert json.loads((tmp_path / "out" / "result.json").read_text())["metrics"]["data_right_n"] == 2
