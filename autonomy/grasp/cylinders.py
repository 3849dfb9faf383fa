"""Logs as perfect cylinders in arrays, and Monte Carlo samples of them from their covariances.

Base frame, m.  The logs are on the last axis of every array, before the coordinates: ``center`` and ``axis``
(..., n, 3), ``length`` and ``radius`` (..., n); leading axes are samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.log_list import (
    ACROSS_1,
    ACROSS_2,
    END,
    RADIUS,
    SIZE,
    START,
    TILT_1,
    TILT_2,
    LogObservation,
    unpack_covariance,
)
from runtime.errors import InputRefused

MIN_RADIUS_M: Final = 0.02
POINT_COUNT: Final = 15
"""Points of an axis at which its distance to other logs is computed."""


@dataclass(frozen=True, slots=True)
class Cylinders:
    """Arrays of logs; see the module for their shapes."""

    center: np.ndarray
    axis: np.ndarray
    length: np.ndarray
    radius: np.ndarray

    @property
    def count(self) -> int:
        """The number of logs."""
        return int(self.length.shape[-1])

    def ends(self) -> np.ndarray:
        """Compute both ends of every axis (..., n, 2, 3): paper A, eq. (1)."""
        half = (self.axis * self.length[..., None] / 2)[..., None, :]
        ends: np.ndarray = self.center[..., None, :] + np.concatenate([-half, half], axis=-2)
        return ends

    def points(self) -> np.ndarray:
        """Compute points of every axis from end to end (..., n, POINT_COUNT, 3)."""
        part = self.length[..., None] * np.linspace(-0.5, 0.5, POINT_COUNT)
        points: np.ndarray = self.center[..., None, :] + part[..., None] * self.axis[..., None, :]
        return points

    def shortened(self, by_m: float, share: float) -> Cylinders:
        """Shorten every log by ``by_m`` and then by a ``share`` of the rest, never below its thickness."""
        length = np.maximum((self.length - by_m) * (1.0 - share), 2.0 * self.radius)
        return Cylinders(self.center, self.axis, np.minimum(length, self.length), self.radius)


def as_cylinders(logs: Sequence[LogObservation]) -> Cylinders:
    """Convert the logs of a list, without samples."""
    return Cylinders(
        np.array([log.center_m for log in logs], float).reshape(-1, 3),
        np.array([log.axis for log in logs], float).reshape(-1, 3),
        np.array([log.length_m for log in logs], float),
        np.array([log.diameter_m for log in logs], float) / 2.0,
    )


def lowest_m(world: Cylinders) -> float:
    """Compute the height of the lowest point of any log."""
    thick = world.radius * np.sqrt(np.maximum(1.0 - world.axis[..., 2] ** 2, 0.0))
    return float(np.min(np.min(world.ends()[..., 2], axis=-1) - thick))


def axis_offsets(world: Cylinders) -> np.ndarray:
    """Compute vectors from the nearest axis point of log i (first) to axis points of log j (n, n, POINT_COUNT, 3)."""
    away = world.points()[None] - world.center[:, None, None]
    half = world.length[:, None, None] / 2
    along = np.clip(np.einsum("ijkc,ic->ijk", away, world.axis), -half, half)
    off: np.ndarray = away - along[..., None] * world.axis[:, None, None]
    return off


def log_covariance(log: LogObservation) -> np.ndarray:
    """Return the covariance (7, 7) of ``LogEstimate``, or the default for a log that comes without one."""
    return default_covariance(log) if log.covariance is None else unpack_covariance(log.covariance)


def default_covariance(log: LogObservation) -> np.ndarray:
    """Return the covariance (7, 7) of a well-known pose: 1.5 cm across, 1 deg, 5 cm at the ends."""
    sigma = np.zeros(SIZE)
    sigma[[ACROSS_1, ACROSS_2]], sigma[[TILT_1, TILT_2]] = 0.015, 0.017
    sigma[[START, END]], sigma[RADIUS] = 0.05, 0.05 * log.diameter_m
    return np.diag(sigma**2)


def sample_cylinders(world: Cylinders, covariances: np.ndarray, count: int, seed: int) -> Cylinders:
    """Draw ``count`` samples of the logs (n) from covariances (n, 7, 7); the same seed gives the same samples.

    Raises:
        InputRefused: a covariance is not finite.
    """
    if not np.all(np.isfinite(covariances)):
        raise InputRefused(
            "grasp.covariance-not-finite", "the covariance of a log has an entry that is not finite; leave that log out"
        )
    value, vector = np.linalg.eigh(covariances)
    root = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
    normal = np.random.default_rng(seed).standard_normal((count, world.count, SIZE))
    return perturbed(world, np.einsum("nij,dnj->dni", root, normal))


def transverse_axes(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit vectors (n, 3) across unit axes (n, 3), the axes of the error states: first level, second up."""
    level = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    steep = np.hypot(level[:, 0], level[:, 1]) < 0.05
    level[steep] = (0.0, 1.0, 0.0)
    level /= np.linalg.norm(level, axis=1)[:, None]
    return level, np.cross(axis, level)


def perturbed(world: Cylinders, e: np.ndarray) -> Cylinders:
    """Add errors (..., n, 7) to the logs (n), in the order of ``LogEstimate``'s covariance."""
    level, up = transverse_axes(world.axis)
    axis = world.axis + e[..., TILT_1, None] * level + e[..., TILT_2, None] * up
    axis /= np.linalg.norm(axis, axis=-1)[..., None]
    along = 0.5 * (e[..., START] + e[..., END])
    center = world.center + e[..., ACROSS_1, None] * level + e[..., ACROSS_2, None] * up + along[..., None] * axis
    radius = np.maximum(world.radius + e[..., RADIUS], MIN_RADIUS_M)
    length = np.maximum(world.length + e[..., END] - e[..., START], 2.0 * radius)
    return Cylinders(center, axis, length, radius)
