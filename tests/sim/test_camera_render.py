"""The analytic renderer against closed forms, against pybullet's renderer, and against itself."""

import math

import numpy as np
import pytest

from sim.camera.geometry import View, look_at
from sim.camera.ground_cover import CLEARING, GroundCover
from sim.camera.labels import labels
from sim.camera.mesh_renderer import MeshRenderer
from sim.camera.render import ImagingConditions, render
from sim.camera.scene import COVER, CRANE, GROUND, SKY, Ground, LogPose, Scene, SceneBuilder
from sim.ground.terrain import Terrain
from tests.sim.camera_scenes import ABOVE, LENS, log, lying, site

DOWN = View(LENS, np.array([0.0, 0.0, 3.0]), np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]))


def rays(view: View) -> np.ndarray:
    """Directions (H, W, 3) with z = 1 in the optical frame."""
    pin = view.intrinsics
    v, u = np.mgrid[0 : pin.height_px, 0 : pin.width_px]
    return np.stack([(u - pin.cx_px) / pin.fx_px, (v - pin.cy_px) / pin.fy_px, np.ones(u.shape)], axis=-1)


def scene_of(*logs: LogPose, ground: Ground | None = None) -> Scene:
    b = SceneBuilder(ground or Ground.flat())
    for one in logs:
        b.log(one)
    return b.build()


def test_level_ground_has_the_depth_of_a_plane() -> None:
    picture = render(scene_of(), ABOVE)
    downward = (rays(ABOVE) @ ABOVE.rotation.T)[..., 2]
    expected = np.where(downward < 0.0, ABOVE.position_m[2] / -np.minimum(downward, -1e-9), np.nan)
    near = expected < 30.0
    assert np.all(picture.mask[near] == GROUND)
    assert np.allclose(picture.depth_m[near], expected[near], rtol=1e-5)
    assert np.all(picture.mask[downward > 0.0] == SKY) and np.all(np.isnan(picture.depth_m[picture.mask == SKY]))


def test_a_log_from_above_has_the_depth_of_a_cylinder() -> None:
    picture = render(scene_of(log(1, 0.0, 0.0, yaw=0.0, diameter=0.3)), DOWN)
    # A cylinder along x: the ray (u, v, 1) z meets y^2 + (z - 2.85)^2 = r^2.
    d = rays(DOWN)
    v = d[..., 1]
    a, b, c = v * v + 1.0, -2.85, 2.85**2 - 0.15**2
    disc = b * b - a * c
    z = (-b - np.sqrt(np.maximum(disc, 0.0))) / a
    hit = (disc > 0.0) & (np.abs(d[..., 0] * z) < 1.25)
    assert np.count_nonzero(hit != (picture.mask == 1)) <= 0.002 * np.count_nonzero(hit)
    both = hit & (picture.mask == 1)
    assert np.count_nonzero(both) > 2000
    assert np.abs(picture.depth_m[both] - z[both]).max() < 2e-4


@pytest.mark.parametrize("taper", [0.0, 0.04])
def test_every_point_of_a_log_lies_on_its_cone(taper: float) -> None:
    one = LogPose(1, (0.2, -0.1, 0.8), lying(0.6), 2.5, 0.3, taper)
    picture = render(scene_of(one), ABOVE)
    on = picture.mask == 1
    points = ABOVE.to_world(rays(ABOVE)[on] * picture.depth_m[on][:, None]) - np.array(one.position_m)
    along = points @ one.axis
    across = np.linalg.norm(points - along[:, None] * one.axis, axis=1)
    cap = np.abs(np.abs(along) - 1.25) < 1e-3
    radius = (one.diameter_m - taper * along) / 2
    assert np.abs(across - radius)[~cap].max() < 1e-3
    assert cap.any() and np.all(across[cap] <= radius[cap] + 1e-3)


