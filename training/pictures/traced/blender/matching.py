"""Depth from two pictures by OpenCV's semi-global matching, as a stereo camera's computer does it."""

from __future__ import annotations

import numpy as np

LEAST_DISPARITY, DISPARITIES, BLOCK_PX = 1, 96, 5
GRAIN = 1.5  # of the eyes' sensors, of 255


def matched_depth(left: np.ndarray, right: np.ndarray, focal_px: float, baseline_m: float, seed: int = 0) -> np.ndarray:
    """Compute optical depth (H, W) float32 [m] of the left picture, NaN where the two do not agree.

    ``left`` and ``right`` (H, W, 3) are linear light; their rows match.
    """
    import cv2

    rng = np.random.default_rng(seed)
    level = 0.4 / max(float(np.median(left)), 1e-6)
    eyes = []
    for light in (left, right):
        grey = 255.0 * np.clip(level * light.mean(axis=2) * 0.5, 0.0, 1.0) ** (1.0 / 2.2)
        eyes.append(np.clip(grey + rng.normal(0.0, GRAIN, grey.shape), 0.0, 255.0).astype(np.uint8))
    # Columns to the left of the picture give the matcher room for near things.
    wide = [cv2.copyMakeBorder(e, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE) for e in eyes]
    matcher = cv2.StereoSGBM_create(
        minDisparity=LEAST_DISPARITY,
        numDisparities=DISPARITIES,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        uniquenessRatio=8,
        speckleWindowSize=80,
        speckleRange=2,
        preFilterCap=31,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(*wide).astype(np.float32)[:, DISPARITIES:] / 16.0
    return np.where(disparity > LEAST_DISPARITY, focal_px * baseline_m / np.maximum(disparity, 0.1), np.nan).astype(
        np.float32
    )
