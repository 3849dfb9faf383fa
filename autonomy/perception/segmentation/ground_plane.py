"""The plane that most of a picture's depth lies on, and the height of every pixel over it.

Inverse depth of a plane is linear in the picture and its noise is alike everywhere, so a plane n x = 1 is found from
rays r (z = 1) and depths z by n r = 1 / z.  The height of a point over it is (1 - z n r) / |n|.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from machine.geometry.optics import Intrinsics

GRID: Final = 44  # points are taken on a grid about so wide
GUESSES: Final = 64
LEAST_POINTS: Final = 30
NEAR_M, FAR_PER_M, MOST_M = 0.06, 0.0015, 0.2
"""A point belongs to the plane when its height is below NEAR_M + FAR_PER_M z^2, at most MOST_M."""
BELOW_COSTS: Final = 1.0  # of a point clearly below: the ground is wanted, not what lies on it


def height_over_plane(depth_m: np.ndarray, pinhole: Intrinsics) -> np.ndarray:
    """Height (H, W) float32 [m] towards the camera over the prevailing plane; NaN where depth (H, W) is unknown."""
    h, w = depth_m.shape
    u = ((np.arange(w) - pinhole.cx_px) / pinhole.fx_px).astype(np.float32)
    v = ((np.arange(h) - pinhole.cy_px) / pinhole.fy_px).astype(np.float32)
    a, b, c = prevailing_plane(depth_m, u, v)
    size = float(np.sqrt(a * a + b * b + c * c))
    slope = (b * v + c)[:, None] + a * u
    slope *= depth_m
    return (1.0 - slope) * np.float32(1.0 / size)


def prevailing_plane(depth_m: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Normal (3,) of the plane n x = 1 [1/m]; ``u`` (W,), ``v`` (H,) are the rays at z = 1.

    The same depth gives the same plane.  With too little depth it is the plane across the view at the median depth (1 m
    when there is none).
    """
    step = max(1, max(depth_m.shape) // GRID)
    z = depth_m[step // 2 :: step, step // 2 :: step]
    rays = np.stack(np.broadcast_arrays(u[step // 2 :: step], v[step // 2 :: step, None], np.float32(1.0)), axis=-1)
    known = np.isfinite(z)
    z, rays = z[known].astype(float), rays[known].astype(float)
    if len(z) < LEAST_POINTS:
        return np.array([0.0, 0.0, 1.0 / (float(np.median(z)) if len(z) else 1.0)])
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(z), (GUESSES, 3))
    corners, inverse = rays[pick], 1.0 / z[pick]
    good = np.abs(np.linalg.det(corners)) > 1e-4
    across = np.array([0.0, 0.0, 1.0 / np.median(z)])
    guesses = np.vstack([across, np.linalg.solve(corners[good], inverse[good][..., None])[..., 0]])
    scaled, band = rays * z[:, None], np.minimum(NEAR_M + FAR_PER_M * z * z, MOST_M)
    heights = (1.0 - guesses @ scaled.T) / np.linalg.norm(guesses, axis=1)[:, None]
    votes = np.count_nonzero(np.abs(heights) < band, axis=1)
    votes = votes - BELOW_COSTS * np.count_nonzero(heights < -2.0 * band, axis=1)
    normal = guesses[int(np.argmax(votes))]
    for narrower in (1.0, 0.6, 0.4):
        height = (1.0 - scaled @ normal) / np.linalg.norm(normal)
        own = np.abs(height) < narrower * band
        if np.count_nonzero(own) < LEAST_POINTS // 2:
            break
        weighted = scaled[own] / band[own, None]
        normal = np.linalg.lstsq(weighted, 1.0 / band[own], rcond=None)[0]
    return normal
