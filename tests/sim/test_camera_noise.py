"""The stereo noise: size, correlation, holes, fattened edges, bias."""

import numpy as np
import pytest
from msgspec.structs import replace

from machine.geometry.optics import Intrinsics
from machine.loading.profile_file import load_profile
from sim.camera.geometry import View
from sim.camera.noise import StereoNoise
from sim.camera.render import Picture, render
from sim.camera.scene import Ground, SceneBuilder
from sim.truth.load import load_truth
from tests.sim.camera_scenes import ABOVE, log, site

CAMERA = load_profile("palms_471").cameras["stick"]
TRUTH = load_truth("nominal", 0, "palms_471").cameras["stick"]
PIN = Intrinsics(608, 608, CAMERA.fx_px, CAMERA.fy_px, 304.0, 304.0)
SMOOTH = replace(TRUTH, hole_share=1e-6, plain_hole_share=1e-6, scale_bias=(0.0, 0.0))


def wall(depth_m: float, grain: float = 20.0) -> Picture:
    rgb = np.random.default_rng(1).normal(120.0, grain, (608, 608, 3)).clip(0, 255).astype(np.uint8)
    return Picture(rgb, np.full((608, 608), depth_m, np.float32), np.zeros((608, 608), np.int16))


def errors(depth_m: float, frames: int = 12) -> np.ndarray:
    noise = StereoNoise(CAMERA, SMOOTH, 1)
    return np.stack([noise.apply(wall(depth_m), PIN, k) - depth_m for k in range(frames)])


@pytest.mark.parametrize("depth_m", [2.0, 5.0, 8.0])
def test_sigma_grows_with_the_square_of_the_range(depth_m: float) -> None:
    expected = depth_m**2 * TRUTH.disparity_sigma_px / (CAMERA.fx_px * CAMERA.baseline_m)
    assert np.nanstd(errors(depth_m)) == pytest.approx(expected, rel=0.08)


def test_averaging_eight_by_eight_pixels_does_not_remove_it() -> None:
    e = errors(5.0)
    blocks = e.reshape(len(e), 76, 8, 76, 8).mean(axis=(2, 4))
    assert np.nanstd(blocks) > 0.75 * np.nanstd(e)


def test_errors_correlate_over_ten_pixels_and_not_over_forty() -> None:
    e = errors(5.0)
    e = (e - np.nanmean(e)) / np.nanstd(e)

    def alike(lag: int) -> float:
        return float(np.nanmean(e[:, :, lag:] * e[:, :, :-lag]))

    assert alike(10) == pytest.approx(np.exp(-1.0), abs=0.06)
    assert abs(alike(40)) < 0.06


def test_averaging_the_frames_of_a_resting_camera_leaves_seven_tenths_of_it() -> None:
    noise, here = StereoNoise(CAMERA, SMOOTH, 1), View(PIN, np.array([1.0, 2.0, 3.0]), np.eye(3))
    views = [here] * 24, [moved(here, 0.1 * k) for k in range(24)]
    rests, moves = (np.stack([noise.apply(wall(5.0), PIN, k, view) for k, view in enumerate(vs)]) for vs in views)
    assert np.nanstd(moves) == pytest.approx(np.nanstd(rests), rel=0.05)
    assert np.nanstd(rests.mean(axis=0)) == pytest.approx(np.sqrt(0.5) * np.nanstd(rests), rel=0.08)
    assert np.nanstd(moves.mean(axis=0)) < 0.3 * np.nanstd(moves)


def moved(view: View, ahead_m: float) -> View:
    return View(view.intrinsics, view.position_m + np.array([ahead_m, 0.0, 0.0]), view.rotation)


def test_frame_errors_are_independent_and_repeatable() -> None:
    e = errors(5.0, 3)
    assert abs(np.corrcoef(e[0].ravel(), e[1].ravel())[0, 1]) < 0.1
    again = StereoNoise(CAMERA, SMOOTH, 1).apply(wall(5.0), PIN, 2)
    assert np.array_equal(again - 5.0, e[2], equal_nan=True)
    other = StereoNoise(CAMERA, SMOOTH, 2).apply(wall(5.0), PIN, 2)
    assert not np.array_equal(again, other, equal_nan=True)


