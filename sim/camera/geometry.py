"""Poses of cameras in the world; ``machine.geometry.optics`` has their pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, rpy_matrix
from sim.errors import PlantError


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole camera in the world: position (3,) [m]; the columns of ``rotation`` (3, 3) are the optical axes."""

    intrinsics: Intrinsics
    position_m: np.ndarray
    rotation: np.ndarray

    def to_optical(self, points_m: np.ndarray) -> np.ndarray:
        """Transform world points (N, 3) into the optical frame."""
        optical: np.ndarray = (np.asarray(points_m, float) - self.position_m) @ self.rotation
        return optical

    def to_world(self, points_m: np.ndarray) -> np.ndarray:
        """Transform optical-frame points (N, 3) into the world."""
        world: np.ndarray = np.asarray(points_m, float) @ self.rotation.T + self.position_m
        return world


def quaternion_matrix(q: Sequence[float]) -> np.ndarray:
    """Compute the rotation matrix (3, 3) of a unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def mount_view(
    link_pose: tuple[Sequence[float], Sequence[float]],
    pinhole_px: Intrinsics,
    position_m: Sequence[float],
    rpy_rad: Sequence[float],
    error_m: Sequence[float] = (0.0, 0.0, 0.0),
    error_rpy_rad: Sequence[float] = (0.0, 0.0, 0.0),
) -> View:
    """Compute the view of a camera on a link.

    ``link_pose`` is (position, quaternion) of the link in the world; ``position_m`` and ``rpy_rad`` are the nominal
    body frame in the link, ``error_m`` and ``error_rpy_rad`` the true body frame in the nominal one.
    """
    link, body = quaternion_matrix(link_pose[1]), rpy_matrix(rpy_rad)
    origin = np.asarray(position_m, float) + body @ np.asarray(error_m, float)
    rotation = link @ body @ rpy_matrix(error_rpy_rad) @ BODY_FROM_OPTICAL
    return View(pinhole_px, np.asarray(link_pose[0], float) + link @ origin, rotation)


def look_at(eye_m: Sequence[float], target_m: Sequence[float], pinhole_px: Intrinsics) -> View:
    """Make a free camera at ``eye_m`` that looks at ``target_m`` with the horizon level.

    Raises:
        PlantError: the camera would look straight up or down, where the horizon is undefined.
    """
    eye = np.asarray(eye_m, float)
    forward = np.asarray(target_m, float) - eye
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9 * max(1.0, float(np.linalg.norm(forward))):
        raise PlantError(
            "camera.no-horizon",
            "a camera that looks straight up or down has no level horizon; move its position a little sideways",
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    return View(pinhole_px, eye, np.stack([right, np.cross(forward, right), forward], axis=1))


def orbit(
    target_m: Sequence[float], distance_m: float, azimuth_rad: float, elevation_rad: float, pinhole_px: Intrinsics
) -> View:
    """Make a free camera on a sphere around ``target_m``; azimuth from the world's +x, elevation above the horizon."""
    ce = math.cos(elevation_rad)
    away = (ce * math.cos(azimuth_rad), ce * math.sin(azimuth_rad), math.sin(elevation_rad))
    return look_at([t + distance_m * a for t, a in zip(target_m, away, strict=True)], target_m, pinhole_px)
