"""Does the network find logs where nothing looks as it did in training?  Paper B 3.2.2 and its Fig. 7."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from rich.console import Console

from autonomy.networks.weights import WeightsRefused
from autonomy.perception.segmentation.log_segmenter import LogFinder
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Figure, Result, judged
from experiments.common.result_page import Section, tell
from experiments.common.trials import checkpoint
from experiments.detector import photos
from experiments.detector.plots import PAPER, contact_sheet, gallery, overlaid, precision_recall
from experiments.detector.trial import FAITHFUL, PARTED, box_finder, finder, look, matches, perform, shipped
from host.exit_codes import CommandFailed, ExitCode
from machine.optics import pinhole
from training.common.average_precision import average_precision, curve, taken
from training.pictures.piles import MACHINES

TRIALS: Final = 120  # pictures of each machine
QUICK_TRIALS: Final = 8
SHOWN: Final = 6  # of each machine on the page
NAMES: Final = {
    "rgbd": "colour and depth",
    "double": "colour and depth, the whole picture doubled",
    "whole": "colour and depth, the whole picture as it is",
    "half": "colour and depth, halved",
    "depth": "depth alone",
    FAITHFUL: "paper B's role: colour alone",
}
LARGE_PX: Final = 800  # a log of 2 m and 25 cm across the view shows so many at 6.3 m from the front camera
PHOTO_VIEW_RAD: Final = 1.4

BOXES: Final = (
    Figure("map50", "Boxes, mAP@0.5", "%", "COCO's measure; pictures of 608 px, looked at as the machine does: halved, "
           "and the wood from nearer.", 0.95, None, 100.0),
    Figure("map50_95", "Boxes, mAP@0.5:0.95", "%", "Mean over ten least overlaps from 0.5 to 0.95.", 0.80, None, 100.0),
    Figure("recall", "Logs found", "%", "With a score of at least 0.5 and an overlap of at least 0.5.", None, None,
           100.0),
    Figure("false_per_picture", "False finds in a picture", "", "With a score of at least 0.5."),
)  # fmt: skip
LOST: Final = (
    Figure("parted.map50", "Boxes, mAP@0.5, were the wood parted right", "%", "All that is called wood, cut up as the "
           "truth cuts it up.", None, None, 100.0),
    Figure("parted.map50_95", "Boxes, mAP@0.5:0.95, were the wood parted right", "%", "The same.", None, None, 100.0),
    Figure("found_large", f"Found of logs that show at least {LARGE_PX} px", "%", "With an overlap of at least 0.5, at "
           "any score.", None, None, 100.0),
    Figure("found_small", "Found of those that show less", "%", "As above.", None, None, 100.0),
)  # fmt: skip
MASKS: Final = (
    Figure("mask_map50", "Masks, mAP@0.5", "%", "As for boxes, with masks.", None, None, 100.0),
    Figure("mask_map50_95", "Masks, mAP@0.5:0.95", "%", "As for boxes, with masks.", None, None, 100.0),
    *(Figure(f"{m}.map50", f"Boxes, mAP@0.5, {m}", "%", "On one machine's pictures.", None, None, 100.0)
      for m in MACHINES),
    *(Figure(f"{n}.{k}", f"Boxes, {t}, {NAMES[n]}", "%", "The same pictures.", None, None, 100.0)
      for n in ("double", "whole", "half", "depth", FAITHFUL)
      for k, t in (("map50", "mAP@0.5"), ("map50_95", "mAP@0.5:0.95"))),
)  # fmt: skip
PHOTOS: Final = (
    Figure("photos", "Photographs", "", "Of TimberSeg's preview sheets; 180 to 500 px wide, without depth."),
    Figure("photos_iou", "Overlap of the wood found with the wood marked, median", "%",
           "All masks of a picture together; the marked wood was derived from coloured overlays.", None, None, 100.0),
)  # fmt: skip
FIGURES: Final = (*BOXES, *LOST, *MASKS, *PHOTOS)
SECTIONS: Final = (
    Section(
        "Logs found on worlds of another kind",
        "Piles that were not trained on, as oval, bumpy, tapered and swept meshes on rough ground with grass and "
        "branches, drawn by pybullet's renderer; the network learnt from round cones drawn by the analytic renderer "
        "alone. Depth has the stereo errors of the plant's cameras. Logs that show less than 100 of the picture's "
        "370 000 pixels do not count. Paper B's figure is of its own photographs: the two are not the same test.",
        BOXES,
        (("precision_recall.png", "Precision and recall, as paper B's Fig. 7"), ("found.png", "Logs found in test "
         "pictures: boxes, masks, scores and ends; a filled dot is an end that is the log's own")),
    ),
    Section(
        "What is lost, and where",
        "Wood is seen nearly everywhere. What fails is to part it: of logs that lie close together the hind ones show "
        "as strips a few pixels wide, and a strip is taken for a part of its neighbour or falls to pieces.",
        LOST,
        (),
    ),
    Section(
        "Masks, machines, variants",
        "The same network judged by its masks and on each machine's cameras, with the whole picture doubled, which "
        "takes three times as long, without any nearer look, with the look at half the size alone, and the "
        "variant that sees depth alone.",
        MASKS,
        (),
    ),
    Section(
        "Real photographs",
        "A look, not a benchmark: a handful of small photographs of TimberSeg 1.0 (Fortin et al. 2022, doi "
        "10.17632/y5npsm3gkj, CC BY 4.0), which have no depth. The network never saw a photograph. They are not part "
        "of the project: without the folder these figures are missing. The sheet `photos.png` is written beside "
        "the result.",
        PHOTOS,
        (),
    ),
)  # fmt: skip


def run(options: Options, console: Console) -> Result:
    """All pictures; writes ``options.out`` and, when asked, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    networks = shipped()
    if "rgbd" not in networks:
        raise CommandFailed(ExitCode.CONFIGURATION, "there are no weights logs_rgbd; make them: timberhand train segmentation")
    try:
        nets = {name: box_finder() if name == FAITHFUL else finder(name) for name in networks}
        facts = {name: net.facts.get("digest", "") for name, net in nets.items()}
    except WeightsRefused as error:
        raise CommandFailed(ExitCode.CONFIGURATION, str(error)) from None
    jobs = [
        Job(f"{machine}-{i}", machine, options.seed, {"number": i, "truth": options.truth, "networks": list(networks)})
        for machine in MACHINES
        for i in range(trials)
    ]
    asked = (facts, options.seed, trials)
    with checkpoint(options, asked, MACHINES, options.truth, ("autonomy/perception", "hil/training")) as kept:
        outcomes = pool.run(perform, jobs, kept, options.workers, "test pictures", console)
        metrics = gather(list(outcomes.values()), networks) | on_photos(finder("half"), options)
        draw(list(outcomes.values()), networks, options)
        result = judged(
            "detector", FIGURES, metrics, profile=", ".join(MACHINES), seed=options.seed, trials=trials,
            more={"truth": options.truth}, paper={"map50": PAPER},
        )  # fmt: skip
        tell(result, "Finding logs in pictures", INTRODUCTION, SECTIONS, options, console)
    return result


