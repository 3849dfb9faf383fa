"""The weight files of the segment scorers, from drawn pictures that the segmentation network was not trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console
from torch.nn import functional as F

from autonomy.networks import Interface
from autonomy.perception.segmentation.instances import foreground_of
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.segmentation.segment_merging import (
    HIDDEN_UNITS,
    MERGE_NETWORK,
    QUALITY_NETWORK,
    Scorer,
    SegmentMerger,
    SegmentScorers,
    over_segment,
)
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, Foreground, Segment
from training.common.loop import Schedule, progress_bar, seeded, train
from training.common.weight_file import Card, write
from training.detection.networks import scoring_network
from training.pictures.labels import IGNORED
from training.pictures.shards import SHARD, pictures, shard

# -- Training of the segment scorers: which segments are one log, and how well a segment overlaps a log.
#
# The examples come from the maps of the segmentation network on labelled pictures.


ROUNDS: Final = 3  # for each picture: once with all its segments, and twice with some of them merged
STOP_PROBABILITY: Final = 0.25  # that merging stops after each merge
MIN_PURITY: Final = 0.7  # share of a segment's pixels in one log, of a segment that is used
MAX_PAIRS: Final = 40  # of one picture and round
BATCH: Final = 2048


@dataclass(frozen=True, slots=True)
class Examples:
    """Features (N, inputs), the target of the scorer (N,), and the weight of each example (N,)."""

    features: np.ndarray
    target: np.ndarray
    weight: np.ndarray

    @classmethod
    def joined(cls, parts: list[Examples]) -> Examples:
        """Join the examples of several parts."""
        return cls(
            np.concatenate([p.features for p in parts]),
            np.concatenate([p.target for p in parts]),
            np.concatenate([p.weight for p in parts]),
        )


def merge_examples(foreground: Foreground, ids: np.ndarray, rng: np.random.Generator) -> Examples:
    """Collect pairs of segments and whether they are one log; ``ids`` (h, w): the log of each pixel of the maps, 0
    none."""
    segments, round_examples = over_segment(foreground), []
    for round_ in range(ROUNDS):
        merger = SegmentMerger(foreground, segments)
        while round_ and rng.random() > STOP_PROBABILITY:
            owners = [owner(foreground, ids, s)[0] for s in merger.segments]
            same_log_pairs = [(i, j) for i in range(len(owners)) for j in range(i) if owners[i] == owners[j] > 0]
            if not same_log_pairs:
                break
            merger.merge_pair(*sorted(same_log_pairs[rng.integers(len(same_log_pairs))]))
        round_examples.append(_pair_examples(merger, ids, rng))
    return Examples.joined(round_examples)


def _pair_examples(merger: SegmentMerger, ids: np.ndarray, rng: np.random.Generator) -> Examples:
    """Draw at most MAX_PAIRS, so that a few pictures with many segments do not dominate."""
    owners = [owner(merger.foreground, ids, s) for s in merger.segments]
    pairs, features = merger.pairs()
    grain = merger.foreground.grain
    pair_indices, targets, weights = [], [], []
    for k in rng.permutation(len(pairs))[:MAX_PAIRS]:
        i, j = pairs[k]
        if min(owners[i][1], owners[j][1]) >= MIN_PURITY and (owners[i][0] or owners[j][0]):
            pair_indices.append(k)
            targets.append(owners[i][0] == owners[j][0])
            weights.append(np.sqrt(min(len(merger.segments[i].members), len(merger.segments[j].members)) / grain))
    target, weight = np.array(targets, np.float32), np.array(weights, np.float32)
    return Examples(features[pair_indices].reshape(-1, len(PAIR_FEATURES)), target, weight)


def quality_examples(foreground: Foreground, ids: np.ndarray, merge: Scorer) -> Examples:
    """Collect segments merged with the scorer ``merge``, and their largest overlap (intersection over union) with a
    log."""
    merger = SegmentMerger(foreground, over_segment(foreground))
    merger.merge_all(merge)
    sizes = np.bincount(ids.ravel(), minlength=256)
    targets = []
    for s in merger.segments:
        shared = np.bincount(ids[foreground.y[s.members], foreground.x[s.members]], minlength=256)
        shared[0] = 0
        targets.append(float((shared / np.maximum(sizes + len(s.members) - shared, 1)).max()))
    features = merger.features(merge).reshape(-1, len(SEGMENT_FEATURES))
    return Examples(features, np.array(targets, np.float32), np.ones(len(features), np.float32))


def owner(foreground: Foreground, ids: np.ndarray, segment: Segment) -> tuple[int, float]:
    """Find the log with most of a segment's pixels, and its share of them."""
    count = np.bincount(ids[foreground.y[segment.members], foreground.x[segment.members]])
    return int(count.argmax()), float(count.max() / len(segment.members))


