"""The Cornell grasping data in its original layout: a folder of pcdNNNNr.png, d.tiff, cpos.txt and cneg.txt.

Depth is float32 metres; a rectangle is four lines "x y".  Rectangles with a corner that is not a number are skipped, as
are samples without depth or labels.  It is not published which pictures show the same object; consecutive numbers
usually do, so ``grouped_folds`` keeps neighbours together.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from runtime.errors import InputRefused
from training.grasp.rectangles import Rectangle, from_corners

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
    """All samples in the order of their numbers.

    Raises:
        InputRefused: there is no sample, or a file cannot be read.
    """
    files = sorted(folder.rglob("pcd*d.tiff")) if folder.is_dir() else []
    found = [s for path in files if (s := _sample(path)) is not None]
    if not found:
        raise InputRefused(
            "dataset.no-samples",
            f"{folder}: no Cornell samples; the folder must hold pcdNNNNd.tiff and pcdNNNNcpos.txt",
        )
    return tuple(sorted(found, key=lambda s: s.number))


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
    """Depth (H, W) float32 [m], NaN where it is unknown (zero or not finite in the file)."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            found = np.asarray(image, np.float32)
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise InputRefused(
            "dataset.bad-depth", f"{path}: cannot be read as a TIFF of float32 metres ({error})"
        ) from None
    if found.ndim != 2:
        raise InputRefused("dataset.bad-depth", f"{path}: not a depth picture but of shape {found.shape}")
    return np.where(np.isfinite(found) & (found > 0.0), found, np.float32(np.nan))


def rectangles(path: Path) -> tuple[Rectangle, ...]:
    """The rectangles of a label file, without those with a corner that is not a number.

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
    """(train, test) indices into ``numbers`` (ascending).

    Every test fold is a run of neighbours.  Numbers within ``GUARD_COUNT`` of it are excluded from training, so that no
    object is on both sides.
    """
    found = []
    for test in np.array_split(np.arange(len(numbers)), folds):
        low, high = numbers[test[0]] - GUARD_COUNT, numbers[test[-1]] + GUARD_COUNT
        train = [i for i, n in enumerate(numbers) if not low <= n <= high]
        found.append((train, test.tolist()))
    return found


def paper_folds(count: int, folds: int, seed: int) -> list[tuple[list[int], list[int]]]:
    """(train, test) indices of augmented copies, assigned at random as in the paper.

    Copies of one object, even of one picture, are on both sides.
    """
    order = np.random.default_rng(seed).permutation(count)
    parts = np.array_split(order, folds)
    return [(np.sort(np.setdiff1d(order, part)).tolist(), np.sort(part).tolist()) for part in parts]
