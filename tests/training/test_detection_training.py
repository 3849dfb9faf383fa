"""Training of the detection networks: targets, augmentation, loss, runs, and the commands."""

import hashlib
import math
import shutil
import signal

import numpy as np
import pytest
import torch
from rich.console import Console
from typer.testing import CliRunner

from autonomy.networks import SHIPPED, load
from autonomy.perception.papers import BOXES, SIZE_PX, BoxDetector, decode_boxes
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.mask_network import MASKS
from autonomy.perception.segmentation.network import MAPS, OFFSET_PX, STRIDE
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused
from tests.codes import coded, numbers_in
from tests.training.drawn_logs import perfect_maps, picture
from timberhand.commands.train import app
from training.common.average_precision import box_overlaps
from training.common.loop import Schedule, seeded
from training.common.weight_file import save
from training.detection import boxes, segmentation
from training.detection.augmentation import augmented, recoloured
from training.detection.detector_weights import box_of
from training.detection.masks import run as masks
from training.detection.masks.mask_weights import mixed
from training.detection.networks import BoxNetwork
from training.detection.segmentation import batches, loss, run, targets
from training.pictures import piles
from training.pictures.drawing import draw
from training.pictures.labels import ID, IGNORED
from training.pictures.piles import settle
from training.pictures.samples import sample, write
from training.pictures.traced import sets

QUIET = Console(quiet=True)
LOGS = (((90.0, 100.0), 0.4, 120, 14), ((140.0, 120.0), 1.2, 100, 16))


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(segmentation, "CROPS", ((64, 1.0), (80, 1.0)))


def test_targets_point_to_the_centre_and_along_the_axis():
    sample = picture(*LOGS, size=208)
    maps, weights = targets(sample)
    assert maps.shape == (len(MAPS), 104, 104)
    y, x = 50, 45  # of the first log
    assert sample.ids[STRIDE * y, STRIDE * x] == 1
    centre = sample.logs[0, 1:3]
    at = np.array([x, y]) * STRIDE + 0.5 * (STRIDE - 1)
    assert at + OFFSET_PX * maps[2:4, y, x] == pytest.approx(centre, abs=1e-3)
    assert 0.5 * np.arctan2(maps[5, y, x], maps[4, y, x]) == pytest.approx(0.4, abs=1e-3)
    peak = np.unravel_index(np.argmax(maps[1]), maps[1].shape)
    assert min(np.hypot(*(np.array(peak[::-1]) * STRIDE - c)) for c in sample.logs[:, 1:3]) < 2.0
    assert weights[1][maps[0] == 0].sum() == 0.0


def test_ignored_pixels_have_no_weight():
    sample = picture(*LOGS, size=208)
    sample.ids[sample.ids == 2] = IGNORED
    maps, weights = targets(sample)
    assert weights[0][60, 70] == 0.0 and maps[0][60, 70] == 0.0


def test_a_perfect_net_has_the_lowest_loss():
    sample = picture(*LOGS, size=208)
    maps, weights = (torch.from_numpy(a[None]) for a in targets(sample))
    perfect = torch.from_numpy(perfect_maps(maps[0].numpy())[None])

    def value(out):
        return loss(lambda _: out, perfect, maps, weights).item()

    assert value(perfect) < 0.5  # soft outlines cost something even so
    for i in range(len(MAPS)):
        worse = perfect.clone()
        worse[:, i] = worse[:, i].flip(-1)
        assert value(worse) > value(perfect) + 0.01, MAPS[i]


def test_augmentation_depends_only_on_the_generator():
    sample = picture(*LOGS, size=208)
    one, two = (augmented(sample, np.random.default_rng(7), 96) for _ in range(2))
    assert np.array_equal(one.rgb, two.rgb) and one.ids.shape == (96, 96)
    assert one.logs.shape[0] > 0
    many = {augmented(sample, np.random.default_rng(s), 96).rgb.tobytes() for s in range(6)}
    assert len(many) == 6


def test_grey_stays_grey_under_changes_of_hue_and_saturation():
    rng = np.random.default_rng(1)
    grey = np.full((8, 8, 3), 120, np.uint8)
    spread = [np.ptp(recoloured(grey, rng).astype(int).mean(axis=(0, 1))) for _ in range(30)]
    assert max(spread) < 120 * 0.8  # gains of the network_input alone part them


def four(length):
    """How pictures of a log each are given, and their number."""
    return [picture(((60.0 + 9 * i, 80.0), 0.3 * i, length, 14), size=160) for i in range(4)].__getitem__, 4


@pytest.mark.long
def test_a_few_steps_reduce_the_loss_deterministically(small):
    torch.set_num_threads(1)  # sums of another order are other sums
    given = four(90)

    def once():
        return run(*given, "depth", Schedule(8, 3e-3), 2, 5, None, QUIET)[1]

    first = once()
    assert np.mean(first[-2:]) < 0.9 * np.mean(first[:2])
    assert once() == first


