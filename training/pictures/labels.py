"""A labelled picture of logs, whatever it comes from: what the segmentation learns from."""

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
LONG: Final = 3.0  # from so many widths on a log's angle in the picture counts in full


@dataclass(frozen=True, slots=True)
class Labelled:
    """One picture and its truth.

    rgb (H, W, 3) uint8; depth_m (H, W) float32, NaN unknown; ids (H, W) uint8: 0 no log, 1.. a log, IGNORED something
    that is not to be judged; logs (N, ROW) float32: id, centre u v (middle of what is seen), first end u v, last end u
    v [px], whether either end is seen (1 or 0), angle of the axis in the picture [rad, modulo pi], elongation (0 seen
    end-on .. 1); height_m (H, W) float32 over the whole picture's prevailing plane, where it is known beforehand.
    """

    rgb: np.ndarray
    depth_m: np.ndarray
    ids: np.ndarray
    logs: np.ndarray
    intrinsics: Intrinsics
    height_m: np.ndarray | None = None


def seen_along(u: np.ndarray, v: np.ndarray, axis: np.ndarray) -> tuple[tuple[float, float], float]:
    """Middle (u, v) of a log's visible pixels (halfway along the unit ``axis`` (2,), median across) and their extent
    along it [px]."""
    along, across = u * axis[0] + v * axis[1], v * axis[0] - u * axis[1]
    middle, side = (float(along.min()) + float(along.max())) / 2.0, float(np.median(across))
    centre = (middle * axis[0] - side * axis[1], middle * axis[1] + side * axis[0])
    return (float(centre[0]), float(centre[1])), float(along.max() - along.min())


def elongation(extent_px: float, width_px: float) -> float:
    """0 for a log seen end-on, 1 for one seen LONG widths long."""
    return min(1.0, max(0.0, (extent_px / max(width_px, 1.0) - 1.0) / (LONG - 1.0)))


def row_of_mask(number: int, mask: np.ndarray) -> tuple[float, ...]:
    """A row for a log of which only the mask (H, W) is known: its principal axis; the ends are where the mask ends, and
    are said to be unseen because nobody knows."""
    v, u = np.nonzero(mask)
    points = np.stack([u, v]).astype(float)
    values, vectors = np.linalg.eigh(np.cov(points) if len(u) > 1 else np.eye(2))
    axis = vectors[:, -1]
    (cu, cv), extent = seen_along(u, v, axis)
    half = 0.5 * extent * axis
    width = math.sqrt(12.0 * max(float(values[0]), 0.0)) + 1.0
    angle = math.atan2(axis[1], axis[0]) % math.pi
    return (number, cu, cv, cu - half[0], cv - half[1], cu + half[0], cv + half[1], 0.0, 0.0, angle,
            elongation(extent, width))  # fmt: skip


def mirrored(sample: Labelled) -> Labelled:
    """The same picture seen in a mirror."""
    w, pin = sample.rgb.shape[1], sample.intrinsics
    logs = sample.logs.copy()
    logs[:, (CENTRE_U, START_U, END_U)] = w - 1.0 - logs[:, (CENTRE_U, START_U, END_U)]
    logs[:, ANGLE] = (math.pi - logs[:, ANGLE]) % math.pi
    turned = Intrinsics(pin.width_px, pin.height_px, pin.fx_px, pin.fy_px, w - 1.0 - pin.cx_px, pin.cy_px)
    height = None if sample.height_m is None else sample.height_m[:, ::-1]
    return Labelled(sample.rgb[:, ::-1], sample.depth_m[:, ::-1], sample.ids[:, ::-1], logs, turned, height)


def enlarged(sample: Labelled) -> Labelled:
    """The same picture twice as large."""
    rgb, depth, pin = doubled(sample.rgb, sample.depth_m, sample.intrinsics)
    logs = sample.logs.copy()
    logs[:, CENTRE_U : END_V + 1] = 2.0 * logs[:, CENTRE_U : END_V + 1] + 0.5
    height = None if sample.height_m is None else repeated(sample.height_m)
    return Labelled(rgb, depth, repeated(sample.ids), logs, pin, height)


def cropped(sample: Labelled, left: int, top: int, size_px: int) -> Labelled:
    """A square window that lies inside the picture; what is seen of every log is judged anew."""
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