def test_the_scale_error_is_constant_in_a_run_and_half_to_one_per_cent() -> None:
    scales = [StereoNoise(CAMERA, TRUTH, seed).scale for seed in range(40)]
    assert all(0.005 <= abs(s - 1.0) <= 0.010 for s in scales)
    assert 8 < sum(s > 1.0 for s in scales) < 32
    noise = StereoNoise(CAMERA, TRUTH, 3)
    means = [np.nanmean(noise.apply(wall(3.0), PIN, k)) / 3.0 for k in range(20)]
    assert np.mean(means) == pytest.approx(noise.scale, abs=0.0015)


def test_scenes_have_two_to_ten_per_cent_of_holes() -> None:
    noise = StereoNoise(CAMERA, TRUTH, 1)
    picture = render(site(12), ABOVE)
    inside = picture.depth_m < 15.0
    share = np.mean([np.isnan(noise.apply(picture, ABOVE.intrinsics, k))[inside].mean() for k in range(8)])
    assert 0.02 <= share <= 0.10


def test_a_wall_without_texture_has_more_holes() -> None:
    noise = StereoNoise(CAMERA, TRUTH, 1)
    rough, plain = (
        np.mean([np.isnan(noise.apply(wall(3.0, grain), PIN, k)).mean() for k in range(10)]) for grain in (20.0, 0.5)
    )
    assert rough == pytest.approx(TRUTH.hole_share, abs=0.01)
    assert plain == pytest.approx(TRUTH.plain_hole_share, abs=0.05)


def test_range_limits_and_sky_are_unknown() -> None:
    picture = wall(5.0)
    picture.depth_m[:100], picture.depth_m[100:200], picture.depth_m[200:300] = 0.1, 60.0, np.nan
    depth = StereoNoise(CAMERA, SMOOTH, 1).apply(picture, PIN, 0)
    assert np.isnan(depth[:90]).all() and np.isnan(depth[110:190]).all() and np.isnan(depth[210:290]).all()
    assert np.isfinite(depth[320:]).mean() > 0.99


def test_a_near_surface_grows_and_occludes_the_other_imager_on_its_left() -> None:
    picture = wall(6.0)
    picture.depth_m[:, 300:400] = 2.0
    quiet = replace(SMOOTH, disparity_sigma_px=1e-6)
    depth = StereoNoise(CAMERA, quiet, 1).apply(picture, PIN, 0)
    near = np.count_nonzero(depth[50:-50] < 3.0, axis=1)
    low, high = TRUTH.edge_px
    assert near.min() >= 100 + 2 * (low - 1) and near.max() <= 100 + 2 * (high + 1)
    fb = CAMERA.fx_px * CAMERA.baseline_m
    hidden = np.isnan(depth[50:-50, 200:300]).sum(axis=1)
    assert np.median(hidden) == pytest.approx(fb * (1 / 2.0 - 1 / 6.0), abs=2.0)
    assert np.isnan(depth[50:-50, 420:]).mean() < 0.01


def test_noise_does_not_move_logs() -> None:
    b = SceneBuilder(Ground.flat())
    b.log(log(1, 0.0, 0.0, diameter=0.3))
    picture = render(b.build(), ABOVE)
    on = picture.mask == 1
    noise = StereoNoise(CAMERA, TRUTH, 4)
    off = [np.nanmedian(noise.apply(picture, ABOVE.intrinsics, k)[on] - picture.depth_m[on]) for k in range(20)]
    assert abs(np.mean(off)) < 0.05


def test_a_sampled_camera_is_off_by_at_most_two_degrees_and_three_centimetres() -> None:
    shifts, turns = [], []
    for seed in range(30):
        camera = load_truth("sampled", seed, "aoro_fc8").cameras["front"]
        shifts.append(np.linalg.norm(camera.mount_position_m))
        turns.append(np.linalg.norm(camera.mount_rpy_rad))
        assert 0.1 <= camera.disparity_sigma_px <= 0.25
    assert max(shifts) <= 0.03 and max(turns) <= np.radians(2.0)
    assert np.mean(shifts) > 0.008 and np.mean(turns) > np.radians(0.5)
    nominal = load_truth("nominal", 0, "aoro_fc8").cameras["front"]
    assert nominal.mount_position_m == nominal.mount_rpy_rad == (0.0, 0.0, 0.0)
