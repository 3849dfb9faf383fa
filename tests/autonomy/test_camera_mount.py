"""The pose of a camera: from joint positions, compared with the plant, and from a survey."""

from contextlib import closing

import numpy as np
import pytest
from msgspec.structs import replace

from autonomy.perception.camera.frame import Pose, optical_pose
from autonomy.perception.camera.survey import surveyed
from machine.geometry.optics import BODY_FROM_OPTICAL, intrinsics, rpy_matrix
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused
from sim.camera.geometry import mount_view, quaternion_matrix
from sim.world import open_world
from tests.codes import coded


@pytest.mark.parametrize(
    ("machine", "camera", "home"),
    [
        ("palms_471", "stick", {"slew": 0.7, "lift": 0.5, "tilt": -1.2, "ext": 0.2}),
        ("palms_471", "d435", {}),
        ("aoro_fc8", "front", {}),
    ],
)
def test_the_kinematic_chain_agrees_with_the_plant(machine: str, camera: str, home: dict[str, float]) -> None:
    profile = load_profile(machine)
    spec = profile.cameras[camera]
    with closing(open_world(profile, truth="nominal", seed=1, scene=(), home=home or None)) as world:
        # The column bends under the crane's weight, which no encoder measures: keep it rigid here.
        if home:
            world._place(home | {"flex_pitch": 0.0, "flex_roll": 0.0})
            world._read()
        q = [world.q[name] for name in ("slew", "lift", "tilt", "ext")]
        bend = world.carrier.articulation_rad if world.carrier else 0.0
        true = mount_view(world.link_poses()[spec.link], intrinsics(spec), spec.position_m, spec.rpy_rad)
        at, turn = world.base_pose()
    base = quaternion_matrix(turn)
    pose = optical_pose(profile, spec, q, bend)
    assert np.abs(base.T @ (true.position_m - at) - pose.position_m).max() < 1e-6
    assert np.abs(base.T @ true.rotation - pose.rotation).max() < 1e-6


def test_articulation_turns_the_front_camera() -> None:
    profile = load_profile("aoro_fc8")
    q = [0.0, 1.0, -2.0, 0.0]
    straight, bent = (optical_pose(profile, profile.cameras["front"], q, a) for a in (0.0, 0.4))
    turned = straight.rotation.T @ bent.rotation
    assert np.arccos((np.trace(turned) - 1.0) / 2.0) == pytest.approx(0.4)


def test_a_camera_on_a_swinging_link_is_refused() -> None:
    profile = load_profile("palms_471")
    with pytest.raises(InputRefused, check=coded("camera-mount.unknown-link")):
        optical_pose(profile, replace(profile.cameras["stick"], link="rotator"), [0.0, 0.5, -1.0, 0.0])


def targets(seed: int, wrong_m: float = 0.0):
    """What a camera that is 3 cm and 1.5 degrees off its profile, with 0.7 % too much depth, sees of a survey."""
    rng = np.random.default_rng(seed)
    camera = load_profile("aoro_fc8").cameras["front"]
    pin = intrinsics(camera)
    body = rpy_matrix(camera.rpy_rad)
    at = np.array(camera.position_m) + body @ (0.02, -0.02, 0.01)
    optical = body @ rpy_matrix((0.01, -0.02, 0.015)) @ BODY_FROM_OPTICAL
    z = rng.uniform(3.0, 8.0, 14)
    pixels = np.stack([rng.uniform(60, 1220, 14), rng.uniform(60, 660, 14)], axis=1)
    local = np.stack([pin.deproject(u, v, d) for (u, v), d in zip(pixels, z, strict=True)])
    places = local @ optical.T + at + rng.normal(0.0, 0.002 + wrong_m, (14, 3))
    return camera, pixels + rng.normal(0.0, 0.3, (14, 2)), 1.007 * z, places, at, optical


def test_a_survey_estimates_mount_and_scale() -> None:
    link = Pose(np.zeros(3), np.eye(3))
    camera, pixels, depths, places, at, optical = targets(1)
    depths[3] = np.nan
    found = surveyed(camera, link, pixels, depths, places)
    assert np.linalg.norm(np.array(found.position_m) - at) < 0.008
    assert np.abs(rpy_matrix(found.rpy_rad) @ BODY_FROM_OPTICAL - optical).max() < 0.002
    assert found.depth_scale == pytest.approx(1.007, abs=0.001)


def test_an_impossible_survey_is_refused() -> None:
    link = Pose(np.zeros(3), np.eye(3))
    camera, pixels, depths, places, _, _ = targets(2)
    with pytest.raises(InputRefused, check=coded("camera-mount.too-few-targets")):
        surveyed(camera, link, pixels[:5], depths[:5], places[:5])
    with pytest.raises(InputRefused, check=coded("camera-mount.bad-targets")):
        surveyed(camera, link, pixels[::-1], depths, places)
    with pytest.raises(InputRefused, check=coded("camera-mount.bad-depth-scale")):
        surveyed(camera, link, pixels, 1.3 * depths, places)
