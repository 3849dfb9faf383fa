"""Pictures of logs from the analytic renderer with stereo noise, for tests of perception."""

import math
from contextlib import closing
from dataclasses import dataclass
from functools import cache

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame
from machine.geometry.optics import intrinsics
from machine.loading.profile_file import load_profile
from sim.camera.geometry import View, look_at
from sim.camera.noise import StereoNoise
from sim.camera.render import ImagingConditions, Picture, render
from sim.camera.scene import Ground, LogPose, Scene, SceneBuilder
from sim.world import open_world

PROFILE = load_profile("aoro_fc8")
CAMERA = PROFILE.cameras["front"]
PIN = intrinsics(CAMERA)


@dataclass(frozen=True, slots=True)
class TrueMask:
    """A mask that the renderer knows."""

    mask: np.ndarray


@cache
def camera_truth():
    with closing(open_world(PROFILE, truth="nominal", seed=0, scene=())) as world:
        return world.truth.cameras["front"]


def lying(number: int, x: float, y: float, yaw_deg: float, length: float = 2.0, diameter: float = 0.25, z: float = 0.0):
    """A level log on the ground; 0 degrees lies along the view."""
    yaw, r = math.radians(yaw_deg), math.sqrt(0.5)
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    return LogPose(number, (x, y, z + diameter / 2), (-s * r, c * r, s * r, c * r), length, diameter)


def scene_of(*logs: LogPose) -> Scene:
    b = SceneBuilder(Ground.flat(), "forest")
    for log in logs:
        b.log(log)
    return b.build()


def view_from() -> View:
    """2.4 m above the ground, looking down as on the machine."""
    return look_at((0.0, 0.0, 2.4), (4.4, 0.0, 0.0), PIN)


def seen(scene: Scene, view: View) -> Picture:
    return render(scene, view, ImagingConditions())


def frame_of(picture: Picture, view: View, number: int = 0, exact: bool = False) -> RgbdFrame:
    """A frame with stereo noise but without scale error, or with exact depth."""
    depth_m = picture.depth_m
    if not exact:
        noise = StereoNoise(CAMERA, camera_truth(), 1)
        depth_m = noise.apply(picture, view.intrinsics, number) / np.float32(noise.scale)
    return RgbdFrame("front", 66_000_000 * (number + 1), picture.rgb, depth_m, view.intrinsics)


def masks_of(picture: Picture) -> list[TrueMask]:
    return [TrueMask(picture.mask == i) for i in np.unique(picture.mask) if 0 < i < 1000]
