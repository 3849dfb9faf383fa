"""Settled pose estimates: log poses corrected so that logs lie on the ground or on each other, and never inside.

A camera sees only a strip of a log that others hide; it measures height and width badly, which the covariance says.
Gravity and contact add what is missing, as measurements of a Kalman filter: a log that may lie on the ground lies on
it with both ends, and two logs that overlap touch.  Each log moves in proportion to its own uncertainty.  An error
common to all logs, from the camera's mount or depth scale, is removed from the logs on others, too.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders, axis_offsets, perturbed, transverse_axes
from autonomy.perception.log_list import ACROSS_1, ACROSS_2, RADIUS, SIZE, TILT_1, TILT_2

GROUND_SIGMA_M: Final = 0.015
"""Standard deviation of the ground's height under a log's end, including bow and taper."""
MAX_MAHALANOBIS_SQ: Final = 9.0
"""Squared Mahalanobis distance, two degrees of freedom, up to which a log may lie on the ground: 99 %."""
MAX_HEIGHT_ON_GROUND_M: Final = 0.12
"""A log whose middle is seen higher above the ground than this lies on something."""
CONTACT_OVERLAP_M: Final = 0.015
"""Logs in contact overlap this much as cylinders."""
MAX_OVERLAP_M: Final = 0.04
"""A log that would overlap another by more if it lay on the ground does not lie there."""
OWN_HEIGHT_SHARE: Final = 0.4
"""Share of the height's standard deviation of a log on others that is its own and not the camera's."""
ROUND_COUNT: Final = 3


def settled_poses(world: Cylinders, covariances: np.ndarray, ground_z_m: float) -> tuple[Cylinders, np.ndarray]:
    """Correct the logs (n) and their covariances (n, 7, 7), on level ground at ``ground_z_m``."""
    sigma, before = covariances.copy(), surface_gaps(world)
    common = float(np.min(sigma[:, ACROSS_2, ACROSS_2], initial=np.inf))  # the camera's own share of the variance
    lying, off, sure = np.zeros(world.count, bool), np.zeros(world.count), np.zeros(world.count)
    for i in np.argsort(sigma[:, ACROSS_2, ACROSS_2], kind="stable").tolist():
        height, slope = _undersides(world, i, ground_z_m)
        off[i] = height.mean()
        spread = slope @ sigma[i] @ slope.T + GROUND_SIGMA_M**2 * np.eye(2)
        if off[i] > MAX_HEIGHT_ON_GROUND_M or (
            off[i] > 0.0 and height @ np.linalg.solve(spread, height) > MAX_MAHALANOBIS_SQ
        ):
            continue
        laid = _updated_pose(world, sigma, i, height, slope, GROUND_SIGMA_M)
        if off[i] > 0.0 and np.any(surface_gaps(laid)[i] < np.minimum(before[i], 0.0) - MAX_OVERLAP_M):
            continue
        world, lying[i] = laid, True
        sure[i] = 1.0 / max(float(spread.mean()) - common, GROUND_SIGMA_M**2)
        sigma[i] = _updated_covariance(sigma[i], slope, GROUND_SIGMA_M)
    if lying.any():
        shift = np.where(lying, 0.0, sure @ off / (1.0 / common + sure.sum()))
        center = world.center - shift[:, None] * (0.0, 0.0, 1.0)
        world = Cylinders(center, world.axis, world.length, world.radius)
        scale = np.ones((world.count, SIZE))
        scale[~lying, ACROSS_2] = OWN_HEIGHT_SHARE
        sigma *= scale[:, :, None] * scale[:, None, :]
    for _ in range(ROUND_COUNT):
        pairs = np.argwhere(np.triu(surface_gaps(world) < -CONTACT_OVERLAP_M)).tolist()
        if not pairs:
            break
        for i, j in pairs:
            world = _separated(world, sigma, i, j)
        for i in np.flatnonzero(lying).tolist():
            world = _updated_pose(world, sigma, i, *_undersides(world, i, ground_z_m), GROUND_SIGMA_M)
    return world, sigma


def surface_gaps(world: Cylinders) -> np.ndarray:
    """Compute the least distance between the surfaces of every two logs (n, n) [m], by points along one axis; negative
    where they overlap, infinite between a log and itself."""
    off = np.linalg.norm(axis_offsets(world), axis=-1).min(axis=-1)
    gap: np.ndarray = np.minimum(off, off.T) - world.radius[:, None] - world.radius[None, :]
    np.fill_diagonal(gap, np.inf)
    return gap


def _undersides(world: Cylinders, i: int, ground_z_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute heights (2,) of the undersides of both ends of log ``i`` over the ground, and their Jacobian (2, 7)."""
    half = 0.5 * float(world.length[i])
    level = float(np.sqrt(max(1.0 - world.axis[i, 2] ** 2, 0.0)))
    middle = world.center[i, 2] - world.radius[i] * level - ground_z_m
    slope = np.zeros((2, SIZE))
    slope[:, ACROSS_2], slope[:, RADIUS] = level, -level
    slope[:, TILT_2] = -half * level, half * level
    rise = half * world.axis[i, 2]
    return np.array([middle - rise, middle + rise]), slope


def _updated_covariance(covariance: np.ndarray, slope: np.ndarray, noise_m: float) -> np.ndarray:
    """Update a covariance (7, 7) by a measurement with Jacobian (k, 7)."""
    spread = slope @ covariance @ slope.T + noise_m**2 * np.eye(len(slope))
    known = covariance - covariance @ slope.T @ np.linalg.solve(spread, slope @ covariance)
    symmetric: np.ndarray = 0.5 * (known + known.T)
    return symmetric


def _updated_pose(
    world: Cylinders, sigma: np.ndarray, i: int, over_m: np.ndarray, slope: np.ndarray, noise_m: float
) -> Cylinders:
    """Move log ``i`` to reduce the residual ``over_m`` (k,), weighted by its covariance."""
    spread = slope @ sigma[i] @ slope.T + noise_m**2 * np.eye(len(slope))
    error = np.zeros((world.count, SIZE))
    error[i] = -sigma[i] @ slope.T @ np.linalg.solve(spread, over_m)
    return perturbed(world, error)


def _separated(world: Cylinders, sigma: np.ndarray, i: int, j: int) -> Cylinders:
    """Move logs ``i`` and ``j`` apart until they touch, each in proportion to its variance."""
    level, up = transverse_axes(world.axis)
    points, away = world.points()[j], axis_offsets(world)[i, j]
    distance = np.linalg.norm(away, axis=1)
    k = int(np.argmin(distance))
    reach = float(distance[k] - world.radius[i] - world.radius[j]) + CONTACT_OVERLAP_M
    if reach >= 0.0:
        return world
    direction = away[k] / max(float(distance[k]), 1e-6)
    error, slopes = np.zeros((world.count, SIZE)), []
    for log, sense, point in ((i, -1.0, points[k] - away[k]), (j, 1.0, points[k])):
        at = (point - world.center[log]) @ world.axis[log]
        slope = np.zeros(SIZE)
        slope[[ACROSS_1, ACROSS_2]] = sense * (direction @ level[log]), sense * (direction @ up[log])
        slope[[TILT_1, TILT_2]] = at * slope[[ACROSS_1, ACROSS_2]]
        slope[RADIUS] = -1.0
        slopes.append((log, slope))
    spread = sum(float(slope @ sigma[log] @ slope) for log, slope in slopes) + 1e-6
    for log, slope in slopes:
        error[log] = -sigma[log] @ slope * (reach / spread)
    return perturbed(world, error)
