"""Cylinder fits against the renderer's ground truth in one frame: exact depth, stereo, occlusion, invalid input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from autonomy.perception import papers
from autonomy.perception.camera.frame import Pose
from autonomy.perception.fitting.contour import StereoSensor, log_contour
from autonomy.perception.fitting.cylinder import (
    Cylinder,
    CylinderBatch,
    across_view,
    outline_distance,
    pixel_rays,
    surface_depth,
)
from autonomy.perception.fitting.cylinder_fit import CylinderFit, fit_cylinder
from autonomy.perception.fitting.measure import implausibility, initial_cylinder
from autonomy.perception.log_detector import Perception
from runtime.errors import InputRefused
from sim.camera.geometry import View
from sim.camera.scene import BUNK, SceneBuilder
from tests.autonomy.log_views import (
    CAMERA,
    PIN,
    PROFILE,
    TrueMask,
    frame_of,
    lying,
    masks_of,
    scene_of,
    seen,
    view_from,
)
from tests.codes import coded


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, abs(float(a @ b)))))


def shot(*logs, exact: bool = True):
    """A picture of logs, the view that it was taken from, and the frame of it."""
    view = view_from()
    picture = seen(scene_of(*logs), view)
    return picture, view, frame_of(picture, view, exact=exact)


def ends_of(fit: CylinderFit, view: View) -> np.ndarray:
    return view.to_world(fit.body.center_m + np.outer((-0.5, 0.5), fit.body.length_m * fit.body.axis))


def fits_of(*logs):
    picture, view, frame = shot(*logs)
    return Perception(PROFILE).fits(frame, masks_of(picture)), view


@pytest.mark.parametrize("degrees", [0.0, 20.0, 55.0, 90.0])
@pytest.mark.long
def test_outline_and_depth_agree_with_the_renderer(degrees: float) -> None:
    log = lying(1, 4.6, 0.2, degrees)
    picture, view, _ = shot(log)
    v, u = np.mgrid[200:420:3, 400:900:3]
    body = Cylinder(view.to_optical(np.array([log.position_m]))[0], view.rotation.T @ log.axis, -1.0, 1.0, 0.125)
    rays = pixel_rays(PIN, u.ravel(), v.ravel())
    inside = outline_distance(CylinderBatch.of(body), rays)[0] < 0.0
    truly = (picture.mask[v, u] == 1).ravel()
    assert np.mean(inside != truly) < 0.004
    both = inside & truly
    apart = np.abs(surface_depth(CylinderBatch.of(body), rays[both])[0] - picture.depth_m[v, u].ravel()[both])
    assert np.quantile(apart, 0.98) < 0.01 and np.median(apart) < 1e-3


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 90.0])
@pytest.mark.long
def test_with_exact_depth_the_fit_is_accurate_to_two_centimetres(degrees: float) -> None:
    log = lying(1, 4.6, 0.2, degrees)
    (fit,), view = fits_of(log)
    assert np.linalg.norm(view.to_world(fit.body.center_m[None])[0] - log.position_m) < 0.02
    assert angle_deg(view.rotation @ fit.body.axis, log.axis) < 0.6
    assert abs(2 * fit.body.radius_m - 0.25) < 0.005 and abs(fit.body.length_m - 2.0) < 0.04
    assert fit.ends_seen == (True, True) and fit.explained > 0.98


@pytest.mark.parametrize("sweep_m", [0.02, 0.04, 0.06])
def test_the_middle_of_a_bowed_log_is_fitted(sweep_m: float) -> None:
    log = replace(lying(1, 4.6, 0.2, 0.0), sweep_m=sweep_m)  # a straight one was found 6 and 10 cm off
    truth = log.spine(40)[0].mean(axis=0)
    (fit,), view = fits_of(log)
    miss = view.to_world(fit.body.center_m[None])[0] - truth
    assert np.linalg.norm(miss) < 0.035, miss


@pytest.mark.parametrize("degrees", [0.0, 45.0, 90.0])
def test_the_covariance_covers_stereo_errors(degrees: float) -> None:
    log = lying(1, 4.6, 0.2, degrees)
    picture, view, _ = shot(log)
    perception, squares = Perception(PROFILE), []
    for i in range(6):
        (fit,) = perception.fits(frame_of(picture, view, i), masks_of(picture))
        miss = fit.body.center_m - view.to_optical(np.array([log.position_m]))[0]
        across = miss - (miss @ fit.body.axis) * fit.body.axis
        spread = fit.covariance[0, 0] + fit.covariance[1, 1]
        squares.append(float(across @ across) / spread)
        assert np.linalg.norm(miss) < 0.15
        assert np.all(np.linalg.eigvalsh(fit.covariance) > 0.0)
    assert np.mean(squares) < 3.0


def test_an_end_hidden_by_another_log_is_not_an_end() -> None:
    back, front = lying(1, 5.2, 0.0, 90.0), lying(2, 4.3, 0.8, 10.0, length=1.6, diameter=0.5)
    fits, view = fits_of(back, front)
    fit = min(fits, key=lambda f: abs(f.body.radius_m - 0.125))
    left = 1 if (view.rotation @ fit.body.axis)[1] < 0 else 0  # the end towards -y is free
    assert fit.ends_seen[left] and not fit.ends_seen[1 - left]
    sigmas_m = np.sqrt(np.diag(fit.covariance))[4:6]
    assert sigmas_m[1 - left] > 0.2 > 5.0 * sigmas_m[left]
    assert ends_of(fit, view)[left] == pytest.approx([5.2, -1.0, 0.125], abs=0.04)


def test_contour_that_is_not_its_own_says_nothing_of_the_width() -> None:
    """The same log, once with its lower side marked as hidden: it may be wider there."""
    sensor = StereoSensor(CAMERA.fx_px * CAMERA.baseline_m)
    picture, _, frame = shot(lying(1, 4.6, 0.0, 90.0), exact=False)
    mask, depth_m = picture.mask == 1, frame.depth_m
    first = initial_cylinder(mask, depth_m, PIN, 3.0 * 0.2 / sensor.fb_px_m)
    whole = log_contour(mask, depth_m, PIN, first, sensor, (0, 0, PIN.width_px, PIN.height_px))
    half = replace(whole, own=whole.own & (whole.v_px < np.median(whole.v_px)))
    sure, unsure = (fit_cylinder(mask, depth_m, PIN, first, edge, sensor) for edge in (whole, half))
    assert sure.covariance[6, 6] < 0.006**2 and unsure.covariance[6, 6] > 0.02**2
    assert unsure.covariance[1, 1] > 3.0 * sure.covariance[1, 1], "depth beside it may be that of what hides it"


@pytest.mark.parametrize(("away_m", "diameter"), [(4.75, 0.25), (4.72, 0.28)])
def test_a_half_hidden_log_is_not_fitted_as_a_thin_one(away_m: float, diameter: float) -> None:
    back, front = lying(1, 5.0, 0.0, 90.0), lying(2, away_m, 0.1, 92.0, length=2.6, diameter=diameter)
    picture, view, _ = shot(back, front)
    true_m = view.to_optical(np.array([back.position_m]))[0]
    for i in range(3):
        fits = Perception(PROFILE).fits(frame_of(picture, view, i), masks_of(picture))
        fit, other = sorted(fits, key=lambda f: f.body.length_m)
        sigma = np.sqrt(np.diag(fit.covariance))
        assert abs(fit.body.radius_m - 0.125) < min(2.0 * sigma[6], 0.035)
        off = (fit.body.center_m - true_m) @ np.stack(across_view(fit.body.axis, fit.body.point_m), axis=1)
        assert np.all(np.abs(off) < 2.0 * sigma[:2])
        assert abs(fit.covariance[0, 6]) > 0.9 * sigma[0] * sigma[6], "a thicker log would lie lower"
        assert math.sqrt(other.covariance[6, 6]) < 0.006, "the one before it is seen whole"


def test_fragments_on_both_sides_of_an_occluder_are_one_log() -> None:
    log = lying(1, 5.2, 0.0, 90.0, length=2.6)
    b = SceneBuilder(scene_of().ground, "forest")
    b.log(log)
    b.box((0.3, 0.5, 0.9), (4.4, 0.1, 0.45), (0.0, 0.0, 0.0, 1.0), (0.3, 0.3, 0.3), BUNK)
    view = view_from()
    picture = seen(b.build(), view)
    columns = np.arange(picture.mask.shape[1])
    middle = int(np.median(np.nonzero(picture.mask == BUNK)[1]))
    halves = [TrueMask((picture.mask == 1) & side) for side in (columns < middle, columns >= middle)]
    assert all(h.mask.any() for h in halves)
    (fit,) = Perception(PROFILE).fits(frame_of(picture, view, exact=True), halves)
    assert fit.body.length_m == pytest.approx(2.6, abs=0.06) and fit.ends_seen == (True, True)
    assert view.to_world(fit.body.center_m[None])[0] == pytest.approx(log.position_m, abs=0.04)


def test_two_logs_in_line_stay_two() -> None:
    fits, _ = fits_of(lying(1, 5.0, -1.3, 90.0), lying(2, 5.0, 1.3, 90.0))
    assert sorted(round(f.body.length_m, 1) for f in fits) == [2.0, 2.0]


def test_only_the_largest_part_of_a_mask_that_is_too_long_is_fitted() -> None:
    log = lying(1, 4.6, 0.0, 0.0)
    picture, view, frame = shot(log)
    v, u = np.nonzero(picture.mask == 1)
    stray = np.zeros(picture.mask.shape, bool)
    stray[v.min() - 260 : v.min() - 180, int(u.mean()) - 15 : int(u.mean()) + 15] = True  # the far end of a boom, say
    depth_m = np.where(stray, np.float32(14.0), frame.depth_m)
    (fit,) = Perception(PROFILE).fits(replace(frame, depth_m=depth_m), [TrueMask((picture.mask == 1) | stray)])
    assert fit.body.length_m == pytest.approx(2.0, abs=0.2)
    assert np.linalg.norm(view.to_world(fit.body.center_m[None])[0] - log.position_m) < 0.1


def test_a_log_half_outside_the_picture_has_one_end() -> None:
    log = lying(1, 3.2, 4.0, 90.0, length=3.0)
    (fit,), view = fits_of(log)
    seen_ends = ends_of(fit, view)
    inner = int(np.argmin(np.abs(seen_ends[:, 1])))
    assert fit.ends_seen[inner] and not fit.ends_seen[1 - inner]
    assert seen_ends[inner] == pytest.approx([3.2, 2.5, 0.125], abs=0.06)


@pytest.mark.parametrize("short_px", [0, 2, 5])
@pytest.mark.parametrize("degrees", [0.0, 75.0, 90.0])
def test_an_end_at_the_edge_of_the_picture_is_unknown(degrees: float, short_px: int) -> None:
    """A network's mask may stop a few pixels before the edge of the picture: that is not an end of the log either."""
    picture, _, frame = shot(lying(1, 2.6, 3.3, degrees, length=3.0), exact=False)
    mask = picture.mask == 1
    mask[:, :short_px] = mask[-short_px or mask.shape[0] :] = False
    (fit,) = Perception(PROFILE).fits(frame, [TrueMask(mask)])
    assert sorted(fit.ends_seen) == [False, True]
    unseen = fit.ends_seen.index(False)
    sigmas_m = np.sqrt(np.diag(fit.covariance))[4:6]
    assert sigmas_m[unseen] > 0.5 and sigmas_m[1 - unseen] < 0.1


