"""A labelled picture of logs: the training sample of the segmentation, whatever its source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.segmentation.resize import doubled, repeated
from machine.geometry.optics import Intrinsics

ID, CENTRE_U, CENTRE_V, START_U, START_V, END_U, END_V, START_SEEN, END_SEEN, ANGLE, ELONGATION = range(11)
ROW: Final = 11
IGNORED: Final = 255
FULL_ELONGATION_WIDTHS: Final = 3.0  # from this length in widths on, the angle of a log has full weight


@dataclass(frozen=True, slots=True)
class Labelled:
    """One picture with its ground truth.

    rgb (H, W, 3) uint8; depth_m (H, W) float32, NaN unknown; ids (H, W) uint8: 0 no log, 1.. a log, IGNORED excluded
    from loss and metrics; logs (N, ROW) float32: id, centre u v (middle of the visible part), first end u v, last end
    u v [px], whether each end is visible (1 or 0), angle of the axis in the picture [rad, modulo pi], elongation (0
    seen end-on .. 1); height_m (H, W) float32 over the dominant plane of the whole picture, if it was computed before.
    """

    rgb: np.ndarray
    depth_m: np.ndarray
    ids: np.ndarray
    logs: np.ndarray
    intrinsics: Intrinsics
    height_m: np.ndarray | None = None


def seen_along(u: np.ndarray, v: np.ndarray, axis: np.ndarray) -> tuple[tuple[float, float], float]:
    """Compute the middle (u, v) of a log's visible pixels and their extent along the unit ``axis`` (2,) [px].

    The middle is half-way along the axis and the median across it.
    """
    along, across = u * axis[0] + v * axis[1], v * axis[0] - u * axis[1]
    middle, side = (float(along.min()) + float(along.max())) / 2.0, float(np.median(across))
    centre = (middle * axis[0] - side * axis[1], middle * axis[1] + side * axis[0])
    return (float(centre[0]), float(centre[1])), float(along.max() - along.min())


def elongation(extent_px: float, width_px: float) -> float:
    """Return 0 for a log seen end-on, 1 for one that appears FULL_ELONGATION_WIDTHS widths long or more."""
    return min(1.0, max(0.0, (extent_px / max(width_px, 1.0) - 1.0) / (FULL_ELONGATION_WIDTHS - 1.0)))


def mirrored(sample: Labelled) -> Labelled:
    """Mirror the picture left to right."""
    w, pin = sample.rgb.shape[1], sample.intrinsics
    logs = sample.logs.copy()
    logs[:, (CENTRE_U, START_U, END_U)] = w - 1.0 - logs[:, (CENTRE_U, START_U, END_U)]
    logs[:, ANGLE] = (math.pi - logs[:, ANGLE]) % math.pi
    turned = Intrinsics(pin.width_px, pin.height_px, pin.fx_px, pin.fy_px, w - 1.0 - pin.cx_px, pin.cy_px)
    height = None if sample.height_m is None else sample.height_m[:, ::-1]
    return Labelled(sample.rgb[:, ::-1], sample.depth_m[:, ::-1], sample.ids[:, ::-1], logs, turned, height)


def enlarged(sample: Labelled) -> Labelled:
    """Enlarge the picture to twice the size."""
    rgb, depth, pin = doubled(sample.rgb, sample.depth_m, sample.intrinsics)
    logs = sample.logs.copy()
    logs[:, CENTRE_U : END_V + 1] = 2.0 * logs[:, CENTRE_U : END_V + 1] + 0.5
    height = None if sample.height_m is None else repeated(sample.height_m)
    return Labelled(rgb, depth, repeated(sample.ids), logs, pin, height)


def cropped(sample: Labelled, left: int, top: int, size_px: int) -> Labelled:
    """Cut a square window inside the picture; the visible part of every log is determined again."""
    window = (slice(top, top + size_px), slice(left, left + size_px))
    ids, rows = sample.ids[window], []
    v, u = np.nonzero((ids > 0) & (ids != IGNORED))
    of = ids[v, u]
    shift = np.array([left, top] * 2, np.float32)
    for log in sample.logs:
        own = of == log[ID]
        if not own.any():
            continue
        row = log.copy()
        axis = np.array([math.cos(log[ANGLE]), math.sin(log[ANGLE])])
        (row[CENTRE_U], row[CENTRE_V]), _ = seen_along(u[own], v[own], axis)
        row[START_U : END_V + 1] -= shift
        rows.append(row)
    logs = np.array(rows, np.float32).reshape(-1, ROW)
    pin = sample.intrinsics.crop(left, top, size_px, size_px)
    height = None if sample.height_m is None else sample.height_m[window]
    return Labelled(sample.rgb[window], sample.depth_m[window], ids, logs, pin, height)