def train_scorer(network: Interface, examples: Examples, steps: int, seed: int, console: Console) -> torch.nn.Module:
    """Train a scoring network with the cross entropy to the targets, which may be fractions."""
    net = seeded(lambda: scoring_network(network.channels), seed)
    features = torch.from_numpy(examples.features.T[None, :, None].copy())
    target = torch.from_numpy(examples.target)
    weight = torch.from_numpy(examples.weight / examples.weight.mean())

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        example_indices = torch.from_numpy(np.random.default_rng([seed, step]).integers(0, len(target), BATCH))
        return features[..., example_indices], target[example_indices], weight[example_indices]

    def loss(net: torch.nn.Module, features: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        logit = net(features).reshape(-1)
        return (F.binary_cross_entropy_with_logits(logit, target, reduction="none") * weight).mean()

    schedule = Schedule(steps, 1e-2, weight_decay=1e-3)
    train(net, batch, loss, schedule, None, f"{network.name}, seed {seed}", network.name, console)
    return net.eval()


# -- The weight files of the segment scorers, from drawn pictures that the segmentation network was not trained on


SIZE_PX: Final = 608
FIRST_SHARD: Final = 40  # no other training uses pictures of SIZE_PX from here on
STEPS: Final = 6000
HELD_OUT_EVERY: Final = 9  # one of so many pictures is held out for the figures of the card
DESCRIPTIONS: Final = {
    MERGE_NETWORK.name: "Two segments of a picture's foreground in (19 features), the probability that they are one "
    "log out.",
    QUALITY_NETWORK.name: "A segment in (14 features), its overlap with a log out.",
}


def _zero_scorer(network: Interface) -> Scorer:
    return Scorer(np.zeros((HIDDEN_UNITS, network.channels)), np.zeros(HIDDEN_UNITS), np.zeros(HIDDEN_UNITS), 0.0)


ZERO_SCORERS: Final = SegmentScorers(_zero_scorer(MERGE_NETWORK), _zero_scorer(QUALITY_NETWORK))
"""For a segmenter of which only the maps are used; the weight files need not exist."""


@dataclass(frozen=True, slots=True)
class LabelledForegrounds:
    """Foregrounds by the segmentation network, each with the log of every pixel of the maps (h, w)."""

    training: list[tuple[Foreground, np.ndarray]]
    held_out: list[tuple[Foreground, np.ndarray]]


def produce(count: int, seed: int, folder: Path, out: Path, weights: Path | None, console: Console) -> Path:
    """Train both scorers on ``count`` pictures and write their weights and cards into ``out``.

    Pictures that ``folder`` lacks are drawn first.  ``weights`` are those of the segmentation network; None selects the
    shipped ones.  Return the path of the last card.

    Raises:
        InputRefused: the network's weights are missing or damaged.
    """
    foregrounds = labelled_foregrounds(count, folder, weights, console)
    rng = np.random.default_rng(seed)
    training, held_out = (
        Examples.joined([merge_examples(f, ids, rng) for f, ids in part])
        for part in (foregrounds.training, foregrounds.held_out)
    )
    merge = _ship(MERGE_NETWORK, training, held_out, count, seed, out, console)
    training, held_out = (
        Examples.joined([quality_examples(f, ids, merge) for f, ids in part])
        for part in (foregrounds.training, foregrounds.held_out)
    )
    _ship(QUALITY_NETWORK, training, held_out, count, seed, out, console)
    return out / f"{QUALITY_NETWORK.name}.md"


def labelled_foregrounds(count: int, folder: Path, weights: Path | None, console: Console) -> LabelledForegrounds:
    """Compute the foregrounds of ``count`` pictures; every other picture is doubled before."""
    segmenters = [LogSegmenter("rgbd", weights, size, scorers=ZERO_SCORERS) for size in (2 * SIZE_PX, SIZE_PX)]
    source, foregrounds = pictures(folder, SIZE_PX), []
    with progress_bar(console) as progress:
        task = progress.add_task("drawing pictures", total=count)
        for number in range(-(-count // SHARD)):
            shard(folder, FIRST_SHARD + number, SIZE_PX, lambda: progress.advance(task))
        progress.reset(task, description="segmenting them")
        for index in range(count):
            sample = source(FIRST_SHARD * SHARD + index)
            maps, scale = segmenters[index % 2].multi_scale_maps(sample.rgb, sample.depth_m, sample.intrinsics)
            ids = sample.ids[scale // 2 :: scale, scale // 2 :: scale][: maps.shape[1], : maps.shape[2]]
            missing = (maps.shape[1] - ids.shape[0], maps.shape[2] - ids.shape[1])
            ids = np.pad(np.where(ids == IGNORED, 0, ids), ((0, missing[0]), (0, missing[1])))
            foregrounds.append((foreground_of(maps, scale, sample.depth_m), ids))
            progress.advance(task)
    held_out = [i % HELD_OUT_EVERY == 0 and count > 1 for i in range(count)]
    return LabelledForegrounds(
        [s for s, h in zip(foregrounds, held_out, strict=True) if not h],
        [s for s, h in zip(foregrounds, held_out, strict=True) if h],
    )


def _ship(
    network: Interface, training: Examples, held_out: Examples, count: int, seed: int, out: Path, console: Console
) -> Scorer:
    net = train_scorer(network, training, STEPS, seed, console)
    scorer = Scorer.of({name: values.numpy() for name, values in net.state_dict().items()})
    card = Card(
        f"Scorer of segments: {network.name}",
        DESCRIPTIONS[network.name],
        f"{len(training.target)} examples from {count} pictures drawn by the analytic renderer (training), as "
        "segmented by the network of logs_rgbd; no photographs",
        f"{STEPS} steps, AdamW with 0.01 and a cosine",
        seed,
        {
            "cross entropy on the training pictures": f"{cross_entropy(scorer, training):.4f}",
            "cross entropy on held-out pictures": f"{cross_entropy(scorer, held_out):.4f}",
            "accuracy at a threshold of 0.5 on held-out pictures": f"{accuracy(scorer, held_out):.3f}",
        },
        "maps of any other network: train it again after that network.",
        f"timberhand train scorers --pictures {count} --seed {seed}",
    )
    write(out / f"{network.name}.onnx", net, network, card, {})
    return scorer


def cross_entropy(scorer: Scorer, examples: Examples) -> float:
    """Compute the weighted mean cross entropy between the scorer's probabilities and the targets."""
    probability = np.clip(scorer.probability(examples.features), 1e-6, 1.0 - 1e-6)
    each = -examples.target * np.log(probability) - (1.0 - examples.target) * np.log(1.0 - probability)
    return float(np.average(each, weights=examples.weight))


def accuracy(scorer: Scorer, examples: Examples) -> float:
    """Compute the weighted share of examples for which scorer and target are on the same side of 0.5."""
    agrees = (scorer.probability(examples.features) > 0.5) == (examples.target > 0.5)
    return float(np.average(agrees, weights=examples.weight))