def test_an_implausible_fit_is_rejected_with_a_reason() -> None:
    (fit,), _ = fits_of(lying(1, 4.6, 0.0, 90.0))
    assert implausibility(fit) is None
    short = replace(fit.body, start_m=-0.1, end_m=0.1, radius_m=0.11)
    assert implausibility(replace(fit, body=short)).code == "too-wide"
    assert implausibility(replace(fit, body=replace(fit.body, radius_m=0.6))).code == "bad-width"
    assert implausibility(replace(fit, explained=0.3)).code == "bad-contour"
    vague = fit.covariance.copy()
    vague[3, 3] = 0.5
    assert implausibility(replace(fit, covariance=vague)).code == "unknown-direction"


def test_no_mask_no_depth_and_an_invalid_frame_give_no_log() -> None:
    picture, _, frame = shot(lying(1, 4.6, 0.2, 90.0))
    perception = Perception(PROFILE)
    assert perception.fits(frame, []) == []
    assert perception.fits(frame, [TrueMask(np.zeros_like(picture.mask, bool))]) == []
    blind = replace(frame, depth_m=np.where(picture.mask == 1, np.nan, frame.depth_m))
    assert perception.fits(blind, masks_of(picture)) == []
    assert perception.rejections[0].code == "too-little-depth"
    with pytest.raises(InputRefused, check=coded("frame.depth-unknown")):
        perception.fits(replace(frame, depth_m=np.full_like(frame.depth_m, np.nan)), [])
    with pytest.raises(InputRefused, check=coded("frame.unknown-camera")):
        perception.fits(replace(frame, camera="rear"), [])
    with pytest.raises(InputRefused, check=coded("frame.bad-mask")):
        perception.fits(frame, [TrueMask(np.zeros((3, 3), bool))])
    with pytest.raises(InputRefused, check=coded("frame.bad-size")):
        perception.fits(replace(frame, intrinsics=PIN.scaled(0.5)), [])


