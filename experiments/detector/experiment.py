"""The detector experiment: does the network find logs in worlds unlike those of the training?  Paper B 3.2.2, Fig.
7."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from rich.console import Console

from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import checkpoint
from experiments.detector import photos
from experiments.detector.metrics import CONCLUSION, INTRODUCTION, LARGE_PX, METRICS, NAMES, PAPER, SECTIONS
from experiments.detector.plots import contact_sheet, gallery, overlaid, precision_recall
from experiments.detector.trial import FAITHFUL, PARTED, box_finder, example, finder, matches, perform, shipped
from host.exit_codes import CommandFailed, ExitCode
from machine.geometry.optics import pinhole
from runtime.errors import InputRefused
from training.common.average_precision import average_precision, curve, matched_truths
from training.pictures.piles import MACHINES

TRIALS: Final = 120
"""Pictures of each machine."""
QUICK_TRIALS: Final = 8
SHOWN_COUNT: Final = 6
"""Pictures of each machine on the page."""
PHOTO_VIEW_RAD: Final = 1.4


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    networks = shipped()
    if "rgbd" not in networks:
        raise CommandFailed(
            "detector.no-weights",
            "there are no weights logs_rgbd; make them: timberhand train segmentation",
            ExitCode.CONFIGURATION,
        )
    try:
        nets = {name: box_finder() if name == FAITHFUL else finder(name) for name in networks}
        facts = {name: net.facts.get("digest", "") for name, net in nets.items()}
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    jobs = [
        Job(f"{machine}-{i}", machine, options.seed, {"number": i, "truth": options.truth, "networks": list(networks)})
        for machine in MACHINES
        for i in range(trials)
    ]
    with checkpoint(options, facts, MACHINES, options.truth, ("autonomy/perception", "training")) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "test pictures", console)
        metrics = gather(list(outcomes.values()), networks) | on_photos(finder("half"), options)
        draw_plots(list(outcomes.values()), networks, options)
        result = make_result(
            "detector",
            METRICS,
            metrics,
            profile=", ".join(MACHINES),
            seed=options.seed,
            trials=trials,
            more={"truth": options.truth},
            paper=PAPER,
        )
        publish(result, page_of(result, {}), options, console)
    return result


def gather(outcomes: list[dict[str, Any]], networks: tuple[str, ...]) -> dict[str, float]:
    """Compute the metrics of all pictures."""
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
    """Compute average precision with perfectly separated logs, and shares found of logs with many and few pixels."""
    ideal = [matches(o, PARTED, "boxes") for o in outcomes]
    detected, pixels = [], []
    for outcome in outcomes:
        picture = matches(outcome, "rgbd", "boxes")
        detected.append(matched_truths(picture, 0.5)[~picture.ignored])
        pixels.append(np.array(outcome["pixels"])[~picture.ignored])
    every, large = np.concatenate(detected), np.concatenate(pixels) >= LARGE_PX
    shares = {"found_large": every[large], "found_small": every[~large]}
    return {"parted.map50": curve(ideal, 0.5).average, "parted.map50_95": average_precision(ideal)} | {
        name: float(own.mean()) if len(own) else math.nan for name, own in shares.items()
    }


def draw_plots(outcomes: list[dict[str, Any]], networks: tuple[str, ...], options: Options) -> None:
    """Write the plots of the page."""
    curves = {NAMES[n]: curve([matches(o, n, "boxes") for o in outcomes], 0.5) for n in networks}
    precision_recall(options.out / "precision_recall.png", curves)
    shown = min(SHOWN_COUNT, len(outcomes) // len(MACHINES))
    examples = [example(m, i, options.seed, options.truth, "rgbd") for m in MACHINES for i in range(shown)]
    gallery(options.out / "found.png", examples)


def on_photos(net: LogSegmenter, options: Options) -> dict[str, float]:
    """Compute the metrics of the photographs; writes their sheet beside the result.  Empty without photographs."""
    shots = photos.photos(options.data or photos.folder())
    if not shots:
        return {}
    overlaps, images = [], []
    for shot in shots:
        height, width = shot.rgb.shape[:2]
        unknown = np.full((height, width), np.nan, np.float32)
        instances = net.segment_picture(shot.rgb, unknown, pinhole(width, height, PHOTO_VIEW_RAD))
        wood = np.zeros((height, width), bool)
        for log in instances:
            wood |= log.mask
        overlaps.append(photos.overlap(wood, shot.wood))
        images.append(overlaid(shot.rgb, instances))
    contact_sheet(options.out / "photos.png", images, 6)
    known = [o for o in overlaps if math.isfinite(o)]
    return {"photos": float(len(shots)), "photos_iou": float(np.median(known)) if known else math.nan}


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Log detection", CONCLUSION, INTRODUCTION, SECTIONS)
