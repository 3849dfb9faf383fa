"""Training of the judges of regions: what pieces are one log, and what overlap with a log a region has.

Examples come from the maps of the network that finds logs, on pictures whose truth is known.
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
from autonomy.perception.segmentation.segment_merging import ScoringNetwork, SegmentMerger, cut
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, Foreground, Segment
from training.common.loop import Schedule, train

ROUNDS: Final = 3  # of a picture: all its pieces, and twice with some of them put together
STOP: Final = 0.25  # chance that no more are put together
LEAST_PURE: Final = 0.7  # of a piece's pixels that are one log's, of a piece that teaches
MOST: Final = 40  # pairs of a picture and round
BATCH: Final = 2048


@dataclass(frozen=True, slots=True)
class Examples:
    """Numbers (N, inputs), what a judge should say (N,), and how much each counts (N,)."""

    told: np.ndarray
    answer: np.ndarray
    weight: np.ndarray

    @classmethod
    def joined(cls, parts: list[Examples]) -> Examples:
        """All of several."""
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("told", "answer", "weight")))


def relations(scene: Foreground, ids: np.ndarray, rng: np.random.Generator) -> Examples:
    """Pairs of pieces and whether they are one log; ``ids`` (h, w) are the maps' pixels' logs, 0 none."""
    pieces, found = cut(scene), []
    for round_ in range(ROUNDS):
        joining = SegmentMerger(scene, pieces)
        while round_ and rng.random() > STOP:
            owners = [owner(scene, ids, p)[0] for p in joining.pieces]
            same = [(i, j) for i in range(len(owners)) for j in range(i) if owners[i] == owners[j] > 0]
            if not same:
                break
            joining.merge(*sorted(same[rng.integers(len(same))]))
        found.append(_pairs(joining, ids, rng))
    return Examples.joined(found)


def _pairs(joining: SegmentMerger, ids: np.ndarray, rng: np.random.Generator) -> Examples:
    """At most MOST of them, lest a few pictures that are all pieces teach alone."""
    own = [owner(joining.scene, ids, p) for p in joining.pieces]
    pairs, told = joining.pairs()
    grain = joining.scene.grain
    kept, answers, weights = [], [], []
    for k in rng.permutation(len(pairs))[:MOST]:
        i, j = pairs[k]
        if min(own[i][1], own[j][1]) >= LEAST_PURE and (own[i][0] or own[j][0]):
            kept.append(k)
            answers.append(own[i][0] == own[j][0])
            weights.append(np.sqrt(min(len(joining.pieces[i].own), len(joining.pieces[j].own)) / grain))
    answer, weight = np.array(answers, np.float32), np.array(weights, np.float32)
    return Examples(told[kept].reshape(-1, len(PAIR_FEATURES)), answer, weight)


def worths(scene: Foreground, ids: np.ndarray, joins: ScoringNetwork) -> Examples:
    """Regions as ``joins`` makes them, and their greatest overlap with a log."""
    joining = SegmentMerger(scene, cut(scene))
    joining.join(joins)
    sizes = np.bincount(ids.ravel(), minlength=256)
    answers = []
    for p in joining.pieces:
        shared = np.bincount(ids[scene.y[p.own], scene.x[p.own]], minlength=256)
        shared[0] = 0
        answers.append(float((shared / np.maximum(sizes + len(p.own) - shared, 1)).max()))
    told = joining.looks(joins)
    return Examples(told.reshape(-1, len(SEGMENT_FEATURES)), np.array(answers, np.float32), np.ones(len(told), np.float32))


def owner(scene: Foreground, ids: np.ndarray, piece: Segment) -> tuple[int, float]:
    """Whose most of a piece's pixels are, and which share of them."""
    count = np.bincount(ids[scene.y[piece.own], scene.x[piece.own]])
    return int(count.argmax()), float(count.max() / len(piece.own))


def learn(network: Network, examples: Examples, steps: int, seed: int, console: Console) -> dict[str, np.ndarray]:
    """Arrays of a judge that has learnt from examples: cross entropy with the answers, which may be shares."""
    net = random_net(network, seed)
    told = torch.from_numpy(examples.told.T[None, :, None].copy())
    answer = torch.from_numpy(examples.answer)
    weight = torch.from_numpy(examples.weight / examples.weight.mean())

    def batch(step: int) -> tuple[torch.Tensor, ...]:
        some = torch.from_numpy(np.random.default_rng([seed, step]).integers(0, len(answer), BATCH))
        return told[..., some], answer[some], weight[some]

    def loss(net: torch.nn.Module, told: torch.Tensor, answer: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        logit = net(told)["logit"].reshape(-1)
        return (F.binary_cross_entropy_with_logits(logit, answer, reduction="none") * weight).mean()

    schedule = Schedule(steps, 1e-2, weight_decay=1e-3)
    train(net, batch, loss, schedule, None, f"{network.name}, seed {seed}", network.name, console)
    return net.eval().arrays()
