"""Paper A's network: its size, its faster forms, and the choice of a grasp."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.grasp.network import (
    PAPER,
    RELIEF_SCALE,
    GraspMaps,
    GraspNet,
    PixelGrasp,
    _patches,
    best_pixel,
    grasp_maps,
    normalized_relief,
    pixel_grasp_inference,
)
from autonomy.networks import OpenVinoNet, Weights, load
from runtime.errors import InputRefused
from tests.codes import coded
from training.common.loop import seeded
from training.common.weight_file import parameter_count, restore, save
from training.grasp.network_training import GraspNetwork, OriginalOrder

TABLE_1 = {
    "conv1": 1952,
    "conv2": 12560,
    "norm2": 32,
    "conv3": 6416,
    "conv4": 6416,
    "norm4": 32,
    "conv5": 12832,
    "conv6": 25632,
    "norm6": 64,
    "conv7": 12816,
    "q": 17,
    "cos2": 17,
    "sin2": 17,
}
SHAPE = (1, 1, 300, 300)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A weight file of random weights."""
    file = tmp_path_factory.mktemp("weights") / "grasp.onnx"
    save(file, seeded(GraspNetwork, 3), PAPER, {})
    return file


@pytest.fixture(scope="module")
def weights(path: Path) -> Weights:
    return load(path, PAPER)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    coarse = torch.from_numpy(np.random.default_rng(4).normal(size=(1, 1, 25, 25)).astype(np.float32))
    return torch.nn.functional.interpolate(coarse, scale_factor=12, mode="bicubic").numpy()


@pytest.fixture(scope="module")
def unchanged(weights: Weights, picture: np.ndarray) -> GraspMaps:
    """The maps by torch, in the order of Table I."""
    net = OriginalOrder().eval()
    restore(net, weights.arrays())
    with torch.inference_mode():
        return grasp_maps(net(torch.from_numpy(picture))[0].numpy())


def largest(a: GraspMaps, b: GraspMaps) -> float:
    """Greatest difference of the maps."""
    return max(float(np.abs(getattr(a, k) - getattr(b, k)).max()) for k in ("q", "cos2", "sin2"))


def test_the_paper_s_parameters_layer_by_layer() -> None:
    counted: dict[str, int] = {}
    for name, values in GraspNetwork().named_parameters():
        counted[name.split(".")[0]] = counted.get(name.split(".")[0], 0) + values.numel()
    assert counted == TABLE_1
    assert parameter_count(GraspNetwork()) == 78_803


def test_heads_before_the_upsampling_give_the_paper_s_maps(weights, picture, unchanged: GraspMaps) -> None:
    maps = grasp_maps(OpenVinoNet(weights, SHAPE, outputs=("maps",))(picture)["maps"][0])
    assert maps.q.shape == (300, 300) and maps.scale_px == 1
    assert largest(maps, unchanged) <= 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_the_mixed_net_chooses_like_the_exact_one(weights, seed: int) -> None:
    coarse = torch.randn(1, 1, 12, 12, generator=torch.Generator().manual_seed(seed))
    picture = 3.0 * torch.nn.functional.interpolate(coarse, scale_factor=25, mode="bicubic").numpy()
    exact, mixed = pixel_grasp_inference(weights)(picture), pixel_grasp_inference(weights, "mixed")(picture)
    assert math.hypot(exact.u_px - mixed.u_px, exact.v_px - mixed.v_px) <= 3.0
    assert abs(exact.theta_rad - mixed.theta_rad) <= math.radians(3.0)
    assert math.isclose(exact.q, mixed.q, rel_tol=0.01)


