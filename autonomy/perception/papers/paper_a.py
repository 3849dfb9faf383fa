"""Paper A's perception (II-B), implemented faithfully: pose, length and diameter from a mask and a point cloud.

The paper names the steps (masks of a segmentation network "coupled with a point-cloud obtained from a depth camera are
then combined to infer the length and diameter of the logs, and localize them") but gives no formulas.  This is their
plainest reading: the centroid of the cloud is the centre, its first principal axis the axis, its extents along the
first and second principal axes are length and diameter.  The method takes the visible surface, with its fattened edges,
for the log.  When the diameter comes out greater than the length, the axis is 90 degrees off; these are the paper's two
failures (IV).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame

MIN_POINTS: Final = 16


@dataclass(frozen=True, slots=True)
class LogCylinder:
    """Centre (3,) [m] and unit axis (3,) in the optical frame, length and diameter [m]."""

    center_m: np.ndarray
    axis: np.ndarray
    length_m: float
    diameter_m: float


def log_from_mask(frame: RgbdFrame, mask: np.ndarray) -> LogCylinder | None:
    """The log of a mask (H, W) bool; None with fewer than ``MIN_POINTS`` points of known depth."""
    v, u = np.nonzero(mask & np.isfinite(frame.depth_m))
    if len(u) < MIN_POINTS:
        return None
    pin, z = frame.intrinsics, frame.depth_m[v, u].astype(float)
    cloud = np.stack([(u - pin.cx_px) / pin.fx_px * z, (v - pin.cy_px) / pin.fy_px * z, z], axis=1)
    center = cloud.mean(axis=0)
    _, _, axes = np.linalg.svd(cloud - center, full_matrices=False)
    along, across = ((cloud - center) @ axis for axis in axes[:2])
    return LogCylinder(center, axes[0], float(np.ptp(along)), float(np.ptp(across)))
