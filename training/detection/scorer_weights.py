"""The weight files of the judges of regions, from drawn pictures that the network which finds logs has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from autonomy.networks.graph import Network
from autonomy.perception.segmentation.instances import foreground_of
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.segment_merging import (
    HIDDEN,
    MERGE_NETWORK,
    QUALITY_NETWORK,
    ScoringNetwork,
    SegmentScorers,
)
from autonomy.perception.segmentation.segments import Foreground
from training.common.model_card import Card, write
from training.detection.segment_scorers import Examples, learn, relations, worths
from training.pictures.labels import IGNORED
from training.pictures.shards import SHARD, pictures, shard

SIZE_PX: Final = 608
FIRST_SHARD: Final = 40  # no other training takes pictures of SIZE_PX from here
STEPS: Final = 6000
NOBODY: Final = SegmentScorers(
    *(ScoringNetwork(np.zeros((HIDDEN, n.channels)), np.zeros(HIDDEN), np.zeros(HIDDEN), 0.0) for n in (MERGE_NETWORK, QUALITY_NETWORK))
)
"""Judges of a finder whose maps alone are wanted: the files need not be there."""
HELD: Final = 9  # every so manieth picture is for the card's figures
DOES: Final = {
    "joins": "Two pieces of a picture's foreground in (19 numbers), the chance that they are one log out.",
    "worth": "A region in (14 numbers), its overlap with the log that it is most likely to be out.",
}


@dataclass(frozen=True, slots=True)
class Pictures:
    """Scenes by the shipped network, with the logs (h, w) of the maps' pixels."""

    learnt: list[tuple[Foreground, np.ndarray]]
    held: list[tuple[Foreground, np.ndarray]]


def produce(count: int, seed: int, folder: Path, out: Path, weights: Path | None, console: Console) -> Path:
    """Draw ``count`` pictures into ``folder`` where they are missing, look at them with the network of ``weights``
    (None: the shipped one), and write both judges and their cards into ``out``.  Returns the last card's path.

    Raises:
        WeightsRefused: the network's weights are missing or damaged.
    """
    seen = looked_at(count, folder, weights, console)
    rng = np.random.default_rng(seed)
    pairs = [[relations(s, ids, rng) for s, ids in part] for part in (seen.learnt, seen.held)]
    joins = _ship(MERGE_NETWORK, *map(Examples.joined, pairs), count, seed, out, console)
    overlaps = [[worths(s, ids, ScoringNetwork.of(joins)) for s, ids in part] for part in (seen.learnt, seen.held)]
    _ship(QUALITY_NETWORK, *map(Examples.joined, overlaps), count, seed, out, console)
    return out / f"{QUALITY_NETWORK.name}.md"


def looked_at(count: int, folder: Path, weights: Path | None, console: Console) -> Pictures:
    """Scenes of ``count`` pictures, every other one looked at doubled."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    finders = [LogSegmenter("rgbd", weights, size, judges=NOBODY) for size in (2 * SIZE_PX, SIZE_PX)]
    source, found = pictures(folder, SIZE_PX), []
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("drawing pictures", total=count)
        for number in range(-(-count // SHARD)):
            shard(folder, FIRST_SHARD + number, SIZE_PX, lambda: progress.advance(task))
        progress.reset(task, description="looking at them")
        for index in range(count):
            sample = source(FIRST_SHARD * SHARD + index)
            maps, scale = finders[index % 2].multi_scale_maps(sample.rgb, sample.depth_m, sample.intrinsics)
            ids = sample.ids[scale // 2 :: scale, scale // 2 :: scale][: maps.shape[1], : maps.shape[2]]
            shape = (maps.shape[1] - ids.shape[0], maps.shape[2] - ids.shape[1])
            ids = np.pad(np.where(ids == IGNORED, 0, ids), ((0, shape[0]), (0, shape[1])))
            found.append((foreground_of(maps, scale, sample.depth_m), ids))
            progress.advance(task)
    held = [i % HELD == 0 and count > 1 for i in range(count)]
    return Pictures([s for s, h in zip(found, held, strict=True) if not h],
                    [s for s, h in zip(found, held, strict=True) if h])  # fmt: skip


def _ship(
    network: Network, learnt: Examples, held: Examples, count: int, seed: int, out: Path, console: Console
) -> dict[str, np.ndarray]:
    arrays = learn(network, learnt, STEPS, seed, console)
    head = ScoringNetwork.of(arrays)
    card = Card(
        f"Judge of regions: {network.name}",
        DOES[network.name],
        f"{len(learnt.answer)} examples from {count} pictures drawn by the analytic renderer (training), as the "
        "network of logs_rgbd sees them; nothing photographed",
        f"{STEPS} steps, AdamW with 0.01 and a cosine",
        seed,
        {
            "cross entropy where it learnt": f"{entropy(head, learnt):.4f}",
            "cross entropy on pictures kept apart": f"{entropy(head, held):.4f}",
            "right at a half, on pictures kept apart": f"{right(head, held):.3f}",
        },
        "maps of another network than the one it learnt with: train it again after that one.",
        f"timberhand train judges --pictures {count} --seed {seed}",
    )
    write(out / f"{network.name}.safetensors", network, arrays, card, {})
    return arrays


def entropy(head: ScoringNetwork, examples: Examples) -> float:
    """Weighed mean cross entropy of what a judge says with the answers."""
    chance = np.clip(head.chance(examples.told), 1e-6, 1.0 - 1e-6)
    each = -examples.answer * np.log(chance) - (1.0 - examples.answer) * np.log(1.0 - chance)
    return float(np.average(each, weights=examples.weight))


def right(head: ScoringNetwork, examples: Examples) -> float:
    """Weighed share of examples where a judge is on the answer's side of a half."""
    return float(np.average((head.chance(examples.told) > 0.5) == (examples.answer > 0.5), weights=examples.weight))