def test_a_bowed_log_has_no_gaps_and_bows_to_its_side() -> None:
    straight, bowed = log(1, 0.0, 0.0, diameter=0.2), log(1, 0.0, 0.0, diameter=0.2, sweep_m=0.075)
    # Local x is down for ``lying``: turn the log a quarter about its axis so that it bows sideways.
    half = math.sqrt(0.5)
    x, y, z, w = bowed.quaternion
    turned = (half * (x + y), half * (y - x), half * (z + w), half * (w - z))
    seen = render(scene_of(LogPose(1, bowed.position_m, turned, 2.5, 0.2, 0.0, 0.075)), DOWN).mask == 1
    columns = np.flatnonzero(seen.any(axis=0))
    rows = [np.flatnonzero(seen[:, c]) for c in columns[2:-2]]
    assert all(np.all(np.diff(r) == 1) for r in rows)
    # One metre from the middle the pith of five pieces is 0.68 of the sagitta back, in the middle 0.04.
    left, middle, right = (
        np.flatnonzero(seen[:, round(LENS.cx_px + x * LENS.fx_px / 2.9)]).mean() for x in (-1.0, 0.0, 1.0)
    )
    assert abs(middle - (left + right) / 2) / LENS.fx_px * 2.9 == pytest.approx(0.64 * 0.075, abs=0.008)
    level = render(scene_of(straight), DOWN).mask == 1
    assert abs(int(level.sum()) - int(seen.sum())) < 0.1 * level.sum()


@pytest.mark.parametrize("kind", ["flat", "rough", "slope"])
def test_ground_depth_meets_the_terrain(kind: str) -> None:
    terrain = Terrain(kind, 4)
    ground = Ground(*terrain.origin_m, terrain.cell_m, terrain.heights)
    view = look_at((2.0, -3.0, 3.0), (4.0, 3.0, 0.0), LENS)
    picture = render(SceneBuilder(ground, "forest").build(), view)
    near = (picture.mask == GROUND) & (picture.depth_m < 15.0)
    points = view.to_world(rays(view)[near] * picture.depth_m[near][:, None])
    assert np.count_nonzero(near) > 20_000
    heights = np.array([terrain.height(x, y) for x, y, _ in points])
    assert np.abs(heights - points[:, 2]).max() < 2e-3


@pytest.mark.parametrize("kind", ["flat", "rough"])
def test_pybullets_renderer_agrees(kind: str) -> None:
    terrain = Terrain(kind, 4)
    scene = site(8, ground=Ground(*terrain.origin_m, terrain.cell_m, terrain.heights))
    ours = render(scene, ABOVE)
    second = MeshRenderer(scene)
    try:
        theirs = second.render(ABOVE)
    finally:
        second.close()
    a, b = ((m > 0) & (m < 1000) for m in (ours.mask, theirs.mask))
    assert np.count_nonzero(a & b) / np.count_nonzero(a | b) >= 0.98
    for instance in np.unique(ours.mask[ours.mask > 0]):
        a, b = ours.mask == instance, theirs.mask == instance
        assert np.count_nonzero(a & b) / np.count_nonzero(a | b) >= (0.93 if np.count_nonzero(a) > 300 else 0.8)
    known = np.isfinite(ours.depth_m) & np.isfinite(theirs.depth_m) & (ours.depth_m < 10.0)
    assert np.median(np.abs(ours.depth_m - theirs.depth_m)[known]) < 0.002


def test_held_out_logs_differ_from_the_analytic_ones() -> None:
    scene = scene_of(log(1, 0.0, 0.0, diameter=0.3))
    pictures = []
    for bump in (0.0, 0.01):
        second = MeshRenderer(scene, bump_m=bump, oval=0.1 if bump else 0.0)
        pictures.append(second.render(DOWN))
        second.close()
    both = (pictures[0].mask == 1) & (pictures[1].mask == 1)
    assert 0.002 < np.abs(pictures[0].depth_m - pictures[1].depth_m)[both].mean() < 0.05


def test_the_grapple_hides_what_is_under_it() -> None:
    one = log(1, 0.0, 0.0)
    b = SceneBuilder(Ground.flat())
    b.log(one)
    b.box((0.6, 0.6, 0.1), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), (0.8, 0.2, 0.1), CRANE)
    scene = b.build()
    bare, covered = render(scene_of(one), DOWN), render(scene, DOWN)
    hidden = (bare.mask == 1) & (covered.mask == CRANE)
    assert hidden.any() and np.all(covered.depth_m[hidden] < bare.depth_m[hidden])
    assert np.abs(covered.depth_m[covered.mask == CRANE] - 1.95).max() < 1e-4
    (label,) = labels(scene, DOWN, covered)
    assert label.visible_share == pytest.approx(1.0 - hidden.sum() / (bare.mask == 1).sum())
    assert 0.4 < label.visible_share < 0.8


