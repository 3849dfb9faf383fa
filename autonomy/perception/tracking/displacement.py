"""Whether a log that is not where it was is seen elsewhere: lifted, rolled away, slid from beneath another."""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list.estimate import LogEstimate

FARTHEST_M: Final = 1.5  # that a log goes between two pictures and still is known by its looks
ALIKE_M: Final = 0.25  # lengths, and
ALIKE_WIDE_M: Final = 0.06  # diameters, of one log in two pictures differ by less
TURNED: Final = 0.94  # cosine of the turn: 20 degrees
THERE_M: Final = 0.1  # depth that agrees so well with a log where it was shows it there
GONE: Final = 0.8  # share of its line, as far as it is in view, that is to be seen without it
_SAMPLES: Final = np.linspace(-0.45, 0.45, 25)
_ENOUGH: Final = 10  # of these seen without it


def is_displaced(frame: RgbdFrame, pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    """Whether ``fit`` is ``log``, which lies there no longer: they look alike, and along the line on which it lay the
    picture shows what is behind it, or ``fit`` in front.
    """
    return _alike(pose, log, fit) and _left(frame, pose, log, fit)


def _alike(pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    body = fit.body
    return (
        abs(body.length_m - log.length_m) < ALIKE_M
        and abs(2.0 * body.radius_m - log.diameter_m) < ALIKE_WIDE_M
        and abs(float(pose.rotation @ body.axis @ log.axis)) > TURNED
        and float(np.linalg.norm(pose.to_base(body.center_m) - log.center_m)) < FARTHEST_M
    )


def _left(frame: RgbdFrame, pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    """Whether its place shows something else, as far as nothing third (tongs, another log) hides it."""
    line_m = pose.to_optical(log.center_m + np.outer(_SAMPLES * log.length_m, log.axis))
    line_m = line_m[line_m[:, 2] > log.diameter_m]
    surface_m = line_m * (1.0 - 0.5 * log.diameter_m / np.linalg.norm(line_m, axis=1, keepdims=True))
    u, v = np.rint(frame.intrinsics.project(surface_m)).astype(int).T
    height, width = frame.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    surface_m, depth_m = surface_m[inside], frame.depth_m[v[inside], u[inside]]
    nearer_m = surface_m[:, 2] - depth_m  # NaN where no depth is known
    seen_m = surface_m * (depth_m / surface_m[:, 2])[:, None]
    own = (nearer_m > THERE_M) & (_from_axis_m(seen_m, fit) < fit.body.radius_m + THERE_M)
    gone = np.count_nonzero((nearer_m < -THERE_M) | own)
    there = np.count_nonzero(np.abs(nearer_m) <= THERE_M)
    return bool(gone >= _ENOUGH and gone >= GONE * (gone + there))


def _from_axis_m(points_m: np.ndarray, fit: CylinderFit) -> np.ndarray:
    """Distances (N,) of optical-frame points (N, 3) from the axis of a fit."""
    off = points_m - fit.body.center_m
    return np.linalg.norm(off - np.outer(off @ fit.body.axis, fit.body.axis), axis=1)
