"""The Cornell grasping data in its original layout: a folder of pcdNNNNr.png, d.tiff, cpos.txt and cneg.txt.

Depth is float32 metres; a rectangle is four lines "x y".  Rectangles with a corner that is not a number are skipped, as
are samples without depth or labels.  It is not published which pictures show the same object; consecutive numbers
usually do, so ``grouped_folds`` keeps neighbours together.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from runtime.errors import InputRefused

GUARD_COUNT: Final = 4
"""Numbers beside a test fold that are excluded from training: an object has 3 to 5 consecutive pictures."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One picture: its number, depth (H, W) float32 [m] with NaN where unknown, and its grasps."""

    number: int
    depth_m: np.ndarray
    grasps: tuple[Rectangle, ...]
    picture: Path


def load(folder: Path) -> tuple[Sample, ...]:
    """Read all samples in the order of their numbers.

    Raises:
        InputRefused: there is no sample, or a file cannot be read.
    """
    files = sorted(folder.rglob("pcd*d.tiff")) if folder.is_dir() else []
    samples = [s for path in files if (s := _sample(path)) is not None]
    if not samples:
        raise InputRefused(
            "dataset.no-samples",
            f"{folder}: no Cornell samples; the folder must hold pcdNNNNd.tiff and pcdNNNNcpos.txt",
        )
    return tuple(sorted(samples, key=lambda s: s.number))


def _sample(path: Path) -> Sample | None:
    match = re.fullmatch(r"pcd(\d+)d\.tiff", path.name)
    labels = path.with_name(path.name.replace("d.tiff", "cpos.txt"))
    if match is None or not labels.is_file():
        return None
    grasps = rectangles(labels)
    if not grasps:
        return None
    return Sample(int(match[1]), depth(path), grasps, path.with_name(path.name.replace("d.tiff", "r.png")))


def depth(path: Path) -> np.ndarray:
    """Read depth (H, W) float32 [m], NaN where it is unknown (zero or not finite in the file)."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            depth_m = np.asarray(image, np.float32)
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise InputRefused(
            "dataset.bad-depth", f"{path}: cannot be read as a TIFF of float32 metres ({error})"
        ) from None
    if depth_m.ndim != 2:
        raise InputRefused("dataset.bad-depth", f"{path}: not a depth picture but of shape {depth_m.shape}")
    return np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.float32(np.nan))


def rectangles(path: Path) -> tuple[Rectangle, ...]:
    """Read the rectangles of a label file, without those with a corner that is not a number.

    Raises:
        InputRefused: a line is not two numbers, or the number of lines is not a multiple of four.
    """
    try:
        lines = [[float(x) for x in line.split()] for line in path.read_text().splitlines() if line.strip()]
        corners = np.array(lines, float).reshape(-1, 4, 2)
    except (ValueError, OSError) as error:
        raise InputRefused(
            "dataset.bad-rectangles", f"{path}: must hold four lines 'x y' for every rectangle ({error})"
        ) from None
    made = (from_corners(c) for c in corners if np.isfinite(c).all())
    return tuple(r for r in made if r.opening_px > 0.0 and r.jaw_px > 0.0)


def grouped_folds(numbers: list[int], folds: int) -> list[tuple[list[int], list[int]]]:
    """Return (train, test) indices into ``numbers`` (ascending).

    Every test fold is a run of neighbours.  Numbers within ``GUARD_COUNT`` of it are excluded from training, so that no
    object is on both sides.
    """
    fold_indices = []
    for test in np.array_split(np.arange(len(numbers)), folds):
        low, high = numbers[test[0]] - GUARD_COUNT, numbers[test[-1]] + GUARD_COUNT
        train = [i for i, n in enumerate(numbers) if not low <= n <= high]
        fold_indices.append((train, test.tolist()))
    return fold_indices


def paper_folds(count: int, folds: int, seed: int) -> list[tuple[list[int], list[int]]]:
    """Return (train, test) indices of augmented copies, assigned at random as in the paper.

    Copies of one object, even of one picture, are on both sides.
    """
    order = np.random.default_rng(seed).permutation(count)
    parts = np.array_split(order, folds)
    return [(np.sort(np.setdiff1d(order, part)).tolist(), np.sort(part).tolist()) for part in parts]


# -- Grasp rectangles and the rectangle metric for grasps on pictures (paper A II-D, after Jiang et al. 2011).
#
# A rectangle is its centre [px], the direction in which the jaws close (x is_correct, y down), the opening along it
# and the size of the jaws across it.  A grasp is correct when its intersection over union with one labelled
# rectangle is more than a quarter and its direction differs by less than 30 degrees.

MIN_IOU: Final = 0.25
MAX_ANGLE_RAD: Final = math.radians(30.0)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A grasp rectangle in a picture."""

    u_px: float
    v_px: float
    theta_rad: float
    opening_px: float
    jaw_px: float

    def corners(self) -> np.ndarray:
        """Compute its corners (4, 2) [px] in order; the first edge runs along the opening."""
        along = 0.5 * self.opening_px * np.array([math.cos(self.theta_rad), math.sin(self.theta_rad)])
        across = 0.5 * self.jaw_px * np.array([-math.sin(self.theta_rad), math.cos(self.theta_rad)])
        middle = np.array([self.u_px, self.v_px])
        return np.array(
            [middle - along - across, middle + along - across, middle + along + across, middle - along + across]
        )


