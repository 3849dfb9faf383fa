"""The mask network's training by its commands: tiny sets, one or two steps on the CPU."""

import math
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from autonomy.networks import load
from autonomy.perception.segmentation.mask_network import MASKS
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused
from tests.codes import coded, numbers_in
from timberhand.commands.train import app
from training.pictures import piles
from training.pictures.samples import sample, write
from training.pictures.traced import sets

torch = pytest.importorskip("torch")
SIDE = 64


def picture(wood=True):
    """A log on a floor, or the floor alone."""
    depth = np.full((SIDE, SIDE), 3.0, np.float32)
    ids = np.zeros((SIDE, SIDE), np.uint8)
    rows = np.zeros((0, 11), np.float32)
    if wood:
        ids[28:36, 8:56] = 1
        rows = np.array([[1, 32, 32, 0.0, 8, 32, 1, 56, 32, 1, 0]], np.float32)
    return sample(np.full((SIDE, SIDE, 3), 90, np.uint8), depth, ids, rows, Intrinsics(SIDE, SIDE, 60, 60, 32, 32))


@pytest.fixture
def folder(tmp_path):
    for name in ("traced", "drawn", "meshed"):
        write(tmp_path / f"{name}00000.npz", [picture(), picture(wood=False)])
    return tmp_path


def test_sets_are_drawn_in_the_shares_of_the_card(folder):
    from training.detection.masks.mask_weights import mixed

    shot = (np.zeros((20, 40, 3), np.uint8), np.ones((20, 40), bool))
    bank, counts = mixed(folder, [shot])
    assert counts == {"traced": 2, "drawn": 2, "meshed": 2, "photographs": 1}
    shares = bank.share.numpy()
    assert [shares[i : i + 2].sum() for i in (0, 2, 4, 6)] == pytest.approx([0.55, 0.2, 0.2, 0.05])
    assert shares[1] == pytest.approx(shares[0] / 3)
    assert set(np.unique(bank.ids[6, :32])) == {254} and set(np.unique(bank.ids[6, 32:])) == {255}


def test_no_traced_pictures_are_a_coded_error(tmp_path):
    from training.detection.masks.mask_weights import mixed

    with pytest.raises(InputRefused, check=coded("dataset.no-traced")):
        mixed(tmp_path)


def test_without_compiler_and_blender_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(sets, "compiler", lambda: None)
    monkeypatch.setattr(sets, "find_spec", lambda name: None)
    for asked in sets.RENDERERS:
        with pytest.raises(InputRefused, check=coded("dataset.no-renderer")):
            sets.renderer(asked)


@pytest.mark.long
def test_the_command_writes_weights_card_and_checkpoint(folder):
    out = folder / "made.onnx"
    few = ["--device", "cpu", "--steps", "1", "--batch", "2", "--side", str(SIDE), "--out", str(out)]
    result = CliRunner().invoke(app, ["masks", str(folder), *few])
    assert result.exit_code == 0, result.output
    load(out, MASKS)
    assert 1 in numbers_in(out.with_suffix(".md").read_text()) and out.with_suffix(".checkpoint").is_file()
    assert out.with_suffix(".jsonl").is_file()


@pytest.mark.long
def test_an_interrupted_training_continues_to_the_same_weights(folder):
    from training.detection.masks import run as training
    from training.detection.masks.mask_weights import mixed

    bank, _ = mixed(folder)
    plan = training.Run(batch=2, side_px=SIDE, seconds=math.inf, steps=2)
    whole = training.train(bank, plan, None, lambda _: None, lambda *_: None)
    kept = folder / "half.checkpoint"

    def interrupt(step):
        if step == 0:
            import signal

            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        training.train(bank, plan, None, lambda _: None, lambda *_: None, interrupt, checkpoint=kept)
    assert torch.load(kept, weights_only=True)["step"] == 1
    begun = []
    again = training.train(bank, plan, None, lambda _: None, lambda *_: None, begun.append, checkpoint=kept)
    assert begun == [1]
    assert all(np.array_equal(whole[name], again[name]) for name in whole)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("g++") is None, reason="the tracer needs g++")
def test_the_sets_are_drawn_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for machine in piles.MACHINES:
        one = piles.settle(machine, 5)
        path = piles.cache_folder() / f"{machine}-0000000-e{piles.FORMAT_VERSION}.npz"
        piles._write(path, [one] * piles.CHUNK)
    out = tmp_path / "pictures"
    few = [
        "traced-pictures",
        str(out),
        "--scenes",
        "1",
        "--drawn",
        "0",
        "--meshed",
        "1",
        "--size",
        "48",
        "--chunks",
        "1",
    ]
    assert CliRunner().invoke(app, few).exit_code == 0
    before = {file.name: file.stat().st_mtime_ns for file in out.glob("*.npz")}
    assert sorted(before) == ["meshed00000.npz", "traced00000.npz"]
    assert CliRunner().invoke(app, few).exit_code == 0
    assert before == {file.name: file.stat().st_mtime_ns for file in out.glob("*.npz")}