def test_what_the_last_convolution_sees() -> None:
    """Borders included: zeros beyond the doubled features, which repeat their own border."""
    features = np.random.default_rng(5).normal(size=(4, 10, 12)).astype(np.float32)
    up = torch.nn.functional.interpolate(torch.from_numpy(features)[None], scale_factor=2, mode="bilinear")
    wanted = torch.nn.functional.unfold(up, 5, padding=2)[0].T.numpy()
    v, u = np.divmod(np.arange(20 * 24), 24)
    assert np.abs(_patches(features, v, u) - wanted).max() <= 1e-5


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_a_third_of_the_side_gives_the_same_grasp(seed: int) -> None:
    low = np.random.default_rng(seed).normal(size=(3, 20, 20)).astype(np.float32)
    full = torch.nn.functional.interpolate(torch.from_numpy(low)[None], scale_factor=3, mode="bilinear")[0].numpy()
    a, b = best_pixel(GraspMaps(*low, scale_px=3)), best_pixel(GraspMaps(*full))
    assert abs(a.u_px - b.u_px) <= 1 and abs(a.v_px - b.v_px) <= 1  # the border repeats: a tie there
    assert math.isclose(a.q, b.q, rel_tol=1e-5) and math.isclose(a.theta_rad, b.theta_rad, abs_tol=1e-4)


def test_the_heads_are_the_maps_seen_at_every_third_pixel(weights, picture) -> None:
    found = OpenVinoNet(weights, SHAPE)(picture)
    assert np.abs(found["heads"] - found["maps"][:, :, 1::3, 1::3]).max() <= 1e-6


def test_the_grasp_is_where_quality_is_greatest() -> None:
    q = np.zeros((300, 300), np.float32)
    q[40, 250] = 0.9
    angle = math.radians(-70.0)
    maps = GraspMaps(q, np.full_like(q, 0.5 * math.cos(2 * angle)), np.full_like(q, 0.5 * math.sin(2 * angle)))
    found = best_pixel(maps)
    assert (found.u_px, found.v_px) == (250, 40)
    assert math.isclose(found.theta_rad, angle, abs_tol=1e-6)


def test_a_map_that_is_no_number_gives_no_grasp() -> None:
    q = np.zeros((10, 10), np.float32)
    with pytest.raises(InputRefused, check=coded("grasp.quality-not-finite")):
        best_pixel(GraspMaps(np.where(np.arange(10) == 3, np.nan, q), q, q))


def plane(slope_u: float = 0.0, slope_v: float = 0.0, far_m: float = 3.0) -> np.ndarray:
    v, u = np.mgrid[:300, :300] / 300.0 - 0.5
    return (far_m / (1.0 + slope_u * u + slope_v * v)).astype(np.float32)


def test_an_object_stands_out_of_a_slanted_ground() -> None:
    depth = plane(0.4, -0.3)
    depth[100:140, 50:200] *= 0.95
    seen = normalized_relief(depth)
    assert np.allclose(seen[100:140, 50:200], math.asinh(0.05 / RELIEF_SCALE), atol=0.1)
    seen[100:140, 50:200] = 0.0
    assert np.abs(seen).max() < 0.1


def test_scale_does_not_count() -> None:
    depth = plane(0.2)
    depth[10:90, 20:60] *= 0.9
    assert np.allclose(normalized_relief(depth), normalized_relief(4.0 * depth), atol=1e-3)


def test_unknown_depth_is_ground() -> None:
    depth = plane(0.1, 0.1)
    depth[200:220, 200:240] = np.nan
    depth[::6, ::6] = 0.0
    assert np.abs(normalized_relief(depth)).max() < 0.05


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_a_picture_without_depth_is_refused(value: float) -> None:
    with pytest.raises(InputRefused, check=coded("grasp.no-depth")):
        normalized_relief(np.full((300, 300), value, np.float32))


def test_strange_pictures_give_finite_inputs() -> None:
    rng = np.random.default_rng(0)
    single = np.full((300, 300), np.nan, np.float32)
    single[7, 9] = 2.0
    for depth in (single, plane()[:1], rng.exponential(1.0, (300, 300)) ** 4 + 1e-3, plane(1.9, -1.9) ** 3):
        assert np.isfinite(normalized_relief(depth)).all()


def test_maps_and_grasp_of_the_running_net_agree(path: Path) -> None:
    net, depth = GraspNet(path), plane(0.2)
    depth[120:180, 140:160] *= 0.9
    full, fast = best_pixel(net.maps(depth)), net.best(depth)
    assert isinstance(fast, PixelGrasp)
    assert math.hypot(full.u_px - fast.u_px, full.v_px - fast.v_px) <= 3.0


def test_another_size_is_refused(path: Path) -> None:
    with pytest.raises(InputRefused, check=coded("grasp.image-size")):
        GraspNet(path).best(np.ones((480, 640), np.float32))
