"""TimberSeg 1.0, or any other data set in COCO format, as labelled pictures.

There is one class: every annotation is a log, given as polygons or as a run-length mask.  Crowds are ignored.  There is
no depth.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw, UnidentifiedImageError

from machine.geometry.optics import pinhole
from training.common.dataset_error import DatasetError
from training.pictures.labels import IGNORED, ROW, Labelled, row_of_mask

MAX_LOGS: Final = 250  # logs in a picture; ids are bytes
FIELD_OF_VIEW_RAD: Final = 1.4  # assumed; the field of view is unknown and has no effect without depth
MIN_LOG_PX: Final = 8


@dataclass(frozen=True, slots=True)
class CocoPicture:
    """A file and its annotations as in the JSON."""

    path: Path
    width_px: int
    height_px: int
    annotations: tuple[dict[str, Any], ...]


def load(annotations: Path, images: Path) -> tuple[CocoPicture, ...]:
    """The pictures of a COCO file, in the order of their ids; ``images`` is the folder of their files.

    Raises:
        DatasetError: the file is not a COCO file or has no pictures.
    """
    try:
        whole = json.loads(annotations.read_text())
        of: dict[int, list[dict[str, Any]]] = {int(i["id"]): [] for i in whole["images"]}
        for annotation in whole["annotations"]:
            of[int(annotation["image_id"])].append(annotation)
        rows = sorted(whole["images"], key=lambda i: int(i["id"]))
        found = tuple(
            CocoPicture(images / i["file_name"], int(i["width"]), int(i["height"]), tuple(of[int(i["id"])]))
            for i in rows
        )
    except OSError as error:
        raise DatasetError(
            "dataset.unreadable",
            f"{annotations}: cannot be read ({error.strerror}); give the JSON file of a COCO data set",
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            "dataset.not-coco", f"{annotations}: not a COCO file ({type(error).__name__}: {error})"
        ) from None
    if not found:
        raise DatasetError("dataset.no-pictures", f"{annotations}: the COCO file has no pictures")
    return found


def labelled(picture: CocoPicture, size_px: int) -> Labelled:
    """The picture letterboxed into a square, its logs labelled; depth is unknown everywhere.

    Raises:
        DatasetError: the file is missing or not a picture, or an annotation is invalid.
    """
    factor = size_px / max(picture.width_px, picture.height_px)
    w, h = max(1, round(picture.width_px * factor)), max(1, round(picture.height_px * factor))
    left, top = (size_px - w) // 2, (size_px - h) // 2
    rgb = np.zeros((size_px, size_px, 3), np.uint8)
    try:
        with Image.open(picture.path) as image:
            rgb[top : top + h, left : left + w] = np.asarray(image.convert("RGB").resize((w, h), Image.Resampling.BOX))
    except (OSError, UnidentifiedImageError) as error:
        raise DatasetError("dataset.bad-picture", f"{picture.path}: cannot be read as a picture ({error})") from None
    ids = np.zeros((size_px, size_px), np.uint8)
    rows: list[tuple[float, ...]] = []
    for annotation in picture.annotations:
        own = np.zeros_like(ids, bool)
        own[top : top + h, left : left + w] = _mask(annotation, picture, (w, h))
        if annotation.get("iscrowd") or len(rows) == MAX_LOGS or np.count_nonzero(own) < MIN_LOG_PX:
            ids[own] = IGNORED
            continue
        ids[own] = len(rows) + 1
        rows.append(row_of_mask(len(rows) + 1, own))
    depth = np.full(ids.shape, np.nan, np.float32)
    logs = np.array(rows, np.float32).reshape(-1, ROW)
    return Labelled(rgb, depth, ids, logs, pinhole(size_px, size_px, FIELD_OF_VIEW_RAD))


def _mask(annotation: dict[str, Any], picture: CocoPicture, size: tuple[int, int]) -> np.ndarray:
    """Mask (h, w) of an annotation, scaled to ``size`` (width, height)."""
    try:
        shape = annotation["segmentation"]
        if isinstance(shape, list):
            scale = np.array(size) / (picture.width_px, picture.height_px)
            canvas = Image.new("1", size)
            for polygon in shape:
                points = np.array(polygon, float).reshape(-1, 2) * scale - 0.5
                ImageDraw.Draw(canvas).polygon([tuple(p) for p in points.tolist()], fill=1)
            return np.asarray(canvas)
        whole = Image.fromarray(_runs(shape))
        return np.asarray(whole.resize(size, Image.Resampling.NEAREST))
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise DatasetError(
            "dataset.bad-annotation",
            f"annotation {annotation.get('id')} of {picture.path.name} is invalid ({error})",
        ) from None


def _runs(shape: dict[str, Any]) -> np.ndarray:
    """Mask (H, W) of a run-length encoding: lengths of zeros and ones in turn, down the columns."""
    height, width = (int(n) for n in shape["size"])
    counts = shape["counts"]
    lengths = _unpacked(counts) if isinstance(counts, str) else [int(n) for n in counts]
    if sum(lengths) != height * width or min(lengths, default=0) < 0:
        raise ValueError(f"run lengths of {sum(lengths)} pixels for {width} x {height}")
    values = np.arange(len(lengths)) % 2 == 1
    return np.repeat(values, lengths).reshape(width, height).T


def _unpacked(text: str) -> list[int]:
    """COCO's packed run lengths: five bits per character; from the third on, differences to the last but one."""
    lengths: list[int] = []
    at = 0
    while at < len(text):
        value, shift, more = 0, 0, True
        while more:
            code = ord(text[at]) - 48
            value |= (code & 0x1F) << (5 * shift)
            more = bool(code & 0x20)
            at, shift = at + 1, shift + 1
            if not more and code & 0x10:
                value |= -1 << (5 * shift)
        lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
    return lengths
