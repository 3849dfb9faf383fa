"""Settled piles, the pictures drawn and traced of them, their labels, and the shards that store these."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from autonomy.networks import load
from autonomy.perception.papers import BoxDetector
from autonomy.perception.segmentation.ground_plane import height_over_plane
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.network import interface_of
from autonomy.perception.segmentation.segment_merging import load_scorers
from machine.geometry.optics import Intrinsics, pinhole
from runtime.errors import InputRefused
from sim.camera.geometry import look_at
from sim.camera.scene import LogPose
from tests.codes import coded
from tests.training.drawn_logs import picture
from training.common.loop import seeded
from training.common.weight_file import restore, save
from training.detection import detector_weights, scorer_weights
from training.detection.networks import UNet
from training.pictures import drawing, piles, shards
from training.pictures.drawing import MAX_LOGS, draw, labelled
from training.pictures.labels import (
    ANGLE,
    CENTRE_U,
    CENTRE_V,
    END_U,
    END_V,
    ID,
    IGNORED,
    START_U,
    START_V,
    cropped,
    enlarged,
    mirrored,
)
from training.pictures.piles import HELD_OUT, chunk, profile_of, settle
from training.pictures.props import Steel
from training.pictures.samples import read, sample, write
from training.pictures.shards import pictures, shard
from training.pictures.traced import shapes
from training.pictures.traced.scenes import Format, describe, log_poses
from training.pictures.traced.staging import pieces
from training.pictures.traced.tracer import FLOATS, packed


@pytest.fixture(scope="module")
def pile():
    return settle("palms_471", 5)  # crossed, four logs


@pytest.fixture
def few(monkeypatch, tmp_path):
    monkeypatch.setattr(piles, "CHUNK", 2)
    monkeypatch.setattr(shards, "SHARD", 2)
    monkeypatch.setattr(shards, "TRAINING_CHUNKS", 1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_a_pile_rests_on_its_ground_and_repeats(pile):
    assert settle("palms_471", 5) == pile
    assert settle("palms_471", 6) != pile
    low = min(log.spine(8)[0][:, 2].min() - log.diameter_m / 2 for log in pile.logs)
    assert pile.datum_m - 0.03 < low < pile.datum_m + 0.1


def test_piles_are_stored_completely(few):
    first = chunk("palms_471", 0)
    (file,) = (few / "timberhand" / "piles").iterdir()
    assert chunk("palms_471", 0) == first and len(first) == 2
    assert [p.number for p in chunk("palms_471", 3)] == [6, 7]
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(InputRefused, check=coded("dataset.bad-piles")):
        chunk("palms_471", 0)


def test_a_picture_agrees_with_its_ground_truth_and_is_deterministic(pile):
    one, two = (draw(pile, 3, 152) for _ in range(2))
    assert np.array_equal(one.rgb, two.rgb) and np.array_equal(one.depth_m, two.depth_m, equal_nan=True)
    assert not np.array_equal(one.rgb, draw(pile, 4, 152).rgb)
    assert set(np.unique(one.ids)) - {0, IGNORED} == set(one.logs[:, ID].astype(int))
    assert len(one.logs)
    for log in one.logs:
        v, u = np.nonzero(one.ids == log[ID])
        assert u.min() <= log[CENTRE_U] <= u.max() and v.min() <= log[CENTRE_V] <= v.max()


def test_a_held_log_is_between_the_jaws():
    log = LogPose(1, (3.0, 1.0, 1.5), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), 2.5, 0.2)  # along +x
    steel = Steel(random.Random(2))
    steel.holding(profile_of("palms_471"), log)
    boxes = steel.build()
    corners = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
    points = np.einsum("nij,nkj->nki", boxes.axes, corners * boxes.half_m[:, None]) + boxes.centre_m[:, None]
    points = points.reshape(-1, 3)
    assert points[:, 2].min() < 1.5 - 0.08 and points[:, 2].max() > 2.0
    beside = points[np.abs(points[:, 2] - 1.5) < 0.15]
    assert beside[:, 1].min() < 0.9 and beside[:, 1].max() > 1.1 and np.ptp(points[:, 0]) < 1.0


def test_a_plain_sky_has_one_colour(pile, monkeypatch):
    monkeypatch.setattr(drawing, "PLAIN_SHARE", 1.0)
    monkeypatch.setattr(drawing, "_lens_and_compression", lambda rgb, rng: rgb)
    monkeypatch.setattr(drawing, "_stereo_depth", lambda _m, _c, picture, _pin, _rng: picture.depth_m)  # no holes
    samples = [draw(pile, seed, 96) for seed in range(12)]
    skies = [sample.rgb[0] for sample in samples if np.isnan(sample.depth_m[0]).all()]
    assert skies and all(len(np.unique(sky, axis=0)) == 1 for sky in skies)


def test_angle_centre_and_ends_are_those_of_the_projected_log():
    view = look_at((0.0, -4.0, 3.0), (0.0, 0.0, 0.0), pinhole(200, 160, 1.2))
    s = math.sqrt(0.5)
    log = LogPose(1, (0.0, 0.0, 0.1), (0.0, s, 0.0, s), 2.5, 0.2)  # along +x: level in the picture
    ends = view.intrinsics.project(view.to_optical(log.spine(1)[0]))
    mask = np.zeros((160, 200), np.int16)
    v, u = np.mgrid[:160, :200]
    mask[(np.abs(v - ends[:, 1].mean()) < 5) & (u > ends[:, 0].min()) & (u < ends[:, 0].max() - 30)] = 1
    _, (row,) = labelled(mask, view, (log,))
    assert math.remainder(float(row[ANGLE]), math.pi) == pytest.approx(0.0, abs=0.01)
    assert row[CENTRE_U] == pytest.approx(ends[:, 0].mean() - 15, abs=1.0)
    assert row[3:7] == pytest.approx(ends.ravel(), abs=0.01)
    hidden = int(np.argmax(ends[:, 0]))  # something lies over the last 30 pixels of that end
    assert row[7 + hidden] == 0.0 and row[7 + 1 - hidden] == 1.0


def test_logs_with_few_visible_pixels_are_ignored():
    view = look_at((0.0, -4.0, 3.0), (0.0, 0.0, 0.0), pinhole(200, 160, 1.2))
    mask = np.zeros((160, 200), np.int16)
    mask[80, 100:105] = 1
    ids, rows = labelled(mask, view, (LogPose(1, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), 2.5, 0.2),))
    assert (ids[mask == 1] == IGNORED).all() and len(rows) == 0


def test_shards_are_drawn_once_and_read_back(few, monkeypatch):
    drawn = []
    real = drawing.draw
    monkeypatch.setattr(shards, "draw", lambda *a: drawn.append(a[1]) or real(*a))
    own = pictures(few, 96)
    again = [own(1), own(3)]  # of shards 0 and 1
    assert drawn == [0, 1, 2, 3]
    for index, shown in ((1, again[0]), (3, again[1])):
        assert shown.rgb.shape == (96, 96, 3) and shown.logs.shape[0] <= MAX_LOGS
        assert np.isfinite(shown.depth_m).any() and np.isnan(shown.depth_m).any()
        assert np.array_equal(pictures(few, 96)(index).ids, shown.ids)
        height = height_over_plane(shown.depth_m, shown.intrinsics)
        assert np.allclose(shown.height_m, height, atol=0.03, equal_nan=True)  # a millimetre of depth turns the plane
    assert len(drawn) == 4
    assert not list(few.glob("*.part*"))


def test_held_out_pictures_show_held_out_piles(few):
    shard(few, HELD_OUT, 96)
    kept = {p.name.split("-")[1] for p in (few / "timberhand" / "piles").iterdir()}
    assert kept == {f"{HELD_OUT:07d}"}


def test_a_damaged_shard_is_refused(few):
    shard(few, 0, 96)
    (folder,) = few.glob("logs-*")
    (folder / "ids.npy").write_bytes(b"")
    with pytest.raises(InputRefused, check=coded("dataset.bad-shard")):
        shard(few, 0, 96)


@pytest.mark.long
def test_weights_are_written_with_a_card(few, monkeypatch):
    monkeypatch.setattr(detector_weights, "BATCH", 2)
    monkeypatch.setattr(detector_weights, "TEST_PICTURES", 2)
    out = few / "logs_depth.onnx"
    card = detector_weights.produce("depth", detector_weights.Plan(2, 2, 1), few, out, Console(quiet=True))
    assert "timberhand train segmentation --variant depth" in card.read_text()
    assert LogSegmenter("depth", out).facts["seed"] == "1"
    boxes = few / "log_boxes.onnx"
    detector_weights.produce_boxes(detector_weights.Plan(2, 2, 1, large=2), few, boxes, Console(quiet=True))
    assert BoxDetector(boxes).facts["command"].startswith("timberhand train detector --pictures 2 --large 2")
    on = detector_weights.Plan(2, 1, 1, 1e-6, out)
    text = detector_weights.produce("depth", on, few, few / "on.onnx", Console(quiet=True)).read_text()
    assert "logs_depth.onnx" in text
    before, after = (
        load(few / f"{name}.onnx", interface_of("depth")).arrays()["maps.weight"] for name in ("logs_depth", "on")
    )
    assert np.abs(before - after).max() < 1e-4


def test_the_depth_variant_can_start_from_weights_of_the_rgbd_variant(tmp_path):
    """Its first layer is the depth part of the other's; weights of other networks are refused."""
    both, alone = tmp_path / "logs_rgbd.onnx", tmp_path / "logs_depth.onnx"
    net, other = seeded(lambda: UNet("rgbd"), 1), UNet("depth")
    arrays = {name: values.numpy() for name, values in net.state_dict().items() if not name.endswith("tracked")}
    save(both, net, interface_of("rgbd"), {})
    taken = detector_weights.initial_arrays(both, "depth")
    assert taken.keys() == arrays.keys()
    assert np.array_equal(taken["in2.0.weight"], arrays["in2.0.weight"][:, 3:])
    assert all(np.array_equal(taken[k], arrays[k]) for k in arrays if k != "in2.0.weight")
    restore(other, taken)
    save(alone, other, interface_of("depth"), {})
    assert np.array_equal(detector_weights.initial_arrays(alone, "depth")["in2.0.weight"], taken["in2.0.weight"])
    with pytest.raises(InputRefused, check=coded("weights.other-network")):
        detector_weights.initial_arrays(alone, "rgbd")


