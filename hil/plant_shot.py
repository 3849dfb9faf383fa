"""A still picture of the plant, from outside or through one of its cameras, as a PNG."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image

from machine.optics import pinhole
from machine.profile import Profile
from sim.camera.geometry import orbit
from sim.camera.render import Look, render
from sim.camera.rig import CameraRig
from sim.camera.scene import scene_from_world
from sim.plant import Plant

SIZE_PX: Final = (1280, 720)
VIEW_RAD: Final = 0.9  # horizontal angle of the outside camera
NEAR_M, FAR_M = 1.0, 12.0  # colours of a depth picture


@dataclass(frozen=True, slots=True)
class Shot:
    """What stands there and from where it is seen; ``camera`` names one of the profile's, None looks from outside."""

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


def take(profile: Profile, shot: Shot, path: Path) -> None:
    """Write the picture.

    Raises:
        ValueError: an unknown camera, or a scene that cannot be made.
        OSError: the file cannot be written.
    """
    if shot.camera is not None and shot.camera not in profile.cameras:
        known = ", ".join(profile.cameras) or "none"
        raise ValueError(f"{profile.name} has no camera '{shot.camera}'; its cameras: {known}")
    plant = Plant(profile, shot.seed, shot.truth, shot.logs, scene=shot.scene, terrain=shot.terrain)
    world = plant.world
    try:
        if shot.camera is None:
            foot, _ = world.base_pose()
            aim = (foot[0], foot[1] + (1.5 if profile.carrier is None else 0.0), foot[2] + 1.0)  # between foot and boom
            view = orbit(
                aim, shot.distance_m, math.radians(shot.azimuth_deg), math.radians(shot.elevation_deg),
                pinhole(*SIZE_PX, VIEW_RAD),
            )  # fmt: skip
            picture = render(scene_from_world(world), view, Look()).rgb
        else:
            frame = CameraRig(world, profile, world.truth, shot.seed, size_px=None).frame(shot.camera, 0)
            picture = depth_colours(frame.depth_m) if shot.depth else frame.rgb
        Image.fromarray(picture).save(path, "PNG")
    finally:
        plant.close()


def depth_colours(depth_m: np.ndarray) -> np.ndarray:
    """Depth [m] as an RGB picture: near is yellow, far is violet, unknown is black."""
    from matplotlib import colormaps

    share = np.clip((FAR_M - depth_m) / (FAR_M - NEAR_M), 0.0, 1.0)
    colours = (colormaps["viridis"](np.nan_to_num(share))[..., :3] * 255).astype(np.uint8)
    colours[~np.isfinite(depth_m)] = 0
    return colours