def test_noise_in_a_mask_gives_a_log_or_a_rejection() -> None:
    rng, (picture, _, frame), perception = np.random.default_rng(3), shot(), Perception(PROFILE)
    for _ in range(12):
        mask = np.zeros(picture.mask.shape, bool)
        top, left = rng.integers(0, 600), rng.integers(0, 1200)
        mask[top : top + rng.integers(1, 120), left : left + rng.integers(1, 80)] = rng.random() < 0.8
        mask &= rng.random(mask.shape) < rng.choice([0.2, 0.9, 1.0])
        wild = replace(frame, depth_m=rng.uniform(0.3, 20.0, mask.shape).astype(np.float32))
        fits = perception.fits(wild, [TrueMask(mask)])
        assert len(fits) + len(perception.rejections) == 1
        assert all(np.isfinite(f.covariance).all() for f in fits)


def test_the_initial_cylinder_needs_depth_and_ignores_outliers() -> None:
    picture, _, _ = shot(lying(1, 4.6, 0.2, 90.0))
    mask, depth_m = picture.mask == 1, picture.depth_m.copy()
    slack = 3.0 * 0.2 / (CAMERA.fx_px * CAMERA.baseline_m)
    clean = initial_cylinder(mask, depth_m, PIN, slack)
    rng = np.random.default_rng(1)
    depth_m[mask & (rng.random(mask.shape) < 0.3)] = 1.5
    dirty = initial_cylinder(mask, depth_m, PIN, slack)
    assert np.linalg.norm(clean.center_m - dirty.center_m) < 0.05
    assert initial_cylinder(mask, np.full_like(depth_m, np.nan), PIN, slack) is None


