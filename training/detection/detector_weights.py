"""The weight files of the log detectors: trained on drawn pictures, tested on drawn pictures of held-out piles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console

from autonomy.networks import load
from autonomy.perception.papers import BOXES
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.network import CHANNELS, interface_of
from runtime.errors import InputRefused
from training.common.average_precision import Matches, average_precision, box_overlaps, curve, mask_overlaps
from training.common.loop import Schedule, progress_bar
from training.common.weight_file import Card, write
from training.detection import boxes
from training.detection.networks import UNet
from training.detection.segmentation import CROPS, run
from training.pictures import shards
from training.pictures.labels import ID, Labelled
from training.pictures.piles import HELD_OUT
from training.pictures.shards import pictures, shard

BATCH: Final = 16
LEARNING_RATE: Final = 3e-3
SMALL_PX, LARGE_PX, FIRST_LARGE = 304, 608, 10_000  # sizes of pictures, and the number of the first shard of large ones
TEST_PICTURES: Final = 128  # of held-out piles
LIMITS: Final = {
    "rgbd": "Its colours are drawn: on photographs it is a sketch.",
    "depth": "Photographs, which have no depth.",
}
MIN_LOG_PX: Final = 30  # of a log that counts in the figures of the card


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of a training: pictures, steps, seed, learning rate, initial weights (None: random)."""

    count: int
    steps: int
    seed: int
    learning_rate: float = LEARNING_RATE
    start: Path | None = None
    large: int = 0
    """Pictures of twice the size, which show bark from close up; if there are any, half of the windows are theirs."""

    def schedule_text(self, crops_px: str) -> str:
        """Describe the schedule for the card."""
        begin = f", begun with {self.start.name}" if self.start else ""
        return (
            f"{self.steps} steps of up to {BATCH} windows of {crops_px} px, AdamW with {self.learning_rate} and a "
            f"cosine, products in bf16{begin}"
        )

    def command(self, what: str, out: Path) -> str:
        """Return the command that reproduces the weights."""
        start = f" --start {self.start.name}" if self.start else ""
        return (
            f"timberhand train {what} --pictures {self.count}{f' --large {self.large}' if self.large else ''} "
            f"--steps {self.steps} --seed {self.seed} --learning-rate {self.learning_rate}{start} --out {out.name}"
        )


def produce(variant: str, plan: Plan, folder: Path, out: Path, console: Console) -> Path:
    """Train on the pictures of ``folder`` and write weights and card; an interrupted run continues.

    Missing pictures are drawn first.  Return the path of the card.

    Raises:
        InputRefused: the initial weights are missing, damaged or of another network.
    """
    start = initial_arrays(plan.start, variant) if plan.start else None
    source = small_pictures(folder, plan.count, console)
    training_source, count = source, plan.count
    if plan.large:
        training_source, count = mixed_pictures(source, plan, folder, console), 2 * plan.count
    schedule = Schedule(plan.steps, plan.learning_rate, bf16=True)
    checkpoint = out.with_suffix(".checkpoint")
    net, losses = run(training_source, count, variant, schedule, BATCH, plan.seed, checkpoint, console, start)
    return ship(variant, net, losses, plan, source, out)


def initial_arrays(weights: Path, variant: str) -> dict[str, np.ndarray]:
    """Read the arrays of a weight file for the start: one of the same variant, or for ``depth`` one of ``rgbd`` without
    the colour channels.

    Raises:
        InputRefused: as ``load``.
    """
    try:
        return load(weights, interface_of(variant)).arrays()
    except InputRefused:
        if variant != "depth":
            raise
    arrays = load(weights, interface_of("rgbd")).arrays()
    return arrays | {"in2.0.weight": arrays["in2.0.weight"][:, -CHANNELS[variant] :]}


def produce_boxes(plan: Plan, folder: Path, out: Path, console: Console) -> Path:
    """Train the box detector in the role of paper B's in the same way.  Return the path of the card.

    Raises:
        InputRefused: as ``produce``.
    """
    start = load(plan.start, BOXES).arrays() if plan.start else None
    source = small_pictures(folder, plan.count, console)
    schedule = Schedule(plan.steps, plan.learning_rate, bf16=True)
    checkpoint = out.with_suffix(".checkpoint")
    sources = [(source, plan.count)]
    if plan.large:
        sources.append((large_pictures(plan, folder, console), plan.large))
    net, losses = boxes.run(sources, schedule, BATCH, plan.seed, checkpoint, console, start)
    card = Card(
        "Boxes of logs in colour pictures",
        "Letterboxed colour picture of 608 x 608 px in, boxes of logs out: the role of paper B's YOLOv3 (3.2.2).",
        f"{plan.count + plan.large} pictures drawn by the analytic renderer of settled piles (training); nothing "
        "photographed",
        plan.schedule_text(" and ".join(str(crop) for (crop, _), _ in zip(boxes.CROPS, sources, strict=False))),
        plan.seed,
        {"loss, mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}"},
        "photographs: its colours are drawn. How it does on worlds that are drawn otherwise is in docs/detector.md.",
        plan.command("detector", out),
    )
    return write(out, net, BOXES, card, {})


