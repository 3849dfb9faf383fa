"""One test picture: detections compared with the ground truth, as plain data."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np

from autonomy.networks import SHIPPED
from autonomy.perception.papers import BoxDetector
from autonomy.perception.segmentation.instances import Instance
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from experiments.common.pool import Job
from experiments.detector.worlds import SIZE_PX, TestPicture, picture
from training.common.average_precision import Matches, box_overlaps, mask_overlaps
from training.detection.detector_weights import box_of

SIZES: Final = {
    "rgbd": SIZE_PX,
    "double": 2 * SIZE_PX,
    "whole": SIZE_PX,
    "half": SIZE_PX // 2,
    "depth": SIZE_PX,
}
"""Variants by the side [px] of the largest whole picture that the network processes."""
ENLARGED: Final = ("rgbd", "depth")
"""Variants that also process enlarged regions with wood, as the machine does."""


PARTED: Final = "parted"
"""The wood found by the first variant, divided into logs by the ground truth."""
FAITHFUL: Final = "faithful"
"""Paper B's detector: colour only, boxes only."""


def shipped() -> tuple[str, ...]:
    """List the variants of SIZES and FAITHFUL that have weights."""
    files = {name: f"logs_{_variant(name)}" for name in SIZES} | {FAITHFUL: "log_boxes"}
    return tuple(name for name, file in files.items() if (SHIPPED / f"{file}.onnx").is_file())


def _variant(name: str) -> str:
    return "depth" if name == "depth" else "rgbd"


@cache
def finder(name: str) -> LogSegmenter:
    """Load the network of a variant in SIZES with its shipped weights."""
    return LogSegmenter(_variant(name), size_px=SIZES[name], use_window=name in ENLARGED)


@cache
def box_finder() -> BoxDetector:
    """Load paper B's detector with its shipped weights."""
    return BoxDetector()


def paper_boxes(seen: TestPicture) -> tuple[np.ndarray, np.ndarray]:
    """Detect boxes (N, 4) with scores (N,) by paper B's detector in a picture that is SIZE_PX wide."""
    height, width = seen.rgb.shape[:2]
    top = (SIZE_PX - height) // 2
    square = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)
    square[top : top + height, :width] = seen.rgb
    boxes, scores = box_finder().detect(square)
    return boxes - (0, top, 0, top), scores


def perform(job: Job) -> dict[str, Any]:
    """Evaluate one picture, given by its machine (``kind``) and number."""
    test_picture = picture(job.kind, job.options["number"], job.seed, job.options["truth"])
    masks, ignored = test_picture.truths()
    boxes = np.array([box_of(m) for m in masks])
    detections = {}
    for name in job.options["networks"]:
        if name == FAITHFUL:
            detected_boxes, scores = paper_boxes(test_picture)
            detections[name] = {"scores": scores.tolist(), "boxes": box_overlaps(detected_boxes, boxes).tolist()}
            continue
        logs = finder(name).segment_picture(test_picture.rgb, test_picture.depth_m, test_picture.intrinsics)
        detections[name] = {
            "scores": [i.score for i in logs],
            "boxes": box_overlaps(np.array([i.box_px for i in logs]), boxes).tolist(),
            "masks": mask_overlaps([i.mask for i in logs], masks).tolist(),
        }
        if name == "rgbd":
            detections[PARTED] = parted(np.any([i.mask for i in logs], axis=0), masks, boxes)
    return {
        "machine": job.kind,
        "kind": test_picture.kind,
        "camera": test_picture.camera,
        "range_m": test_picture.range_m,
        "ignored": ignored.tolist(),
        "pixels": [int(np.count_nonzero(m)) for m in masks],
        "found": detections,
    }


def parted(wood: np.ndarray, masks: list[np.ndarray], boxes: np.ndarray) -> dict[str, Any]:
    """Make detections as if ``wood`` (H, W) were divided into logs like the true ``masks`` with ``boxes`` (M, 4)."""
    places = [box_of(wood & m) for m in masks if (wood & m).any()]
    return {"scores": [1.0] * len(places), "boxes": box_overlaps(np.array(places), boxes).tolist()}


def matches(outcome: dict[str, Any], name: str, by: str) -> Matches:
    """Return the detections of a variant in a picture, compared ``by`` boxes or masks."""
    detections, truths = outcome["found"][name], len(outcome["ignored"])
    overlaps = np.array(detections[by], float).reshape(len(detections["scores"]), truths)
    return Matches(np.array(detections["scores"]), overlaps, np.array(outcome["ignored"], bool))


def example(machine: str, number: int, seed: int, truth: str, name: str) -> tuple[TestPicture, tuple[Instance, ...]]:
    """Make a picture with its detections, for a plot."""
    seen = picture(machine, number, seed, truth)
    return seen, finder(name).segment_picture(seen.rgb, seen.depth_m, seen.intrinsics)
