"""A picture of the plant as PNG, from outside or through one of its cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image

from machine.geometry.optics import pinhole
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.camera.geometry import orbit
from sim.camera.render import ImagingConditions, render
from sim.camera.rig import CameraRig
from sim.camera.scene import scene_from_world
from sim.plant import Plant

SIZE_PX: Final = (1280, 720)
VIEW_RAD: Final = 0.9
"""Horizontal field of view of the outside camera."""
NEAR_M, FAR_M = 1.0, 12.0
"""Range of the colours of a depth picture."""


@dataclass(frozen=True, slots=True)
class PictureRequest:
    """The scene and the view of it; ``camera`` names a camera of the profile, None is the outside camera."""

    logs: int
    scene: str
    seed: int
    terrain: str
    truth: str
    camera: str | None
    depth: bool
    azimuth_deg: float
    elevation_deg: float
    distance_m: float


def take_picture(profile: Profile, request: PictureRequest, path: Path) -> None:
    """Write the picture to ``path``.

    Raises:
        InputRefused: unknown camera.
        ValueError: the scene cannot be made.
        OSError: the file cannot be written.
    """
    if request.camera is not None and request.camera not in profile.cameras:
        known = ", ".join(profile.cameras) or "none"
        raise InputRefused("plant-camera.unknown", f"{profile.name} has no camera {request.camera!r}; it has: {known}")
    plant = Plant(profile, request.seed, request.truth, request.logs, scene=request.scene, terrain=request.terrain)
    world = plant.world
    try:
        if request.camera is None:
            foot, _ = world.base_pose()
            aim = (foot[0], foot[1] + (1.5 if profile.carrier is None else 0.0), foot[2] + 1.0)  # between foot and boom
            view = orbit(
                aim,
                request.distance_m,
                math.radians(request.azimuth_deg),
                math.radians(request.elevation_deg),
                pinhole(*SIZE_PX, VIEW_RAD),
            )
            picture = render(scene_from_world(world), view, ImagingConditions()).rgb
        else:
            frame = CameraRig(world, profile, world.truth, request.seed, size_px=None).frame(request.camera, 0)
            picture = depth_colors(frame.depth_m) if request.depth else frame.rgb
        Image.fromarray(picture).save(path, "PNG")
    finally:
        plant.close()


def depth_colors(depth_m: np.ndarray) -> np.ndarray:
    """Colour depth (h, w) [m] as an RGB picture: near is yellow, far is violet, unknown is black."""
    from matplotlib import colormaps

    share = np.clip((FAR_M - depth_m) / (FAR_M - NEAR_M), 0.0, 1.0)
    colours = (colormaps["viridis"](np.nan_to_num(share))[..., :3] * 255).astype(np.uint8)
    colours[~np.isfinite(depth_m)] = 0
    return colours