def small_pictures(folder: Path, count: int, console: Console) -> Callable[[int], Labelled]:
    """Provide the small pictures by number; draw missing ones of the first ``count`` and of the held-out ones."""
    _draw_missing(folder, [*range(-(-count // shards.SHARD)), HELD_OUT], SMALL_PX, console)
    return pictures(folder)


def mixed_pictures(
    small: Callable[[int], Labelled], plan: Plan, folder: Path, console: Console
) -> Callable[[int], Labelled]:
    """Provide small and large pictures alternately; draw missing large ones."""
    large = large_pictures(plan, folder, console)
    return lambda i: large(i // 2 % plan.large) if i % 2 else small(i // 2)


def large_pictures(plan: Plan, folder: Path, console: Console) -> Callable[[int], Labelled]:
    """Provide the large pictures of a plan by number; draw missing ones."""
    _draw_missing(folder, range(FIRST_LARGE, FIRST_LARGE - (-plan.large // shards.SHARD)), LARGE_PX, console)
    source, first_index = pictures(folder, LARGE_PX), FIRST_LARGE * shards.SHARD
    return lambda i: source(first_index + i)


def _draw_missing(folder: Path, numbers: Sequence[int], size_px: int, console: Console) -> None:
    with progress_bar(console) as progress:
        task = progress.add_task("drawing pictures", total=shards.SHARD * len(numbers))
        for done, number in enumerate(numbers, 1):
            shard(folder, number, size_px, tick=lambda: progress.advance(task))
            progress.update(task, completed=done * shards.SHARD)


def ship(
    variant: str,
    net: UNet,
    losses: list[float],
    plan: Plan,
    source: Callable[[int], Labelled],
    out: Path,
) -> Path:
    """Write trained weights with their card; return the card's path."""
    card = Card(
        f"Logs in pictures, from {'colour and depth' if variant == 'rgbd' else 'depth alone'}",
        "Picture in, eight maps out, from which logs are decoded: mask, centre, offset to it, angle, ends, edges.",
        f"{plan.count} pictures drawn by the analytic renderer of settled piles (training); nothing photographed",
        plan.schedule_text(" and ".join(str(crop) for crop, _ in CROPS)),
        plan.seed,
        {"loss, mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}"},
        f"wood that is no log on the ground: standing trees, stumps, planks. {LIMITS[variant]} What it does on worlds "
        "that are drawn otherwise is in docs/detector.md.",
        plan.command(f"segmentation --variant {variant}", out),
    )
    write(out, net, interface_of(variant), card, {})
    figures = test_metrics(LogSegmenter(variant, out), source)
    return write(out, net, interface_of(variant), replace(card, metrics={**card.metrics, **figures}), {})


def test_metrics(segmenter: LogSegmenter, source: Callable[[int], Labelled]) -> dict[str, str]:
    """Compute the average precision on drawn pictures of held-out piles, as text."""
    by_masks, by_boxes = [], []
    for index in range(HELD_OUT * shards.SHARD, HELD_OUT * shards.SHARD + TEST_PICTURES):
        by_mask, by_box = matches(segmenter, source(index))
        by_masks.append(by_mask)
        by_boxes.append(by_box)
    figures = {}
    for name, picture_matches in (("boxes", by_boxes), ("masks", by_masks)):
        figures[f"{name}, mAP@0.5 on {TEST_PICTURES} pictures of held-out piles"] = (
            f"{curve(picture_matches, 0.5).average:.3f}"
        )
        figures[f"{name}, mAP@0.5:0.95 on them"] = f"{average_precision(picture_matches):.3f}"
    return figures


def matches(segmenter: LogSegmenter, sample: Labelled) -> tuple[Matches, Matches]:
    """Compare detections in a picture with its ground truth, by masks and by boxes."""
    detections = segmenter.segment_picture(sample.rgb, sample.depth_m, sample.intrinsics)
    truth = [sample.ids == log[ID] for log in sample.logs]
    is_small = np.array([t.sum() < MIN_LOG_PX for t in truth], bool)
    scores = np.array([i.score for i in detections])
    by_box = box_overlaps(np.array([i.box_px for i in detections]), np.array([box_of(t) for t in truth]))
    return (
        Matches(scores, mask_overlaps([i.mask for i in detections], truth), is_small),
        Matches(scores, by_box, is_small),
    )


def box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of a non-empty mask, the last two exclusive."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
