"""A log detector of one's own: whatever has the colour of bark and is long and thin, one log for each piece."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from autonomy.perception.camera.frame import RgbdFrame
from experiments.common.plugins import SeenLog

SMOOTH_PX = 5
RED_OVER_BLUE = (1.6, 3.0)
RED_OVER_GREEN = (1.15, 1.5)
"""The colour of bark by daylight: redder than the ground, and less red than the paint of a grapple."""
MIN_PIXELS = 400
LENGTH_OVER_DIAMETER = (4.0, 30.0)


class BarkColour:
    """Finds logs that lie apart (the contract of `experiments.common.plugins.LogPictureDetector`)."""

    def __call__(self, frame: RgbdFrame) -> Sequence[SeenLog]:
        """Find the logs in this picture, in the optical frame: z forward, x right, y down."""
        red, green, blue = np.moveaxis(ndimage.uniform_filter(frame.rgb.astype(float), (SMOOTH_PX, SMOOTH_PX, 1)), 2, 0)
        bark = _between(red / np.maximum(blue, 1.0), RED_OVER_BLUE)
        bark &= _between(red / np.maximum(green, 1.0), RED_OVER_GREEN)
        pieces, count = ndimage.label(ndimage.binary_opening(bark, iterations=2))
        logs = [_log(frame, *np.nonzero(pieces == i)) for i in range(1, count + 1)]
        return [log for log in logs if log is not None]


def _log(frame: RgbdFrame, v: np.ndarray, u: np.ndarray) -> SeenLog | None:
    """Fit a cylinder to the pixels in rows ``v`` and columns ``u``; None if that is no log."""
    pin, depth = frame.intrinsics, np.asarray(frame.depth_m, float)[v, u]
    valid = np.isfinite(depth)
    if valid.sum() < MIN_PIXELS:
        return None
    rays = np.stack([(u - pin.cx_px) / pin.fx_px, (v - pin.cy_px) / pin.fy_px, np.ones(len(u))], axis=1)
    points = rays * np.where(valid, depth, np.median(depth[valid]))[:, None]
    inliers = points[valid]
    for _ in range(5):  # a line through the bark, without what lies beside it
        middle = inliers.mean(axis=0)
        axis = np.linalg.svd(inliers - middle, full_matrices=False)[2][0]
        distances_m = np.linalg.norm(np.cross(inliers - middle, axis), axis=1)
        inliers = inliers[distances_m <= np.quantile(distances_m, 0.9)]
    across = np.cross(axis, middle / np.linalg.norm(middle))
    ends, sides = (np.quantile((points - middle) @ direction, (0.005, 0.995)) for direction in (axis, across))
    length_m, diameter_m = float(np.ptp(ends)), float(np.ptp(sides))
    if not LENGTH_OVER_DIAMETER[0] < length_m / diameter_m < LENGTH_OVER_DIAMETER[1]:
        return None
    # The camera sees the near half of the bark; the axis lies a third of the diameter behind its middle.
    centre = middle + ends.mean() * axis + diameter_m / 3.0 * middle / np.linalg.norm(middle)
    return SeenLog(_triple(centre), _triple(axis), length_m, diameter_m)


def _between(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    return (values > limits[0]) & (values < limits[1])


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(a) for a in v)
    return x, y, z