@pytest.mark.long
def test_small_and_large_pictures_alternate(few):
    plan = detector_weights.Plan(2, 1, 1, large=2)
    source = detector_weights.mixed_pictures(pictures(few), plan, few, Console(quiet=True))
    assert [source(i).ids.shape[0] for i in range(4)] == [304, 608, 304, 608]
    assert np.array_equal(source(1).ids, source(5).ids) and not np.array_equal(source(1).ids, source(3).ids)


@pytest.mark.long
def test_scorers_are_written_with_their_cards(few, monkeypatch):
    monkeypatch.setattr(scorer_weights, "STEPS", 40)
    monkeypatch.setattr(scorer_weights, "SIZE_PX", 304)
    card = scorer_weights.produce(4, 1, few, few / "scorers", None, Console(quiet=True))
    assert "timberhand train scorers --pictures 4 --seed 1" in card.read_text()
    told = load_scorers(few / "scorers").merge.probability(np.zeros((3, 19), np.float32))
    assert told.shape == (3,) and (told > 0.0).all() and (told < 1.0).all()


# -- labels under mirroring, windows and scaling
LOGS = (((60.0, 60.0), 0.4, 80, 10), ((110.0, 110.0), 1.2, 60, 12))


def test_mirroring_twice_is_the_identity():
    sample = picture(*LOGS)
    twice = mirrored(mirrored(sample))
    assert np.array_equal(twice.ids, sample.ids)
    assert np.allclose(twice.logs, sample.logs, atol=1e-4)
    assert twice.intrinsics == sample.intrinsics


