"""A camera's mount and scale of depth as a survey before the work finds them: targets on level ground around it.

The plant hides how a camera is really mounted; a machine that goes to work has had it measured once.  The carrier
stands level, the targets are set up in front of the camera and each is looked at for two seconds.
"""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import Any, Final

import msgspec
import numpy as np

from autonomy.perception.camera_survey import surveyed
from autonomy.perception.frame import Pose
from autonomy.perception.log_filter import Errors
from machine.optics import intrinsics
from machine.profile import Camera, Profile
from sim.camera.geometry import mount_view
from sim.camera.noise import StereoNoise
from sim.shape import UNIT

TARGETS: Final = 14
SIGMA_M, SIGMA_PX, FRAMES = 0.002, 0.3, 30
"""Of a target's surveyed place, of where it is seen in a picture; pictures of each."""
MARGIN_PX: Final = 60
RANGE_M: Final = (3.0, 8.0)
SURVEYED: Final = Errors(scale=0.0015, mount_rad=0.0015, mount_m=0.004)
"""What is left to err of a camera on the crane; ..."""
SURVEYED_BY_GNSS: Final = replace(SURVEYED, pose_rad=0.002, pose_m=0.012)
"""... and on a vehicle that a dual-antenna RTK receiver locates."""


def surveyed_profile(profile: Profile, truth: Any, name: str, seed: int) -> Profile:
    """The profile with what a survey before run ``seed`` finds of camera ``name`` of a plant (``truth``:
    ``plant.world.truth``).
    """
    camera, hidden = profile.cameras[name], truth.cameras[name]
    scale = StereoNoise(camera, hidden, f"{name} {seed}").scale  # as the rig's own camera has it
    found = survey(camera, hidden, scale, random.Random(f"survey {seed}"))
    return msgspec.structs.replace(profile, cameras={**profile.cameras, name: found})


def survey(camera: Camera, truth: Any, depth_scale: float, rng: random.Random) -> Camera:
    """What the survey says of a camera whose true mount errors and noise are ``truth`` (``plant.world.truth.cameras``)
    and whose depth is ``depth_scale`` of the true one.
    """
    pin, fb = intrinsics(camera), camera.fx_px * camera.baseline_m
    errors = (truth.mount_position_m, truth.mount_rpy_rad)
    view = mount_view((np.zeros(3), UNIT), pin, camera.position_m, camera.rpy_rad, *errors)
    pixels, depths, targets = [], [], []
    for _ in range(TARGETS):
        u = rng.uniform(MARGIN_PX, pin.width_px - MARGIN_PX)
        v, z = rng.uniform(MARGIN_PX, pin.height_px - MARGIN_PX), rng.uniform(*RANGE_M)
        at = view.to_world(pin.deproject(u, v, z)[None])[0]
        targets.append(at + [rng.gauss(0.0, SIGMA_M) for _ in range(3)])
        pixels.append((u + rng.gauss(0.0, SIGMA_PX), v + rng.gauss(0.0, SIGMA_PX)))
        noise = rng.gauss(0.0, truth.disparity_sigma_px / math.sqrt(FRAMES))
        depths.append(depth_scale * fb / (fb / z + noise))
    return surveyed(camera, Pose(np.zeros(3), np.eye(3)), np.array(pixels), np.array(depths), np.array(targets))
