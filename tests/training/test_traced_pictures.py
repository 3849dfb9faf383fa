"""Path-traced pictures: scenes from piles, shapes, the own tracer, samples on disk."""

import numpy as np
import pytest

from machine.geometry.optics import Intrinsics
from training.pictures.piles import settle
from training.pictures.samples import read, sample, write
from training.pictures.traced import shapes
from training.pictures.traced.scenes import Format, describe, log_poses
from training.pictures.traced.staging import pieces
from training.pictures.traced.tracer import FLOATS, packed


@pytest.fixture(scope="module")
def scene():
    return describe(settle("palms_471", 5), 3, Format(size_px=48, samples=1, views=1, stereo_share=0.0))


def test_a_scene_is_the_same_for_a_seed(scene):
    again = describe(settle("palms_471", 5), 3, Format(size_px=48, samples=1, views=1, stereo_share=0.0))
    assert again == scene and len(log_poses(scene)) == len(scene["logs"])


def test_only_logs_are_numbered(scene):
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
