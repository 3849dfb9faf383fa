"""Training of the segment scorers: which segments are one log, and how well a segment overlaps a log.

The examples come from the maps of the segmentation network on labelled pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from rich.console import Console
from torch.nn import functional as F

from autonomy.networks.graph import Network
from autonomy.networks.torch_net import random_net
from autonomy.perception.segmentation.segment_merging import Scorer, SegmentMerger, over_segment
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, Foreground, Segment
from training.common.loop import Schedule, train

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
        """The examples of several parts."""
        return cls(
            np.concatenate([p.features for p in parts]),
            np.concatenate([p.target for p in parts]),
            np.concatenate([p.weight for p in parts]),
        )


def merge_examples(foreground: Foreground, ids: np.ndarray, rng: np.random.Generator) -> Examples:
    """Pairs of segments and whether they are one log; ``ids`` (h, w): the log of each pixel of the maps, 0 none."""
    segments, found = over_segment(foreground), []
    for round_ in range(ROUNDS):
        merger = SegmentMerger(foreground, segments)
        while round_ and rng.random() > STOP_PROBABILITY:
            owners = [owner(foreground, ids, s)[0] for s in merger.segments]
            same = [(i, j) for i in range(len(owners)) for j in range(i) if owners[i] == owners[j] > 0]
            if not same:
                break
            merger.merge_pair(*sorted(same[rng.integers(len(same))]))
        found.append(_pair_examples(merger, ids, rng))
    return Examples.joined(found)


def _pair_examples(merger: SegmentMerger, ids: np.ndarray, rng: np.random.Generator) -> Examples:
    """At most MAX_PAIRS, so that a few pictures with many segments do not dominate."""
    owners = [owner(merger.foreground, ids, s) for s in merger.segments]
    pairs, features = merger.pairs()
    grain = merger.foreground.grain
    kept, targets, weights = [], [], []
    for k in rng.permutation(len(pairs))[:MAX_PAIRS]:
        i, j = pairs[k]
        if min(owners[i][1], owners[j][1]) >= MIN_PURITY and (owners[i][0] or owners[j][0]):
            kept.append(k)
            targets.append(owners[i][0] == owners[j][0])
            weights.append(np.sqrt(min(len(merger.segments[i].members), len(merger.segments[j].members)) / grain))
    target, weight = np.array(targets, np.float32), np.array(weights, np.float32)
    return Examples(features[kept].reshape(-1, len(PAIR_FEATURES)), target, weight)


def quality_examples(foreground: Foreground, ids: np.ndarray, merge: Scorer) -> Examples:
    """Segments merged with the scorer ``merge``, and their largest overlap (intersection over union) with a log."""
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
    """The log with most of a segment's pixels, and its share of them."""
    count = np.bincount(ids[foreground.y[segment.members], foreground.x[segment.members]])
    return int(count.argmax()), float(count.max() / len(segment.members))


def train_scorer(
    network: Network, examples: Examples, steps: int, seed: int, console: Console
) -> dict[str, np.ndarray]:
    """The arrays of a scorer, trained with the cross entropy to the targets, which may be fractions."""
    net = random_net(network, seed)
    features = torch.from_numpy(examples.features.T[None, :, None].copy())
    target = torch.from_numpy(examples.target)
    weight = torch.from_numpy(examples.weight / examples.weight.mean())

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        some = torch.from_numpy(np.random.default_rng([seed, step]).integers(0, len(target), BATCH))
        return features[..., some], target[some], weight[some]

    def loss(net: torch.nn.Module, features: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        logit = net(features)["logit"].reshape(-1)
        return (F.binary_cross_entropy_with_logits(logit, target, reduction="none") * weight).mean()

    schedule = Schedule(steps, 1e-2, weight_decay=1e-3)
    train(net, batch, loss, schedule, None, f"{network.name}, seed {seed}", network.name, console)
    return net.eval().arrays()