def test_paper_a_reads_axis_width_and_trimmed_ends_from_a_mask_and_its_points() -> None:
    log = lying(1, 4.6, 0.2, 90.0)
    picture, view, frame = shot(log)
    found = papers.log_from_mask(frame, picture.mask == 1)
    assert found.length_m == pytest.approx(2.0, abs=0.05) and found.diameter_m == pytest.approx(0.25, abs=0.02)
    assert angle_deg(view.rotation @ found.axis, log.axis) < 1.0
    off = view.to_world(found.center_m[None])[0] - log.position_m
    assert np.linalg.norm(off) < 0.03, "behind the surface, which lies 0.12 m before it"
    assert papers.log_from_mask(frame, np.zeros_like(picture.mask, bool)) is None


@pytest.mark.parametrize(("lean_deg", "confirmed"), [(20.0, 1), (40.0, 0)])
def test_a_steep_cylinder_is_not_a_log(lean_deg: float, confirmed: int) -> None:
    picture, view, _ = shot(lying(1, 4.6, 0.0, 90.0))
    c, s = math.cos(math.radians(lean_deg)), math.sin(math.radians(lean_deg))
    leaning = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ view.rotation
    perception = Perception(PROFILE)
    for i in range(3):
        frame = frame_of(picture, view, i)
        tracks = perception.step(frame, Pose(view.position_m, leaning), masks_of(picture))
    assert len(tracks) == confirmed


def test_a_log_with_depth_only_at_its_border_is_rejected() -> None:
    picture, _, frame = shot(lying(1, 4.6, 0.0, 90.0))
    inner = binary_erosion(picture.mask == 1, iterations=3)
    perception = Perception(PROFILE)
    assert perception.fits(replace(frame, depth_m=np.where(inner, np.nan, frame.depth_m)), masks_of(picture)) == []
    assert [r.code for r in perception.rejections] == ["too-little-depth"]
