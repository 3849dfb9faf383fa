"""One test picture: what is found in it against what is there.  Plain data out, for the pool."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np

from autonomy.networks.weights import SHIPPED
from autonomy.perception.papers.box_detector import BoxFinder
from autonomy.perception.segmentation.instances import Instance
from autonomy.perception.segmentation.log_segmenter import LogFinder
from experiments.common.pool import Job
from experiments.detector.worlds import SIZE_PX, TestPicture, picture
from training.common.average_precision import Matches, box_overlaps, mask_overlaps
from training.detection.detector_weights import box_of

SIZES: Final = {
    "rgbd": SIZE_PX, "double": 2 * SIZE_PX, "whole": SIZE_PX, "half": SIZE_PX // 2, "depth": SIZE_PX,
}  # fmt: skip
"""What is judged, by the length of the largest picture that the network sees of the whole."""
NEARER: Final = ("rgbd", "depth")
"""Those that look at the wood from nearer, as the machine does."""


PARTED: Final = "parted"
"""The wood that the first of SIZES finds, cut up into logs as the truth cuts it up."""
FAITHFUL: Final = "faithful"
"""Paper B's detector in its role: colour alone, boxes alone."""


def shipped() -> tuple[str, ...]:
    """Which of SIZES and FAITHFUL have weights."""
    files = {name: f"logs_{_variant(name)}" for name in SIZES} | {FAITHFUL: "log_boxes"}
    return tuple(name for name, file in files.items() if (SHIPPED / f"{file}.safetensors").is_file())


def _variant(name: str) -> str:
    return "depth" if name == "depth" else "rgbd"


@cache
def finder(name: str) -> LogFinder:
    """The network of a name in SIZES with its shipped weights."""
    return LogFinder(_variant(name), size_px=SIZES[name], nearer=name in NEARER)


@cache
def box_finder() -> BoxFinder:
    """Paper B's detector with its shipped weights."""
    return BoxFinder()


def paper_boxes(seen: TestPicture) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (N, 4) and scores (N,) that paper B's detector finds in a picture that is SIZE_PX wide."""
    height, width = seen.rgb.shape[:2]
    top = (SIZE_PX - height) // 2
    square = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)
    square[top : top + height, :width] = seen.rgb
    boxes, scores = box_finder().boxes(square)
    return boxes - (0, top, 0, top), scores


def perform(job: Job) -> dict[str, Any]:
    """A picture by its machine (``kind``) and number."""
    seen = picture(job.kind, job.options["number"], job.seed, job.options["truth"])
    masks, ignored = seen.truths()
    boxes = np.array([box_of(m) for m in masks])
    found = {}
    for name in job.options["networks"]:
        if name == FAITHFUL:
            places, scores = paper_boxes(seen)
            found[name] = {"scores": scores.tolist(), "boxes": box_overlaps(places, boxes).tolist()}
            continue
        logs = finder(name).find(seen.rgb, seen.depth_m, seen.intrinsics)
        found[name] = {
            "scores": [i.score for i in logs],
            "boxes": box_overlaps(np.array([i.box_px for i in logs]), boxes).tolist(),
            "masks": mask_overlaps([i.mask for i in logs], masks).tolist(),
        }
        if name == "rgbd":
            found[PARTED] = parted(np.any([i.mask for i in logs], axis=0), masks, boxes)
    return {
        "machine": job.kind, "kind": seen.kind, "camera": seen.camera, "range_m": seen.range_m,
        "ignored": ignored.tolist(), "pixels": [int(np.count_nonzero(m)) for m in masks], "found": found,
    }  # fmt: skip


def parted(wood: np.ndarray, masks: list[np.ndarray], boxes: np.ndarray) -> dict[str, Any]:
    """What ``wood`` (H, W) would be worth, were it cut up as the true ``masks`` with their ``boxes`` (M, 4) are."""
    places = [box_of(wood & m) for m in masks if (wood & m).any()]
    return {"scores": [1.0] * len(places), "boxes": box_overlaps(np.array(places), boxes).tolist()}


def matches(outcome: dict[str, Any], name: str, by: str) -> Matches:
    """What ``name`` found in a picture, compared ``by`` boxes or masks."""
    found, truths = outcome["found"][name], len(outcome["ignored"])
    overlaps = np.array(found[by], float).reshape(len(found["scores"]), truths)
    return Matches(np.array(found["scores"]), overlaps, np.array(outcome["ignored"], bool))


def look(machine: str, number: int, seed: int, truth: str, name: str) -> tuple[TestPicture, tuple[Instance, ...]]:
    """A picture with what is found in it, to be drawn."""
    seen = picture(machine, number, seed, truth)
    return seen, finder(name).find(seen.rgb, seen.depth_m, seen.intrinsics)