def from_corners(corners: np.ndarray) -> Rectangle:
    """Make the rectangle of four corners (4, 2) as in the Cornell data, where hand-drawn ones are slightly skewed."""
    (p0, p1, p2, _), (u, v) = corners, corners.mean(axis=0)
    along, across = p1 - p0, p2 - p1
    theta = wrapped(math.atan2(along[1], along[0]))
    return Rectangle(float(u), float(v), theta, float(np.hypot(*along)), float(np.hypot(*across)))


def wrapped(theta_rad: float) -> float:
    """Wrap the direction into [-pi/2, pi/2), because half a turn does not change a grasp."""
    return (theta_rad + math.pi / 2) % math.pi - math.pi / 2


def angle_between(a_rad: float, b_rad: float) -> float:
    """Compute the angle between two directions, 0 to pi/2."""
    return abs(wrapped(a_rad - b_rad))


def iou(a: Rectangle, b: Rectangle) -> float:
    """Compute the exact intersection over union."""
    shared = _area(_clipped(a.corners(), b.corners()))
    return shared / (a.opening_px * a.jaw_px + b.opening_px * b.jaw_px - shared)


def is_correct(grasp: Rectangle, labels: Iterable[Rectangle]) -> bool:
    """Tell whether the grasp is correct for one of the labels."""
    return any(
        angle_between(grasp.theta_rad, label.theta_rad) < MAX_ANGLE_RAD and iou(grasp, label) > MIN_IOU
        for label in labels
    )


def _clipped(polygon: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Clip a convex polygon to a convex window of the same turning sense (Sutherland and Hodgman 1974)."""
    for start, end in zip(window, np.roll(window, -1, axis=0), strict=True):
        if len(polygon) == 0:
            break
        edge = end - start
        inside = edge[0] * (polygon[:, 1] - start[1]) - edge[1] * (polygon[:, 0] - start[0])
        clipped_points = []
        for i, side in enumerate(inside):
            previous_side = inside[i - 1]
            if (side >= 0.0) != (previous_side >= 0.0):
                clipped_points.append(
                    polygon[i - 1] + previous_side / (previous_side - side) * (polygon[i] - polygon[i - 1])
                )
            if side >= 0.0:
                clipped_points.append(polygon[i])
        polygon = np.array(clipped_points)
    return polygon


def _area(polygon: np.ndarray) -> float:
    if len(polygon) < 3:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
