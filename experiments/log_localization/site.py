"""The test site: rough ground with grass and branches, two logs 5 m apart, and a carrier that approaches them.

The logs differ from those used for training: tapered, bowed, oval, with rough bark, and drawn by pybullet.  The carrier
is not simulated: it is placed with its wheels on the ground.  World frame: it drives along +x, and log 1 lies at the
origin.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from autonomy.perception.camera.frame import Pose, RgbdFrame, rescaled
from hil.calibration import survey
from machine.geometry.optics import intrinsics, rpy_matrix
from machine.profile import Camera, Profile
from sim.camera.geometry import View, look_at, mount_view
from sim.camera.ground_cover import CLEARING, GroundCover
from sim.camera.mesh_renderer import MeshRenderer
from sim.camera.noise import StereoNoise
from sim.camera.render import Picture
from sim.camera.scene import Ground, LogPose, Scene, SceneBuilder
from sim.ground.terrain import Terrain
from sim.world import open_world

CAMERA: Final = "front"
APART_M: Final = 5.0
STOP_M: Final = 4.68  # from below the camera to the middle of the log: 5.2 m from the camera, which is 2.3 m above
LATERAL_M: Final = 0.4
CLUTTER_M: Final = 2.2  # grass and branches are drawn this far around a log
BUMP_M, OVAL = 0.003, 0.05  # bark (standard deviation) and the largest flattening of a log


@dataclass(frozen=True, slots=True)
class Shape:
    """A log of the site: its pose, and the middle of its pith (3,) [m]."""

    pose: LogPose
    center_m: np.ndarray

    @property
    def axis(self) -> np.ndarray:
        """Unit vector (3,) along its chord."""
        return self.pose.axis


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture without noise, the true view of its camera, and the pose of the front frame."""

    picture: Picture
    view: View
    at_m: np.ndarray
    turn: np.ndarray


