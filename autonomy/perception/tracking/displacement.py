"""Whether a log that is not where it was is seen elsewhere: lifted, rolled away, or pulled from beneath another."""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list.estimate import LogEstimate

MAX_DISPLACEMENT_M: Final = 1.5  # between two pictures, of a log that is recognised by its shape
MAX_LENGTH_DIFFERENCE_M: Final = 0.25  # of one log in two pictures
MAX_DIAMETER_DIFFERENCE_M: Final = 0.06
MIN_TURN_COSINE: Final = 0.94  # 20 degrees
DEPTH_TOLERANCE_M: Final = 0.1  # depth that agrees this well with a log shows it in its old place
MIN_GONE_SHARE: Final = 0.8  # of the visible part of the log's axis, that must show something else
_SAMPLES: Final = np.linspace(-0.45, 0.45, 25)  # along the axis, as shares of the length
_MIN_GONE_SAMPLES: Final = 10


def is_displaced(frame: RgbdFrame, pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    """Whether ``fit`` is ``log`` in another place.

    The two must have similar shapes, and along the old axis the picture must show what was behind the log, or ``fit``
    in front of it.
    """
    return _similar(pose, log, fit) and _gone(frame, pose, log, fit)


def _similar(pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    body = fit.body
    return (
        abs(body.length_m - log.length_m) < MAX_LENGTH_DIFFERENCE_M
        and abs(2.0 * body.radius_m - log.diameter_m) < MAX_DIAMETER_DIFFERENCE_M
        and abs(float(pose.rotation @ body.axis @ log.axis)) > MIN_TURN_COSINE
        and float(np.linalg.norm(pose.to_base(body.center_m) - log.center_m)) < MAX_DISPLACEMENT_M
    )


def _gone(frame: RgbdFrame, pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    """Whether the old place shows something else, where no third object (the grapple, another log) hides it."""
    line_m = pose.to_optical(log.center_m + np.outer(_SAMPLES * log.length_m, log.axis))
    line_m = line_m[line_m[:, 2] > log.diameter_m]
    surface_m = line_m * (1.0 - 0.5 * log.diameter_m / np.linalg.norm(line_m, axis=1, keepdims=True))
    u, v = np.rint(frame.intrinsics.project(surface_m)).astype(int).T
    height, width = frame.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    surface_m, depth_m = surface_m[inside], frame.depth_m[v[inside], u[inside]]
    nearer_m = surface_m[:, 2] - depth_m  # NaN where no depth is known
    visible_m = surface_m * (depth_m / surface_m[:, 2])[:, None]
    is_fit = (nearer_m > DEPTH_TOLERANCE_M) & (
        _distance_from_axis_m(visible_m, fit) < fit.body.radius_m + DEPTH_TOLERANCE_M
    )
    gone = np.count_nonzero((nearer_m < -DEPTH_TOLERANCE_M) | is_fit)
    there = np.count_nonzero(np.abs(nearer_m) <= DEPTH_TOLERANCE_M)
    return bool(gone >= _MIN_GONE_SAMPLES and gone >= MIN_GONE_SHARE * (gone + there))


def _distance_from_axis_m(points_m: np.ndarray, fit: CylinderFit) -> np.ndarray:
    """Distances (N,) of optical-frame points (N, 3) from the axis of a fit."""
    off = points_m - fit.body.center_m
    return np.asarray(np.linalg.norm(off - np.outer(off @ fit.body.axis, fit.body.axis), axis=1))