def gather(outcomes: list[dict[str, Any]], networks: tuple[str, ...]) -> dict[str, float]:
    """The metrics of all pictures."""
    metrics: dict[str, float] = {}
    for name in networks:
        boxes = [matches(o, name, "boxes") for o in outcomes]
        own = "" if name == "rgbd" else f"{name}."
        metrics[f"{own}map50"], metrics[f"{own}map50_95"] = curve(boxes, 0.5).average, average_precision(boxes)
        if name == FAITHFUL:
            continue
        masks = [matches(o, name, "masks") for o in outcomes]
        metrics[f"{own}mask_map50"] = curve(masks, 0.5).average
        metrics[f"{own}mask_map50_95"] = average_precision(masks)
    metrics |= lost(outcomes)
    for machine in MACHINES:
        boxes = [matches(o, "rgbd", "boxes") for o in outcomes if o["machine"] == machine]
        metrics[f"{machine}.map50"] = curve(boxes, 0.5).average
    whole = curve([matches(o, "rgbd", "boxes") for o in outcomes], 0.5)
    sure = int(np.count_nonzero(whole.scores >= 0.5))
    metrics["recall"] = float(whole.recall[sure - 1]) if sure else 0.0
    wrong = sure * (1.0 - float(whole.precision[sure - 1])) if sure else 0.0
    metrics["false_per_picture"] = wrong / max(1, len(outcomes))
    return metrics


def lost(outcomes: list[dict[str, Any]]) -> dict[str, float]:
    """What perfect parting would give, and how many of the logs that show much and little are found."""
    ideal = [matches(o, PARTED, "boxes") for o in outcomes]
    found, pixels = [], []
    for outcome in outcomes:
        picture = matches(outcome, "rgbd", "boxes")
        found.append(taken(picture, 0.5)[~picture.ignored])
        pixels.append(np.array(outcome["pixels"])[~picture.ignored])
    every, large = np.concatenate(found), np.concatenate(pixels) >= LARGE_PX
    shares = {"found_large": every[large], "found_small": every[~large]}
    return {"parted.map50": curve(ideal, 0.5).average, "parted.map50_95": average_precision(ideal)} | {
        name: float(own.mean()) if len(own) else math.nan for name, own in shares.items()
    }


def draw(outcomes: list[dict[str, Any]], networks: tuple[str, ...], options: Options) -> None:
    """The page's pictures."""
    curves = {NAMES[n]: curve([matches(o, n, "boxes") for o in outcomes], 0.5) for n in networks}
    precision_recall(options.out / "precision_recall.png", curves)
    shown = min(SHOWN, len(outcomes) // len(MACHINES))
    looks = [look(m, i, options.seed, options.truth, "rgbd") for m in MACHINES for i in range(shown)]
    gallery(options.out / "found.png", looks)


def on_photos(net: LogFinder, options: Options) -> dict[str, float]:
    """Figures of the photographs, and their sheet beside the result; empty where there are none."""
    shots = photos.photos(options.data or photos.folder())
    if not shots:
        return {}
    overlaps, images = [], []
    for shot in shots:
        height, width = shot.rgb.shape[:2]
        unknown = np.full((height, width), np.nan, np.float32)
        found = net.find(shot.rgb, unknown, pinhole(width, height, PHOTO_VIEW_RAD))
        wood = np.zeros((height, width), bool)
        for log in found:
            wood |= log.mask
        overlaps.append(photos.overlap(wood, shot.wood))
        images.append(overlaid(shot.rgb, found))
    contact_sheet(options.out / "photos.png", images, 6)
    known = [o for o in overlaps if math.isfinite(o)]
    return {"photos": float(len(shots)), "photos_iou": float(np.median(known)) if known else math.nan}


INTRODUCTION: Final = (
    "Paper B finds logs with YOLOv3 in pictures of 608 x 608 pixels and reports a mean average precision of 80.51 %. "
    "Here one small network (0.49 million parameters) gives masks, centres, axes, edges and ends of logs from colour "
    "and depth, and the boxes follow from the masks. `timberhand experiment detector --docs docs` measures everything "
    "and writes the page; no number is typed."
)