def test_a_mirrored_label_agrees_with_its_pixels():
    sample = mirrored(picture(*LOGS))
    v, u = np.nonzero(sample.ids == 1)
    assert sample.logs[0, CENTRE_U] == pytest.approx(u.mean(), abs=1.0)
    slope = np.linalg.eigh(np.cov(np.stack([u, v]).astype(float)))[1][:, -1]
    assert abs(math.remainder(math.atan2(slope[1], slope[0]) - sample.logs[0, ANGLE], math.pi)) < 0.02


def test_a_window_determines_the_visible_part_again():
    sample = picture(((60.0, 70.0), 0.0, 100, 10))
    left = cropped(sample, 0, 20, 64)
    assert left.ids.shape == (64, 64)
    assert left.logs[0, CENTRE_U] == pytest.approx((10 + 63) / 2, abs=1.0)  # of columns 10..63
    assert left.logs[0, [START_U, START_V]] == pytest.approx((10.0, 50.0))
    assert cropped(sample, 40, 30, 80).logs[0, [END_U, END_V]] == pytest.approx((70.0, 40.0))
    assert cropped(sample, 0, 90, 64).logs.shape[0] == 0
    rays = [(30 - pin.cx_px) / pin.fx_px for pin in (left.intrinsics, sample.intrinsics)]
    assert rays[0] == rays[1]


