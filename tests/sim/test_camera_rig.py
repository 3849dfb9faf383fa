"""Cameras on a plant: mounts, frames and the scene read from the physics."""

from collections.abc import Iterator

import numpy as np
import pytest
from msgspec.structs import replace

from machine.geometry.optics import intrinsics
from machine.loading.profile_file import load_profile
from sim.camera.geometry import mount_view
from sim.camera.mesh_renderer import MeshRenderer
from sim.camera.rig import CameraRig
from sim.camera.scene import BUNK, CRANE, WorldScenes
from sim.wood.log_shape import LogSpec
from sim.world import World, open_world

PALMS = load_profile("palms_471")


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    cx, cy = PALMS.workspace.pick_center_m
    scene = (
        LogSpec(cx, cy, 0.3, 2.6, 0.25, 605.0, taper_m_m=0.01, sweep=0.02),
        LogSpec(cx - 0.2, cy + 0.6, 0.3, 2.5, 0.18, 605.0),
    )
    plant = open_world(PALMS, seed=1, scene=scene)
    yield plant
    plant.close()


def test_the_scene_has_the_logs_at_their_physical_poses(world: World) -> None:
    scene = WorldScenes(world)()
    assert [log.instance for log in scene.logs] == [1, 2]
    for log, state in zip(scene.logs, world.log_bodies.states(), strict=True):
        spine, _ = log.spine(4)
        assert spine[0] == pytest.approx(state.ends_m[0], abs=1e-6)
        assert spine[-1] == pytest.approx(state.ends_m[1], abs=1e-6)
        own = scene.rods.instance == log.instance
        assert np.allclose(scene.rods.start_m[own][0], state.ends_m[0], atol=1e-6)
    assert {CRANE, BUNK} <= set(scene.boxes.instance.tolist())


def test_a_frame_carries_the_nominal_mount_and_the_true_pose(world: World) -> None:
    rig = CameraRig(world, PALMS, world.truth, 3)
    frame = rig.frame("d435", 5_000_000)
    assert (frame.stamp_ns, frame.rgb.shape, frame.depth_m.dtype) == (5_000_000, (608, 608, 3), np.float32)
    assert frame.mount.link == "base" and frame.mount.position_m == PALMS.cameras["d435"].position_m
    camera = PALMS.cameras["d435"]
    nominal = mount_view(world.base_pose(), intrinsics(camera), camera.position_m, camera.rpy_rad)
    assert np.allclose(frame.true_position_m, nominal.position_m) and np.allclose(frame.true_rotation, nominal.rotation)
    assert frame.rgb[:60].max() == 0 and np.isnan(frame.depth_m[:60]).all()  # letterbox bars
    assert np.nanmedian(frame.depth_m) == pytest.approx(3.1, abs=0.15)


def test_the_mount_error_moves_the_picture_but_not_the_nominal_mount(world: World) -> None:
    camera = world.truth.cameras["d435"]
    off = replace(camera, mount_position_m=(0.0, 0.03, 0.0), mount_rpy_rad=(0.0, 0.0, 0.02))
    truth = replace(world.truth, cameras=world.truth.cameras | {"d435": off})
    good, bad = (CameraRig(world, PALMS, t, 3, size_px=None) for t in (world.truth, truth))
    a, b = good.frame("d435", 0), bad.frame("d435", 0)
    assert a.mount == b.mount
    body_left = -a.true_rotation[:, 0]
    assert b.true_position_m - a.true_position_m == pytest.approx(0.03 * body_left, abs=1e-9)
    assert np.degrees(np.arccos((np.trace(a.true_rotation.T @ b.true_rotation) - 1) / 2)) == pytest.approx(
        1.146, abs=0.01
    )
    (_, _, first), (_, _, second) = good.picture("d435"), bad.picture("d435")
    middles = [np.argwhere((p.mask > 0) & (p.mask < 100)).mean(axis=0) for p in (first, second)]
    assert 5.0 < np.linalg.norm(middles[0] - middles[1]) < 20.0


def test_frames_repeat_with_the_seed_and_differ_in_noise(world: World) -> None:
    first, again, other = (CameraRig(world, PALMS, world.truth, seed, size_px=None) for seed in (3, 3, 4))
    a, b, c = first.frame("d435", 0), again.frame("d435", 0), other.frame("d435", 0)
    assert np.array_equal(a.rgb, b.rgb) and np.array_equal(a.depth_m, b.depth_m, equal_nan=True)
    assert not np.array_equal(a.rgb, c.rgb)
    assert not np.array_equal(a.depth_m, first.frame("d435", 1).depth_m, equal_nan=True)


def test_the_stick_camera_sees_the_grapple_and_pybullet_agrees(world: World) -> None:
    scene, view, picture = CameraRig(world, PALMS, world.truth, 3, size_px=320).picture("stick")
    assert np.count_nonzero(picture.mask == CRANE) > 500
    second = MeshRenderer(scene)
    try:
        theirs = second.render(view)
    finally:
        second.close()
    a, b = ((m > 0) & (m < 100) for m in (picture.mask, theirs.mask))
    assert np.count_nonzero(a & b) / np.count_nonzero(a | b) >= 0.93
    known = np.isfinite(picture.depth_m) & np.isfinite(theirs.depth_m) & (picture.depth_m > 0.4)
    assert np.median(np.abs(picture.depth_m - theirs.depth_m)[known & (picture.depth_m < 12.0)]) < 0.02


@pytest.mark.long
def test_a_carriers_front_camera_sees_the_ground_ahead() -> None:
    profile = load_profile("aoro_fc8")
    plant = open_world(profile, seed=1, scene=(LogSpec(7.0, 0.0, 1.2, 2.0, 0.25, 900.0),), terrain="rough")
    try:
        scene, view, picture = CameraRig(plant, profile, plant.truth, 2, size_px=320).picture("front")
    finally:
        plant.close()
    assert scene.style == "forest" and view.rotation[0, 2] > 0.8 and view.rotation[2, 2] < -0.3
    assert np.count_nonzero(picture.mask == 1) > 100
    assert np.count_nonzero(picture.mask == 0) > 0.4 * picture.mask.size
