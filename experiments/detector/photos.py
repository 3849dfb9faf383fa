"""Photographs, if available: the preview sheets of TimberSeg 1.0 (Fortin et al. 2022, CC BY 4.0).

A check, not a benchmark: about twenty small photographs without depth, and masks derived from coloured overlays.
Nothing of them is part of the project.  The folder is TIMBERHAND_DATA/timberseg_previews (TIMBERHAND_DATA:
../shared/data beside the checkout unless set).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image
from scipy import ndimage

from experiments.common.result import ROOT

SHEETS: Final = ("horizontal_grid", "vertical_grid")
MIN_SIDE_PX: Final = 60
OUTLINE_PX: Final = 5  # the outlines of boxes are thinner than this
MIN_INK_SHARE: Final = 0.06  # of a row or column that is not a gutter
GUTTER_LEVEL: Final = 245  # brighter pixels in all colours separate the photographs


@dataclass(frozen=True, slots=True)
class Photo:
    """A photograph (H, W, 3) uint8 and its pixels with wood (H, W) bool."""

    name: str
    rgb: np.ndarray
    wood: np.ndarray


def folder() -> Path:
    """Return the folder of the sheets."""
    return Path(os.environ.get("TIMBERHAND_DATA") or ROOT.parent / "shared" / "data") / "timberseg_previews"


def photos(where: Path) -> list[Photo]:
    """Read all photographs of the sheets; none without the folder."""
    photographs = []
    for sheet in SHEETS:
        plain, masks = where / f"{sheet}_plain.png", where / f"{sheet}_woodmask.png"
        if plain.is_file() and masks.is_file():
            wood = np.asarray(Image.open(masks).convert("L")) > 127
            photographs += cut(sheet, np.asarray(Image.open(plain).convert("RGB")), wood)
    return photographs


def cut(name: str, sheet: np.ndarray, wood: np.ndarray) -> list[Photo]:
    """Cut a sheet (H, W, 3) into its photographs, which white gutters separate."""
    wood = ndimage.binary_opening(wood, np.ones((OUTLINE_PX, OUTLINE_PX)))
    out: list[Photo] = []
    for window in _windows(np.asarray((sheet < GUTTER_LEVEL).any(axis=2)), 0, 0):
        rgb = sheet[window]
        if min(rgb.shape[:2]) >= MIN_SIDE_PX:
            out.append(Photo(f"{name} {len(out) + 1}", np.ascontiguousarray(rgb), wood[window]))
    return out


def _windows(inked: np.ndarray, top: int, left: int) -> Iterator[tuple[slice, slice]]:
    """Find the windows separated by empty rows and columns, divided recursively."""
    bands = _bands(inked.mean(axis=1) > MIN_INK_SHARE)
    if len(bands) == 1:
        columns = _bands(inked[bands[0][0] : bands[0][1]].mean(axis=0) > MIN_INK_SHARE)
        if len(columns) == 1:
            (y0, y1), (x0, x1) = bands[0], columns[0]
            yield slice(top + y0, top + y1), slice(left + x0, left + x1)
            return
        bands = [bands[0]] * len(columns)
    else:
        columns = [(0, inked.shape[1])] * len(bands)
    for (y0, y1), (x0, x1) in zip(bands, columns, strict=True):
        yield from _windows(inked[y0:y1, x0:x1], top + y0, left + x0)


def _bands(inked: np.ndarray) -> list[tuple[int, int]]:
    steps = np.flatnonzero(np.diff(np.concatenate([[False], inked, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(steps[::2], steps[1::2], strict=True)]


def overlap(found: np.ndarray, wood: np.ndarray) -> float:
    """Compute the intersection over union of two masks; NaN if both are empty."""
    union = np.count_nonzero(found | wood)
    return np.count_nonzero(found & wood) / union if union else float("nan")