def test_heights_move_with_the_pixels():
    sample = replace(picture(*LOGS), height_m=np.arange(160 * 160, dtype=np.float32).reshape(160, 160))
    assert cropped(mirrored(sample), 10, 20, 64).height_m[0, 0] == sample.height_m[20, 159 - 10]
    assert cropped(picture(*LOGS), 10, 20, 64).height_m is None


def test_enlarged_labels_agree_with_their_pixels():
    large = enlarged(picture(*LOGS))
    assert large.rgb.shape == (320, 320, 3) and large.ids.shape == large.depth_m.shape == (320, 320)
    for log in large.logs:
        _, u = np.nonzero(large.ids == log[ID])
        assert log[CENTRE_U] == pytest.approx((u.min() + u.max()) / 2, abs=1.5)
    assert large.logs[0, ANGLE] == picture(*LOGS).logs[0, ANGLE]


# -- path-traced pictures
def described(pile):
    return describe(pile, 3, Format(size_px=48, samples=1, views=1, stereo_share=0.0))


@pytest.fixture(scope="module")
def scene(pile):
    return described(pile)


def test_a_scene_is_the_same_for_a_seed_and_only_its_logs_are_numbered(pile, scene):
    assert described(pile) == scene and len(log_poses(scene)) == len(scene["logs"])
    numbers = [piece.number for piece in pieces(scene) if piece.number]
    assert numbers == [log["number"] for log in scene["logs"]]


def test_a_stem_has_bark_and_two_sawn_ends():
    z = np.linspace(-1.0, 1.0, 6)
    spine = np.stack([0 * z, 0 * z, z], axis=1)
    stem = shapes.stem(spine, np.full(6, 0.1), np.random.default_rng(0), 0.0, 0.0)
    around = np.hypot(*stem.vertices[:, :2].T)
    assert around.max() == pytest.approx(0.1) and stem.faces.max() < len(stem.vertices)
    assert np.count_nonzero(stem.slot == 1) == 2 * shapes.SIDES


def test_looks_fit_the_kernel(scene):
    corners, detail, bodies, looks = packed(scene)
    assert looks.shape[1] == FLOATS and len(corners) == len(detail) and np.isfinite(looks).all()
    assert detail["look"].max() < len(looks) and detail["body"].max() < len(bodies)


def test_samples_come_back_as_written(tmp_path):
    depth = np.full((8, 8), 2.5, np.float32)
    depth[0] = np.nan
    one = sample(np.zeros((8, 8, 3), np.uint8), depth, np.ones((8, 8)), np.zeros((0, 11)), Intrinsics(8, 8, 9, 9, 4, 4))
    write(tmp_path / "a.npz", [one, one])
    back = read(tmp_path / "a.npz")
    assert (back["depth_mm"][1] == one.depth_mm).all() and one.depth_mm[0, 0] == 0 and one.depth_mm[1, 1] == 2500
