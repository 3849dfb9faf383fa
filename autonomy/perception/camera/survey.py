"""Estimation of a camera's mount and depth scale from surveyed targets that the camera sees."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from msgspec.structs import replace
from scipy.optimize import least_squares

from autonomy.perception.camera.frame import Pose
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, intrinsics, rpy_matrix
from machine.loading.ranges import DEPTH_SCALE_RANGE
from machine.profile import Camera
from runtime.errors import InputRefused

MIN_TARGETS: Final = 6
MOUNT_PRIOR_SIGMA: Final = (0.03, 0.03, 0.03, 0.035, 0.035, 0.035)
"""Standard deviations of a mount that was not surveyed: x, y, z [m] and roll, pitch, yaw [rad].

Source: docs/reference/machines.md section 8.
"""
MAX_RESIDUAL_SIGMAS: Final = 5.0
"""Largest root mean square residual of the pixels, in their standard deviation."""
MIN_DEPTH_M: Final = 0.05


def surveyed(
    camera: Camera,
    link: Pose,
    pixels_px: np.ndarray,
    depths_m: np.ndarray,
    targets_m: np.ndarray,
    pixel_sigma_px: float = 0.3,
) -> Camera:
    """Return the camera with the mount and the depth scale that fit ``MIN_TARGETS`` or more surveyed targets.

    Args:
        camera: as the profile has it; its mount is the prior.
        link: pose of the camera's link (not of its optical frame) in the frame of the targets.
        pixels_px: (N, 2), where the camera sees the targets.
        depths_m: (N,), depth of the targets, NaN where it is unknown.
        targets_m: (N, 3), surveyed positions of the targets.
        pixel_sigma_px: standard deviation of ``pixels_px``.

    Raises:
        InputRefused: too few targets, or no mount near the profile's explains the pixels or depths.
    """
    if len(targets_m) < MIN_TARGETS:
        raise InputRefused(
            "camera-mount.too-few-targets",
            f"{len(targets_m)} targets do not determine a mount; survey at least {MIN_TARGETS}",
        )
    pin = intrinsics(camera)
    nominal_m, nominal = np.asarray(camera.position_m, float), rpy_matrix(camera.rpy_rad)
    local = link.to_optical(targets_m)  # in the link's frame

    def body(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return nominal_m + nominal @ x[:3], nominal @ rpy_matrix((x[3], x[4], x[5]))

    def optical(x: np.ndarray) -> np.ndarray:
        at, turn = body(x)
        return np.asarray((local - at) @ (turn @ BODY_FROM_OPTICAL))

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [((_projected(pin, optical(x)) - pixels_px) / pixel_sigma_px).ravel(), x / np.array(MOUNT_PRIOR_SIGMA)]
        )

    solution = least_squares(residuals, np.zeros(6), x_scale=MOUNT_PRIOR_SIGMA)
    rest = solution.fun[: 2 * len(targets_m)]
    off_px = math.sqrt(float(np.mean(rest * rest))) * pixel_sigma_px
    if not off_px < MAX_RESIDUAL_SIGMAS * pixel_sigma_px:
        raise InputRefused(
            "camera-mount.bad-targets",
            f"the targets are {off_px:.1f} px from where any mount near the profile's puts them; "
            "check the order of the targets and their surveyed positions",
        )
    at, turn = body(solution.x)
    pitch = math.asin(max(-1.0, min(1.0, -turn[2, 0])))
    rpy = (math.atan2(turn[2, 1], turn[2, 2]), pitch, math.atan2(turn[1, 0], turn[0, 0]))
    scale = _depth_scale(optical(solution.x)[:, 2], depths_m)
    return replace(camera, position_m=tuple(float(v) for v in at), rpy_rad=rpy, depth_scale=scale)


def _depth_scale(true_m: np.ndarray, depths_m: np.ndarray) -> float:
    """Compute the ratio of measured to true depths (N,); 1 where no depth is known."""
    known = np.isfinite(depths_m)
    if not known.any():
        return 1.0
    # The error of depth grows with its square, so the error of the ratio grows with depth.
    weights = 1.0 / true_m[known] ** 2
    scale = float(np.sum(weights * depths_m[known] / true_m[known]) / np.sum(weights))
    low, high, _ = DEPTH_SCALE_RANGE
    if not low < scale < high:
        raise InputRefused(
            "camera-mount.bad-depth-scale",
            f"measured depth is {scale:.2f} times the surveyed depth; correct the camera's baseline or focal length",
        )
    return scale


def _projected(pin: Intrinsics, optical: np.ndarray) -> np.ndarray:
    ahead = np.where(optical[:, 2:] > MIN_DEPTH_M, optical[:, 2:], MIN_DEPTH_M)
    return pin.project(np.concatenate([optical[:, :2], ahead], axis=1))
