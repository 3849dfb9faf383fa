"""A camera's mount and scale of depth by targets whose places were surveyed and that it sees."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from msgspec.structs import replace
from scipy.optimize import least_squares

from autonomy.perception.camera.frame import Pose
from autonomy.perception.camera.mount import CameraMountError
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, intrinsics, rpy_matrix
from machine.loading.ranges import DEPTH_SCALE
from machine.profile import Camera

LEAST_TARGETS: Final = 6
MOUNT_SPREAD: Final = (0.03, 0.03, 0.03, 0.035, 0.035, 0.035)
"""How far off a mount is that nobody has surveyed [m, rad] (docs/reference/machines.md section 8)."""


def surveyed(
    camera: Camera,
    link: Pose,
    pixels_px: np.ndarray,
    depths_m: np.ndarray,
    targets_m: np.ndarray,
    pixel_sigma_px: float = 0.3,
) -> Camera:
    """The camera with the mount and the scale of depth that ``LEAST_TARGETS`` or more surveyed targets show.

    ``pixels_px`` (N, 2) is where the camera sees the targets ``targets_m`` (N, 3), ``depths_m`` (N,) their depth, NaN
    where it has none; ``link`` is the pose of its link (not of its optics) in the frame of the targets.  The profile's
    mount is the prior.

    Raises:
        MountRefused: too few targets, or ones that it cannot see where the survey says they are.
    """
    if len(targets_m) < LEAST_TARGETS:
        raise CameraMountError(f"{len(targets_m)} targets do not fix a mount; survey at least {LEAST_TARGETS}")
    pin = intrinsics(camera)
    nominal_m, nominal = np.asarray(camera.position_m, float), rpy_matrix(camera.rpy_rad)
    local = link.to_optical(targets_m)  # in the link's frame

    def body(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return nominal_m + nominal @ x[:3], nominal @ rpy_matrix(x[3:])

    def optical(x: np.ndarray) -> np.ndarray:
        at, turn = body(x)
        return (local - at) @ (turn @ BODY_FROM_OPTICAL)

    def misses(x: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [((_seen(pin, optical(x)) - pixels_px) / pixel_sigma_px).ravel(), x / np.array(MOUNT_SPREAD)]
        )

    found = least_squares(misses, np.zeros(6), x_scale=MOUNT_SPREAD)
    rest = found.fun[: 2 * len(targets_m)]
    off_px = math.sqrt(float(np.mean(rest * rest))) * pixel_sigma_px
    if not off_px < 5.0 * pixel_sigma_px:
        raise CameraMountError(
            f"the targets are {off_px:.1f} px from where any mount near the profile's puts them; "
            "check which target is which, and their places"
        )
    at, turn = body(found.x)
    pitch = math.asin(max(-1.0, min(1.0, -turn[2, 0])))
    rpy = (math.atan2(turn[2, 1], turn[2, 2]), pitch, math.atan2(turn[1, 0], turn[0, 0]))
    scale = _scale(optical(found.x)[:, 2], depths_m)
    return replace(camera, position_m=tuple(float(v) for v in at), rpy_rad=rpy, depth_scale=scale)


def _scale(true_m: np.ndarray, depths_m: np.ndarray) -> float:
    """Measured over true depths (N,); 1 where none is known."""
    known = np.isfinite(depths_m)
    if not known.any():
        return 1.0
    # The error of depth grows with its square: of the ratio it grows with depth.
    weights = 1.0 / true_m[known] ** 2
    scale = float(np.sum(weights * depths_m[known] / true_m[known]) / np.sum(weights))
    low, high, _ = DEPTH_SCALE
    if not low < scale < high:
        raise CameraMountError(
            f"depth is {scale:.2f} of what the survey says; the camera's baseline or focal length is wrong"
        )
    return scale


def _seen(pin: Intrinsics, optical: np.ndarray) -> np.ndarray:
    ahead = np.where(optical[:, 2:] > 0.05, optical[:, 2:], 0.05)
    return pin.project(np.concatenate([optical[:, :2], ahead], axis=1))