class Site:
    """Ground, logs, camera and receiver of one trial, all drawn from ``seed``.

    ``degrees`` turns both logs: 0 lies across the path of the machine, 90 along it (paper B, Fig. 11).
    """

    def __init__(self, profile: Profile, truth: str, seed: int, degrees: float, logs: int = 2) -> None:
        self.profile, self.camera = profile, profile.cameras[CAMERA]
        world = open_world(profile, truth=truth, seed=seed, scene=())
        try:
            self._truth = world.truth
        finally:
            world.close()
        self._rng = random.Random(f"site {seed} {degrees}")
        terrain = Terrain("rough", seed)
        self._ground = Ground(*terrain.origin_m, terrain.cell_m, terrain.heights)
        self._lying = [self._log(i, i * APART_M, degrees) for i in range(logs)]
        self._seed = seed
        self._noise = StereoNoise(self.camera, self._truth.cameras[CAMERA], f"{CAMERA} {seed}")
        self._frames = 0
        self._renderers: dict[int, MeshRenderer] = {}
        gnss = self._truth.gnss
        assert gnss is not None
        rtk = gnss.fixes["rtk_fixed"]
        self._gnss = (rtk.noise_m, rtk.wander_m, gnss.height_factor, gnss.attitude_noise_rad, gnss.phase_noise_m)
        self._wander = np.array([self._rng.gauss(0.0, rtk.wander_m) for _ in range(3)]) * (1, 1, gnss.height_factor)
        self._oval = self._rng.uniform(0.0, OVAL)
        self.surveyed = survey(self.camera, self._truth.cameras[CAMERA], self._noise.scale, self._rng)

    def close(self) -> None:
        """Release the renderers."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    @property
    def logs(self) -> list[Shape]:
        """Ground truth of the logs."""
        return self._lying

    def _log(self, number: int, x: float, degrees: float) -> Shape:
        rng = self._rng
        y, yaw = rng.uniform(-LATERAL_M, LATERAL_M), math.radians(90.0 - degrees) + rng.uniform(-0.03, 0.03)
        yaw += rng.choice((0.0, math.pi))  # butt or thin end first
        length, diameter = rng.uniform(1.9, 2.1), rng.uniform(0.20, 0.30)
        half = 0.5 * length
        ends = [self._ground.height(x + s * half * math.cos(yaw), y + s * half * math.sin(yaw)) for s in (-1, 1)]
        pitch = math.atan2(ends[1] - ends[0], length)
        # It lies on the highest points below it, slightly sunk into grass.
        steps = np.linspace(-half, half, 9)
        over = [self._ground.height(x + s * math.cos(yaw), y + s * math.sin(yaw)) - s * math.tan(pitch) for s in steps]
        z = max(over) + 0.5 * diameter - 0.02
        along = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
        roll = rng.uniform(-math.pi, math.pi)
        side = np.cross((0.0, 0.0, 1.0), along)
        side /= np.linalg.norm(side)
        bow = math.cos(roll) * side + math.sin(roll) * np.cross(along, side)
        turn = np.stack([bow, np.cross(along, bow), along], axis=1)
        taper, sweep = rng.uniform(0.004, 0.012), rng.uniform(0.0, 0.03) * length
        pose = LogPose(number + 1, (x, y, z), _quaternion(turn), length, diameter, taper, sweep)
        points, _ = pose.spine(40)
        return Shape(pose, points.mean(axis=0))

    def _scene(self, first: int) -> Scene:
        b = SceneBuilder(self._ground, "forest")
        for log in self._lying[first:]:
            b.log(log.pose)
        scene = b.build()
        clutter = GroundCover(self._ground, CLEARING, self._seed)
        for log in self._lying[first:]:
            near = clutter.around(float(log.center_m[0]), float(log.center_m[1]), CLUTTER_M)
            scene = replace(scene, rods=scene.rods + near)
        return scene

    def _front(self, x: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the pose (position, rotation) of the front frame on the ground with the camera above ``x``."""
        c = self.profile.carrier
        assert c is not None
        at = x - self.camera.position_m[0]
        side = 0.5 * c.track_width_m
        left, right = (self._ground.height(at + c.front_axle_m, s) for s in (side, -side))
        rear = 0.5 * (self._ground.height(at - c.rear_axle_m, side) + self._ground.height(at - c.rear_axle_m, -side))
        front = 0.5 * (left + right)
        span = c.front_axle_m + c.rear_axle_m
        pitch, roll = math.atan2(rear - front, span), math.atan2(left - right, 2.0 * side)
        height = c.wheel_radius_m + c.arm_drop_low_m + c.arm_transport_m
        z = rear + (front - rear) * c.rear_axle_m / span + height
        return np.array([at, 0.0, z]), rpy_matrix((roll, pitch, 0.0))

    def shot(self, x: float, first: int = 0) -> Shot:
        """Take the picture with the camera above ``x``; logs before number ``first`` are removed."""
        at, turn = self._front(x)
        view = self._view(at, turn)
        if first not in self._renderers:
            self._renderers[first] = MeshRenderer(self._scene(first), BUMP_M, self._oval, self._seed)
        return Shot(self._renderers[first].render(view), view, at, turn)

    def estimated_pose(self, shot: Shot) -> Pose:
        """Compute the pose of the camera as the machine estimates it; the receiver has a new error in every frame."""
        noise, _, up, attitude, phase = self._gnss
        measured = shot.at_m + self._wander + np.array([self._rng.gauss(0.0, noise * f) for f in (1.0, 1.0, up)])
        heading = math.sqrt(2.0) * phase / 1.8
        wrong = rpy_matrix([self._rng.gauss(0.0, s) for s in (attitude, attitude, heading)])
        return _optical(measured, shot.turn @ wrong, self.surveyed)

    def _view(self, at: np.ndarray, turn: np.ndarray) -> View:
        truth, camera = self._truth.cameras[CAMERA], self.camera
        errors = (truth.mount_position_m, truth.mount_rpy_rad)
        return mount_view(
            (at.tolist(), _quaternion(turn)), intrinsics(camera), camera.position_m, camera.rpy_rad, *errors
        )

    def frame(self, shot: Shot, stamp_ns: int) -> RgbdFrame:
        """Make the frame that the surveyed camera delivers for a shot; every call has its own noise."""
        pin = intrinsics(self.camera)
        depth_m = self._noise.apply(shot.picture, pin, self._frames)
        self._frames += 1
        raw = RgbdFrame(CAMERA, stamp_ns, shot.picture.rgb, depth_m, pin)
        return rescaled(raw, self.surveyed.depth_scale)

    def single(self, range_m: float) -> Shot:
        """Take a picture of log 1 from a camera at this range and an exactly known pose, mounted as on the machine."""
        log = self._lying[0]
        height = self.camera.position_m[2] + 0.8
        ahead = math.sqrt(max(0.3, range_m**2 - (height - 0.12) ** 2))
        pitch = self.camera.rpy_rad[1]
        eye = log.center_m + np.array([-ahead, 0.0, height - 0.12])
        view = look_at(eye, eye + np.array([math.cos(pitch), 0.0, -math.sin(pitch)]), intrinsics(self.camera))
        if 0 not in self._renderers:
            self._renderers[0] = MeshRenderer(self._scene(0), BUMP_M, self._oval, self._seed)
        return Shot(self._renderers[0].render(view), view, eye, np.eye(3))


def _optical(at: np.ndarray, turn: np.ndarray, camera: Camera) -> Pose:
    view = mount_view((at.tolist(), _quaternion(turn)), intrinsics(camera), camera.position_m, camera.rpy_rad)
    return Pose(view.position_m, view.rotation)


def _quaternion(m: np.ndarray) -> tuple[float, float, float, float]:
    """Compute the quaternion (x, y, z, w) of a rotation matrix (3, 3)."""
    x, y, z, w = Rotation.from_matrix(m).as_quat()
    return (float(x), float(y), float(z), float(w))