def test_a_batch_depends_only_on_its_number(small):
    torch.set_num_threads(1)  # sums of another order are other sums
    batch = batches(*four(90), 2, "rgbd", 0)
    later = batch(3)[0]
    batch(0)
    assert torch.equal(batch(3)[0], later)
    assert not torch.equal(batch(2)[0], later)


# -- boxes
CROSSED = (((60.0, 70.0), 0.4, 80, 14), ((140.0, 120.0), 1.2, 100, 16))


def test_boxes_of_perfect_maps_are_those_of_the_logs():
    sample = picture(*CROSSED, size=208)
    found, scores = decode_boxes(perfect_maps(boxes.targets(sample)[0], logits=(0,)))
    assert len(found) == 2 and (scores > 0.9).all()
    for number in (1, 2):
        v, u = np.nonzero(sample.ids == number)
        box = (u.min(), v.min(), u.max() + 1, v.max() + 1)
        assert np.abs(found - box).max(axis=1).min() < 0.51


def test_duplicate_boxes_are_suppressed_and_neighbours_are_kept():
    maps = np.full((5, 30, 30), -9.0, np.float32)
    for x, score in ((10, 3.0), (12, 2.0), (20, 1.0)):
        maps[:, 10, x] = (score, *np.log([6.0, 3.0, 6.0, 3.0]))
    found, scores = decode_boxes(maps)
    assert len(found) == 3  # two steps of 8 px aside: overlap 0.71
    maps[1:, 10, 12] = np.log([7.0, 3.0, 5.0, 3.0])  # now the same box
    found, scores = decode_boxes(maps)
    assert len(found) == 2 and scores[0] > scores[1]
    none, scores = decode_boxes(np.full((5, 10, 10), -9.0, np.float32))
    assert none.shape == (0, 4) and scores.shape == (0,)


def test_pictures_of_another_size_and_foreign_weights_are_refused(tmp_path):
    path = tmp_path / "boxes.onnx"
    save(path, seeded(BoxNetwork, 1), BOXES, {})
    detector = BoxDetector(path)
    with pytest.raises(InputRefused, check=coded("network.bad-picture")):
        detector.detect(np.zeros((304, 304, 3), np.uint8))
    found, _ = detector.detect(np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8))
    assert found.shape[1] == 4
    with pytest.raises(InputRefused):
        BoxDetector(tmp_path / "none.onnx")


@pytest.mark.long
def test_a_few_steps_reduce_the_loss(monkeypatch):
    monkeypatch.setattr(boxes, "CROPS", ((64, 1.0),))
    _, losses = boxes.run([four(60)], Schedule(10, 3e-3), 2, 5, None, QUIET)
    assert np.mean(losses[-3:]) < 0.8 * np.mean(losses[:2])


def test_the_generalised_overlap_of_two_boxes():
    """Of boxes about one cell: nothing of equal ones, a half of one in another of twice the size."""

    def box(*sides):
        return torch.log(torch.tensor(sides, dtype=torch.float32)).reshape(1, 4, 1, 1)

    def lacks(a, b):
        return boxes._giou_loss(a, b).item()

    one = box(2.0, 3.0, 2.0, 3.0)
    assert lacks(one, one) == pytest.approx(0.0, abs=1e-6)
    assert lacks(one, box(2.0, 3.0, 6.0, 3.0)) == pytest.approx(0.5)  # overlap a half, and it is all that is around
    left, right = box(4.0, 1.0, 0.05, 1.0), box(0.05, 1.0, 4.0, 1.0)
    assert lacks(left, right) == pytest.approx(1.0, abs=0.05), "beside each other they share next to nothing"


@pytest.mark.long
def test_training_starts_from_weights(tmp_path):
    sample = [picture(((90.0, 80.0), 0.3, 60, 14), size=304)]
    start = {name: values.numpy() for name, values in seeded(BoxNetwork, 7).state_dict().items()}
    net, _ = boxes.run([(sample.__getitem__, 1)], Schedule(1, 1e-9), 2, 5, None, QUIET, start)
    assert np.abs(net.boxes.weight.detach().numpy() - start["boxes.weight"]).max() < 1e-6
    other, _ = boxes.run([(sample.__getitem__, 1)], Schedule(1, 1e-9), 2, 5, None, QUIET)
    assert np.abs(other.boxes.weight.detach().numpy() - start["boxes.weight"]).max() > 1e-3


def test_batches_of_small_and_large_pictures_alternate():
    small, large = ([picture(((90.0, 80.0), 0.3, 60, 14), size=size)] for size in (304, 608))
    batch = boxes.batches([(small.__getitem__, 1), (large.__getitem__, 1)], 8, 5)
    assert [batch(step)[0].shape for step in (0, 1, 2)] == [(8, 3, 256, 256), (2, 3, 512, 512), (8, 3, 256, 256)]
    assert batch(1)[1].shape == (2, 5, 64, 64)


# -- masks
SIDE = 64


def small_sample(wood=True):
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
        write(tmp_path / f"{name}00000.npz", [small_sample(), small_sample(wood=False)])
    return tmp_path


