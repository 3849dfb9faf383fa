"""The dominant plane of a picture's depth, and the height of every pixel over it.

Inverse depth of a plane is linear in the picture and its noise is uniform, so a plane n x = 1 is estimated from rays r
(z = 1) and depths z by n r = 1 / z.  The height of a point over it is (1 - z n r) / |n|.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from machine.geometry.optics import Intrinsics

GRID_POINTS: Final = 44  # approximate number of samples along the longer side
CANDIDATE_COUNT: Final = 64
MIN_POINTS: Final = 30
BAND_M, BAND_PER_M, MAX_BAND_M = 0.06, 0.0015, 0.2
"""A point is an inlier when its height is below BAND_M + BAND_PER_M z^2, at most MAX_BAND_M."""
BELOW_PENALTY: Final = 1.0  # for a point clearly below the plane, so that the ground is preferred to objects on it


def height_over_plane(depth_m: np.ndarray, pinhole: Intrinsics) -> np.ndarray:
    """Compute height (H, W) float32 [m] over the dominant plane, positive towards the camera; NaN without depth."""
    h, w = depth_m.shape
    u = ((np.arange(w) - pinhole.cx_px) / pinhole.fx_px).astype(np.float32)
    v = ((np.arange(h) - pinhole.cy_px) / pinhole.fy_px).astype(np.float32)
    a, b, c = dominant_plane(depth_m, u, v)
    size = float(np.sqrt(a * a + b * b + c * c))
    slope = (b * v + c)[:, None] + a * u
    slope *= depth_m
    return np.asarray((1.0 - slope) * np.float32(1.0 / size))


def dominant_plane(depth_m: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Estimate the normal (3,) of the plane n x = 1 [1/m]; ``u`` (W,), ``v`` (H,) are the rays at z = 1.

    Deterministic.  With too little depth it is the plane across the view at the median depth (1 m when there is none).
    """
    step = max(1, max(depth_m.shape) // GRID_POINTS)
    z = depth_m[step // 2 :: step, step // 2 :: step]
    rays = np.stack(np.broadcast_arrays(u[step // 2 :: step], v[step // 2 :: step, None], np.float32(1.0)), axis=-1)
    known = np.isfinite(z)
    z, rays = z[known].astype(float), rays[known].astype(float)
    if len(z) < MIN_POINTS:
        return np.array([0.0, 0.0, 1.0 / (float(np.median(z)) if len(z) else 1.0)])
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(z), (CANDIDATE_COUNT, 3))
    corners, inverse = rays[pick], 1.0 / z[pick]
    good = np.abs(np.linalg.det(corners)) > 1e-4
    across = np.array([0.0, 0.0, 1.0 / np.median(z)])
    candidates = np.vstack([across, np.linalg.solve(corners[good], inverse[good][..., None])[..., 0]])
    scaled, band = rays * z[:, None], np.minimum(BAND_M + BAND_PER_M * z * z, MAX_BAND_M)
    heights = (1.0 - candidates @ scaled.T) / np.linalg.norm(candidates, axis=1)[:, None]
    votes = np.count_nonzero(np.abs(heights) < band, axis=1)
    votes = votes - BELOW_PENALTY * np.count_nonzero(heights < -2.0 * band, axis=1)
    normal = candidates[int(np.argmax(votes))]
    for narrower in (1.0, 0.6, 0.4):
        height = (1.0 - scaled @ normal) / np.linalg.norm(normal)
        own = np.abs(height) < narrower * band
        if np.count_nonzero(own) < MIN_POINTS // 2:
            break
        weighted = scaled[own] / band[own, None]
        normal = np.linalg.lstsq(weighted, 1.0 / band[own], rcond=None)[0]
    return np.asarray(normal)