def test_a_box_around_the_camera_does_not_hide_the_scene() -> None:
    b = SceneBuilder(Ground.flat())
    b.box((0.4, 0.4, 0.4), (0.0, 0.0, 3.0), (0.0, 0.0, 0.0, 1.0), (0.5, 0.5, 0.5), CRANE)
    assert np.all(render(b.build(), DOWN).mask == GROUND)


def test_a_box_beside_the_camera_is_clipped_at_the_near_plane() -> None:
    b = SceneBuilder(Ground.flat())
    b.box((0.2, 8.0, 0.2), (0.3, 0.0, 3.0), (0.0, 0.0, 0.0, 1.0), (0.5, 0.5, 0.5), CRANE)
    picture = render(b.build(), look_at((0.0, 0.0, 3.0), (0.0, 5.0, 3.0), LENS))
    expected = LENS.cx_px + LENS.fx_px * 0.2 / 4.0
    middle = np.flatnonzero(picture.mask[120] == CRANE)
    assert middle[0] == pytest.approx(expected, abs=1.5) and middle[-1] == 319
    assert np.nanmin(picture.depth_m[picture.mask == CRANE]) < 0.3


def test_labels_bound_the_masks() -> None:
    scene = site(10, seed=3)
    picture = render(scene, ABOVE)
    for label in labels(scene, ABOVE, picture):
        seen = np.argwhere(picture.mask == label.instance)
        if not len(seen):
            assert label.box_visible is None and label.visible_share == 0.0
            continue
        (top, left), (bottom, right) = seen.min(axis=0), seen.max(axis=0)
        assert label.box_visible == (left, top, right + 1, bottom + 1)
        full = label.box_full
        assert full[0] <= left and full[1] <= top and full[2] >= right + 1 and full[3] >= bottom + 1
        assert 0.0 < label.visible_share <= 1.0


def test_a_log_behind_the_camera_has_no_box() -> None:
    scene = scene_of(log(1, -9.0, -8.0))
    (label,) = labels(scene, ABOVE, render(scene, ABOVE))
    assert (label.box_visible, label.box_full, label.visible_share) == (None, None, 0.0)


def test_the_sun_casts_a_shadow_and_light_changes_with_the_conditions() -> None:
    sun = ImagingConditions(sun=(0.0, 0.6, 0.8), sky_gain=0.4, sun_gain=0.8, grain=0.0)
    dark = ImagingConditions(sun=(0.0, 0.6, 0.8), sky_gain=0.4, sun_gain=0.0, grain=0.0)
    scene = scene_of(log(1, 0.0, 0.0, diameter=0.3))
    bright, overcast = render(scene, DOWN, sun), render(scene, DOWN, dark)
    ground = bright.mask == GROUND
    gain = bright.rgb[ground].astype(float).sum(axis=1) / np.maximum(
        1.0, overcast.rgb[ground].astype(float).sum(axis=1)
    )
    shade = np.count_nonzero(gain < 1.1) * (3.0 / LENS.fx_px) ** 2
    # The log's axis shades a strip as wide as the cylinder under a slanting sun, less what the log itself hides.
    assert 0.1 < shade < 2.5 * 0.3
    assert ImagingConditions.random(1) != ImagingConditions.random(2) and ImagingConditions.random(
        1
    ) == ImagingConditions.random(1)


def test_ground_cover_is_fixed_and_hides_logs() -> None:
    clutter = GroundCover(Ground.flat(), CLEARING, 5)
    rods, again = clutter.around(0.0, 0.0), GroundCover(Ground.flat(), CLEARING, 5).around(3.0, 0.0)
    here = np.abs(rods.start_m[:, :2]).max(axis=1) < 3.0
    there = np.abs(again.start_m[:, :2]).max(axis=1) < 3.0
    assert here.sum() > 50 and np.array_equal(rods.start_m[here], again.start_m[there])
    b = scene_of(log(1, 0.0, 0.0))
    scene = Scene(b.rods + rods, b.boxes, b.ground, "forest", b.logs, {})
    low = look_at((-2.5, -3.0, 0.4), (0.0, 0.0, 0.1), LENS)
    bare, wild = render(b, low), render(scene, low)
    assert np.count_nonzero((bare.mask == 1) & (wild.mask == COVER)) > 20