def test_sets_are_drawn_in_the_shares_of_the_card(folder):
    shot = (np.zeros((20, 40, 3), np.uint8), np.ones((20, 40), bool))
    bank, counts = mixed(folder, [shot])
    assert counts == {"traced": 2, "drawn": 2, "meshed": 2, "photographs": 1}
    shares = bank.share.numpy()
    assert [shares[i : i + 2].sum() for i in (0, 2, 4, 6)] == pytest.approx([0.55, 0.2, 0.2, 0.05])
    assert shares[1] == pytest.approx(shares[0] / 3)
    assert set(np.unique(bank.ids[6, :32])) == {254} and set(np.unique(bank.ids[6, 32:])) == {255}


def test_no_traced_pictures_are_a_coded_error(tmp_path):
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
    few = f"--device cpu --steps 1 --batch 2 --side {SIDE} --out".split()
    result = CliRunner().invoke(app, ["masks", str(folder), *few, str(out)])
    assert result.exit_code == 0, result.output
    load(out, MASKS)
    assert 1 in numbers_in(out.with_suffix(".md").read_text()) and out.with_suffix(".checkpoint").is_file()
    assert out.with_suffix(".jsonl").is_file()


@pytest.mark.long
def test_an_interrupted_training_continues_to_the_same_weights(folder):
    bank, _ = mixed(folder)
    plan = masks.Run(batch=2, side_px=SIDE, seconds=math.inf, steps=2)
    whole = masks.train(bank, plan, None, lambda _: None, lambda *_: None)
    kept = folder / "half.checkpoint"

    def interrupt(step):
        if step == 0:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        masks.train(bank, plan, None, lambda _: None, lambda *_: None, interrupt, checkpoint=kept)
    assert torch.load(kept, weights_only=True)["step"] == 1
    begun = []
    again = masks.train(bank, plan, None, lambda _: None, lambda *_: None, begun.append, checkpoint=kept)
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
    asked = {"--scenes": 1, "--drawn": 0, "--meshed": 1, "--size": 48, "--chunks": 1}
    few = ["traced-pictures", str(out), *(str(word) for pair in asked.items() for word in pair)]
    assert CliRunner().invoke(app, few).exit_code == 0
    before = {file.name: file.stat().st_mtime_ns for file in out.glob("*.npz")}
    assert sorted(before) == ["meshed00000.npz", "traced00000.npz"]
    assert CliRunner().invoke(app, few).exit_code == 0
    assert before == {file.name: file.stat().st_mtime_ns for file in out.glob("*.npz")}


# -- the shipped networks: cards that match the weights, and detections
WELL_SHOWN_PX = 600


@pytest.fixture(scope="module")
def seen():
    """Some pictures of four crossed logs, with the boxes of those that show well."""
    pile = settle("palms_471", 5)
    samples = [draw(pile, seed) for seed in range(24)]
    shown = [[s.ids == log[ID] for log in s.logs] for s in samples]
    return [
        (s, np.array([box_of(m) for m in masks if m.sum() > WELL_SHOWN_PX]).reshape(-1, 4))
        for s, masks in zip(samples, shown, strict=True)
    ]


def found(boxes_of, seen) -> float:
    """The share of the logs that show well that one of the boxes lies on."""
    best = [box_overlaps(boxes_of(s), truth).max(axis=0, initial=0.0) for s, truth in seen if len(truth)]
    return float(np.mean(np.concatenate(best) > 0.5))


@pytest.mark.parametrize("weights", sorted(SHIPPED.glob("*.onnx")), ids=lambda path: path.stem)
def test_the_card_matches_the_weights(weights):
    assert hashlib.sha256(weights.read_bytes()).hexdigest() in weights.with_suffix(".md").read_text()
    assert weights.stat().st_size < 5_000_000


@pytest.mark.long
@pytest.mark.parametrize(("variant", "least"), [("rgbd", 0.7), ("depth", 0.55)])
def test_well_visible_logs_are_segmented(variant, least, seen):
    detector = LogSegmenter(variant)
    share = found(lambda s: [i.box_px for i in detector.segment_picture(s.rgb, s.depth_m, s.intrinsics)], seen)
    assert share >= least, share


def test_the_depth_variant_ignores_colour(seen):
    detector = LogSegmenter("depth")
    sample = next(s for s, truth in seen if len(truth) > 2)
    plain = detector.segment_picture(sample.rgb, sample.depth_m, sample.intrinsics)
    dark = detector.segment_picture(np.full_like(sample.rgb, 7), sample.depth_m, sample.intrinsics)
    assert plain and [i.box_px for i in plain] == [i.box_px for i in dark]


@pytest.mark.long
def test_boxes_from_colour_overlap_logs(seen):
    detector = BoxDetector()

    def boxes_of(sample):
        square = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)
        square[: sample.rgb.shape[0], : sample.rgb.shape[1]] = sample.rgb
        return detector.detect(square)[0]

    assert found(boxes_of, seen) >= 0.5
