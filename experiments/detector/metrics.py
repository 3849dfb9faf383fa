"""Metrics of the detector experiment with their limits, and the page that shows them."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Metric
from experiments.common.result_page import Section
from experiments.detector.trial import FAITHFUL
from training.pictures.piles import MACHINES

NAMES: Final = {
    "rgbd": "colour and depth",
    "double": "colour and depth, whole picture doubled",
    "whole": "colour and depth, whole picture",
    "half": "colour and depth, half size",
    "depth": "depth only",
    FAITHFUL: "paper B's detector: colour only",
}
LARGE_PX: Final = 800
"""A log of 2 m by 25 cm across the view shows this many pixels 6.3 m from the front camera."""
PAPER: Final = {"map50": 0.8051}
LEAST: Final = {f"{FAITHFUL}.map50": PAPER["map50"]}

CONCLUSION: Final = (
    "On test worlds and with a renderer that were not used for training, boxes reach a mAP@0.5 of {map50} (paper B on "
    "its own photographs: {paper:map50}) and masks {mask_map50}; {recall} of the logs are found.",
    "{found_large} of the logs that show many pixels are found, {found_small} of the others; with a perfect separation "
    "of the wood into logs boxes would reach {parted.map50}.",
)
INTRODUCTION: Final = (
    "Paper B finds logs with YOLOv3 in pictures of 608 x 608 pixels and reports a mean average precision of 80.51 %. "
    "Here one small network (0.49 million parameters) predicts masks, centres, axes, edges and ends of logs from "
    "colour and depth; the boxes follow from the masks."
)


def _share(name: str, title: str, how: str, least: float | None = None) -> Metric:
    return Metric(name, title, "%", how, least, None, 100.0)


BOXES: Final = (
    _share(
        "map50",
        "Boxes, mAP@0.5",
        "COCO's measure; pictures of 608 px, processed as on the machine: at half size, and regions with wood "
        "enlarged.",
        0.95,
    ),
    _share("map50_95", "Boxes, mAP@0.5:0.95", "Mean over ten minimum overlaps from 0.5 to 0.95.", 0.80),
    _share("recall", "Logs found", "With a score of at least 0.5 and an overlap of at least 0.5."),
    Metric("false_per_picture", "False detections per picture", "", "With a score of at least 0.5."),
)
LOST: Final = (
    _share(
        "parted.map50",
        "Boxes, mAP@0.5, with perfectly separated logs",
        "All pixels classified as wood, divided into logs by the ground truth.",
    ),
    _share("parted.map50_95", "Boxes, mAP@0.5:0.95, with perfectly separated logs", "The same pixels."),
    _share(
        "found_large", f"Logs found that show at least {LARGE_PX} px", "With an overlap of at least 0.5, at any score."
    ),
    _share(
        "found_small",
        f"Logs found that show fewer than {LARGE_PX} px",
        "With an overlap of at least 0.5, at any score.",
    ),
)
MASKS: Final = (
    _share("mask_map50", "Masks, mAP@0.5", "As for boxes, with masks."),
    _share("mask_map50_95", "Masks, mAP@0.5:0.95", "As for boxes, with masks."),
    *(_share(f"{m}.map50", f"Boxes, mAP@0.5, {m}", "On the pictures of one machine.") for m in MACHINES),
    *(
        _share(f"{n}.{key}", f"Boxes, {title}, {NAMES[n]}", "The same pictures.", LEAST.get(f"{n}.{key}"))
        for n in ("double", "whole", "half", "depth", FAITHFUL)
        for key, title in (("map50", "mAP@0.5"), ("map50_95", "mAP@0.5:0.95"))
    ),
)
PHOTOS: Final = (
    Metric("photos", "Photographs", "", "From TimberSeg's preview sheets; 180 to 500 px wide, without depth."),
    _share(
        "photos_iou",
        "Overlap of detected and labelled wood, median",
        "All masks of a picture together; the labels were derived from coloured overlays.",
    ),
)
METRICS: Final = (*BOXES, *LOST, *MASKS, *PHOTOS)
SECTIONS: Final = (
    Section(
        "Detection on unseen worlds",
        "The test piles were not used for training. Logs are oval, bumpy, tapered and swept meshes on rough ground "
        "with grass and branches, drawn by pybullet's renderer; the network was trained only with round cones drawn by "
        "the analytic renderer. Depth has the stereo errors of the plant's cameras. Logs with fewer than 100 of the "
        "picture's 370 000 pixels do not count. Paper B's value was measured on its own photographs: the two tests "
        "differ.",
        BOXES,
        (
            ("precision_recall.png", "Precision and recall, as in Fig. 7 of paper B."),
            (
                "found.png",
                "Logs found in test pictures: boxes, masks, scores and ends; a filled dot is a visible end of the log.",
            ),
        ),
    ),
    Section(
        "Causes of missed logs",
        "Nearly all wood is classified correctly. What fails is the separation into logs: behind others, logs appear "
        "as strips a few pixels wide, which are merged with a neighbour or break up.",
        LOST,
    ),
    Section(
        "Masks, machines, variants",
        "The same network evaluated by its masks and on the cameras of each machine; with the whole picture doubled, "
        "which takes three times as long; without enlarged regions; at half size only; and the variant that uses depth "
        "only.",
        MASKS,
    ),
    Section(
        "Photographs",
        "A check, not a benchmark: a few small photographs of TimberSeg 1.0 (Fortin et al. 2022, doi "
        "10.17632/y5npsm3gkj, CC BY 4.0), which have no depth. The network was never trained on photographs. They are "
        "not part of the project; without their folder these metrics are missing. The sheet `photos.png` is written "
        "beside the result.",
        PHOTOS,
    ),
)
