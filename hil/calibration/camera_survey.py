"""An emulated survey of a camera's mount and depth scale before the work, from targets on level ground.

The plant hides the true mount of a camera; on a real machine it is surveyed once.  The carrier stands level, the
targets stand in front of the camera, and each is measured for two seconds.
"""

from __future__ import annotations

import math
import random
from typing import Any, Final

import msgspec
import numpy as np

from autonomy.perception.camera.frame import Pose
from autonomy.perception.camera.survey import surveyed
from machine.geometry.optics import intrinsics
from machine.profile import Camera, Profile
from sim.camera.geometry import mount_view
from sim.camera.noise import StereoNoise
from sim.geometry.shape import IDENTITY

TARGET_COUNT: Final = 14
SIGMA_M, SIGMA_PX, FRAMES = 0.002, 0.3, 30
"""Errors of a target's surveyed position and of its pixel; pictures of each target."""
MARGIN_PX: Final = 60
RANGE_M: Final = (3.0, 8.0)


def surveyed_profile(profile: Profile, truth: Any, name: str, seed: int) -> Profile:
    """The profile with camera ``name`` as a survey before run ``seed`` finds it; ``truth`` is ``plant.world.truth``."""
    camera, hidden = profile.cameras[name], truth.cameras[name]
    scale = StereoNoise(camera, hidden, f"{name} {seed}").scale  # the same as that of the camera rig
    found = survey(camera, hidden, scale, random.Random(f"survey {seed}"))
    return msgspec.structs.replace(profile, cameras={**profile.cameras, name: found})


def survey(camera: Camera, truth: Any, depth_scale: float, rng: random.Random) -> Camera:
    """The camera with surveyed mount and depth scale.

    ``truth`` (``plant.world.truth.cameras``) holds the true mount errors and noise; the camera measures ``depth_scale``
    times the true depth.
    """
    pin, fb = intrinsics(camera), camera.fx_px * camera.baseline_m
    errors = (truth.mount_position_m, truth.mount_rpy_rad)
    view = mount_view(((0.0, 0.0, 0.0), IDENTITY), pin, camera.position_m, camera.rpy_rad, *errors)
    pixels, depths, targets = [], [], []
    for _ in range(TARGET_COUNT):
        u = rng.uniform(MARGIN_PX, pin.width_px - MARGIN_PX)
        v, z = rng.uniform(MARGIN_PX, pin.height_px - MARGIN_PX), rng.uniform(*RANGE_M)
        at = view.to_world(pin.deproject(u, v, z)[None])[0]
        targets.append(at + [rng.gauss(0.0, SIGMA_M) for _ in range(3)])
        pixels.append((u + rng.gauss(0.0, SIGMA_PX), v + rng.gauss(0.0, SIGMA_PX)))
        noise = rng.gauss(0.0, truth.disparity_sigma_px / math.sqrt(FRAMES))
        depths.append(depth_scale * fb / (fb / z + noise))
    return surveyed(camera, Pose(np.zeros(3), np.eye(3)), np.array(pixels), np.array(depths), np.array(targets))
