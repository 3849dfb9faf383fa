"""The detector experiment: test worlds, metrics, photographs."""

import numpy as np
import pytest
from rich.console import Console

from experiments.common.registry import Options
from experiments.detector import experiment, photos, trial, worlds
from host.exit_codes import CommandFailed, ExitCode
from tests.codes import coded


@pytest.fixture
def few_piles(monkeypatch, tmp_path):
    monkeypatch.setattr("training.pictures.piles.CHUNK", 1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_a_test_picture_is_reproducible_and_its_masks_are_its_logs(few_piles):
    one = worlds.picture("palms_471", 0, 1)
    two = worlds.picture("palms_471", 0, 1)
    assert np.array_equal(one.rgb, two.rgb) and np.array_equal(one.depth_m, two.depth_m, equal_nan=True)
    assert not np.array_equal(one.mask, worlds.picture("palms_471", 0, 2).mask)
    masks, ignored = one.truths()
    assert masks and all(m.any() for m in masks)
    assert ignored.tolist() == [np.count_nonzero(m) < worlds.MIN_LOG_PX for m in masks]
    assert one.rgb.shape[:2] == one.depth_m.shape == (one.intrinsics.height_px, one.intrinsics.width_px)


def outcome(machine, scores, boxes, ignored):
    found = {"scores": scores, "boxes": boxes, "masks": boxes}
    whole = {"scores": [1.0] * len(ignored), "boxes": (0.9 * np.eye(len(ignored))).tolist()}
    pixels = [5000, 300][: len(ignored)]
    return {"machine": machine, "ignored": ignored, "pixels": pixels, "found": {"rgbd": found, "parted": whole}}


def test_metrics_follow_from_the_detections():
    outcomes = [
        outcome("palms_471", [0.9, 0.6], [[0.92, 0.0], [0.0, 0.1]], [False, False]),
        outcome("aoro_fc8", [0.8], [[0.96]], [False]),
    ]
    metrics = experiment.gather(outcomes, ("rgbd",))
    assert metrics["map50"] == pytest.approx(67 / 101)  # two of three truths, before the false one
    assert metrics["aoro_fc8.map50"] == pytest.approx(1.0)
    assert metrics["palms_471.map50"] == pytest.approx(51 / 101)
    assert metrics["recall"] == pytest.approx(2 / 3)
    assert metrics["false_per_picture"] == pytest.approx(0.5)
    assert metrics["map50_95"] < metrics["map50"]
    assert metrics["parted.map50"] == 1.0 and metrics["parted.map50_95"] == pytest.approx(0.9)
    assert metrics["found_large"] == 1.0 and metrics["found_small"] == 0.0


def test_perfectly_separated_wood_is_as_good_as_its_pixels():
    masks = [np.zeros((20, 30), bool) for _ in range(3)]
    masks[0][5:10, :20], masks[1][10:15, :20], masks[2][16:18, 25:28] = True, True, True
    wood = np.zeros((20, 30), bool)
    wood[5:15, :15] = True  # two logs as one, three quarters of each; the third is not seen
    ideal = trial.parted(wood, masks, np.array([trial.box_of(m) for m in masks]))
    assert ideal["scores"] == [1.0, 1.0]
    assert ideal["boxes"] == [[0.75, 0.0, 0.0], [0.0, 0.75, 0.0]]
    assert trial.parted(np.any([], axis=0), masks, np.zeros((3, 4)))["boxes"] == []


def test_missing_weights_end_the_command(monkeypatch, tmp_path):
    monkeypatch.setattr(trial, "SHIPPED", tmp_path)
    options = Options(seed=1, truth="nominal", profile="palms_471", out=tmp_path)
    with pytest.raises(CommandFailed, check=coded("detector.no-weights")) as stop:
        experiment.run(options, Console(quiet=True))
    assert stop.value.exit_code == ExitCode.CONFIGURATION


def test_photographs_are_cut_at_white_gutters():
    rng = np.random.default_rng(0)
    sheet = np.full((300, 400, 3), 255, np.uint8)
    wood = np.zeros((300, 400), bool)
    places = ((10, 110, 10, 190), (10, 110, 210, 390), (130, 290, 10, 390))
    for y0, y1, x0, x1 in places:
        sheet[y0:y1, x0:x1] = rng.integers(0, 200, (y1 - y0, x1 - x0, 3))
    wood[20:60, 20:60] = True
    wood[20:60, 250] = True  # an outline
    shots = photos.cut("sheet", sheet, wood)
    assert [s.rgb.shape[:2] for s in shots] == [(y1 - y0, x1 - x0) for y0, y1, x0, x1 in places]
    assert [int(s.wood.sum()) for s in shots] == [1600, 0, 0]


def test_overlap_of_wood():
    a = np.zeros((4, 4), bool)
    assert np.isnan(photos.overlap(a, a))
    assert photos.overlap(~a, ~a) == 1.0


def test_the_real_photographs_are_found():
    if not photos.folder().is_dir():
        pytest.skip(f"no photographs in {photos.folder()}; set TIMBERHAND_DATA")
    shots = photos.photos(photos.folder())
    assert len(shots) > 15
    assert all(0.0 < s.wood.mean() < 0.7 for s in shots)
