"""The detector in the path-traced judging world, and on photographs that were not trained on.

``python -m experiments.detector.traced FOLDER`` prints the figures of both detectors as JSON.  FOLDER is what
``training.pictures.traced.blender.judging`` drew; nothing of it is shared with the training but camera and file format.
"""

from __future__ import annotations

import json
import random
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from autonomy.perception.segmentation.instances import Instance
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.mask_segmenter import MaskSegmenter
from experiments.detector import photos
from machine.geometry.optics import Intrinsics, pinhole
from training.common.average_precision import Matches, average_precision, box_overlaps, curve, mask_overlaps
from training.detection.detector_weights import box_of
from training.pictures.traced.developing import developed

MIN_LOG_PX: Final = 100
SURE: Final = 0.5
BINS: Final = ((0.5, 0.7), (0.7, 0.85), (0.85, 0.95), (0.95, 1.01))
TRAINED_SCENES: Final = (
    "horizontal_grid 4",
    "vertical_grid 4",
    "horizontal_grid 6",
    "vertical_grid 10",
    "horizontal_grid 8",
    "vertical_grid 8",
    "vertical_grid 7",
)
"""Photographs whose scenes the training has seen; both sheets show some scenes twice."""
PHOTO_VIEW_RAD: Final = 1.4
Finder = Callable[[np.ndarray, np.ndarray, Intrinsics], tuple[Instance, ...]]


@dataclass(frozen=True, slots=True)
class TracedPicture:
    """A judging picture: rgb, exact depth, depth by a stereo matcher or None, numbers of the logs (H, W) uint8."""

    name: str
    rgb: np.ndarray
    depth_m: np.ndarray
    matched_m: np.ndarray | None
    ids: np.ndarray
    pin: Intrinsics


def traced_pictures(folder: Path) -> Iterator[TracedPicture]:
    """Read the pictures of a folder, in order."""
    for file in sorted((folder / "pictures").glob("judged*.npz")):
        with np.load(file, allow_pickle=False) as archive:
            rgb = developed(archive["light"], random.Random(file.stem))
            height, width = archive["ids"].shape
            pin = Intrinsics(width, height, *(float(x) for x in archive["lens"]))
            matched = archive["matched_m"] if "matched_m" in archive.files else None
            yield TracedPicture(file.stem, rgb, archive["depth_m"].astype(np.float32), matched, archive["ids"], pin)


def compared(found: tuple[Instance, ...], ids: np.ndarray) -> tuple[Matches, Matches]:
    """Compare detections against the numbers of a picture, by boxes and by masks."""
    truth = [ids == k for k in range(1, int(ids.max()) + 1) if (ids == k).any()]
    small = np.array([t.sum() < MIN_LOG_PX for t in truth], bool)
    scores = np.array([i.score for i in found])
    boxes = box_overlaps(np.array([i.box_px for i in found]), np.array([box_of(t) for t in truth]))
    return Matches(scores, boxes, small), Matches(scores, mask_overlaps([i.mask for i in found], truth), small)


def figures(pictures: list[TracedPicture], find: Finder, depth: str) -> dict[str, float]:
    """Compute average precisions, false finds and calibration; ``depth`` is exact, matched or none."""
    boxes, masks = [], []
    for one in pictures:
        z = one.matched_m if depth == "matched" else one.depth_m
        if z is None:
            continue
        if depth == "none":
            z = np.full_like(z, np.nan)
        box, mask = compared(find(one.rgb, z, one.pin), one.ids)
        boxes.append(box)
        masks.append(mask)
    if not boxes:
        return {}
    whole = curve(boxes, 0.5)
    sure = int(np.count_nonzero(whole.scores >= SURE))
    out = {
        "pictures": float(len(boxes)),
        "map50": whole.average,
        "map50_95": average_precision(boxes),
        "mask_map50": curve(masks, 0.5).average,
        "mask_map50_95": average_precision(masks),
        "false_per_picture": sure * (1.0 - float(whole.precision[sure - 1])) / len(boxes) if sure else 0.0,
    }
    right = np.diff(np.concatenate([[0.0], whole.precision * np.arange(1, len(whole.scores) + 1)]))
    for low, high in BINS:
        own = (whole.scores >= low) & (whole.scores < high)
        if own.any():
            out[f"right_at_{low}"] = float(right[own].mean())
    return out


def photos_iou(find: Finder, where: Path) -> dict[str, float]:
    """Compute the median overlap of found and labelled wood on photographs of scenes that were not trained on."""
    overlaps = []
    for shot in photos.photos(where):
        if shot.name in TRAINED_SCENES:
            continue
        height, width = shot.rgb.shape[:2]
        wood = np.zeros((height, width), bool)
        unknown = np.full((height, width), np.nan, np.float32)
        for log in find(shot.rgb, unknown, pinhole(width, height, PHOTO_VIEW_RAD)):
            wood |= log.mask
        overlaps.append(photos.overlap(wood, shot.wood))
    known = [o for o in overlaps if np.isfinite(o)]
    return {"photos": float(len(overlaps)), "photos_iou": float(np.median(known))} if known else {}


def main(folder: Path) -> None:
    """Print the figures of the mask network and of the detector before it."""
    pictures = list(traced_pictures(folder))
    result: dict[str, Any] = {}
    for name, find in (("masks", MaskSegmenter().segment_picture), ("segments", LogSegmenter().segment_picture)):
        for depth in ("exact", "matched", "none"):
            result[f"{name}.{depth}"] = figures(pictures, find, depth)
        result[f"{name}.photos"] = photos_iou(find, photos.folder())
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
