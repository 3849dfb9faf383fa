"""Regions: the foreground parted into pieces, and the pieces of one log put together again, the likeliest pair first.

What is one log, and how good a region is, two small networks judge that learnt it from drawn pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.networks.graph import Conv, Network, Relu
from autonomy.networks.weights import SHIPPED, load
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES, SegmentTable, may_merge, relations
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, Foreground, Segment, look, piece
from autonomy.perception.segmentation.watershed import sigmoid, watershed

LEAST_PX: Final = 6  # of a map: what is smaller is no log
MOST: Final = 100  # pieces of a picture, the largest: what has more is noise
HIDDEN: Final = 24
LEAST_CHANCE: Final = 0.5  # that two pieces are one log


def head(name: str, inputs: int) -> Network:
    """A judge: ``inputs`` numbers in, the logit of a chance out, as a picture's channels."""
    return Network(name, inputs, (Conv("first", HIDDEN, 1), Relu("bent"), Conv("logit", 1, 1)), ("logit",))


MERGE_NETWORK: Final = head("joins", len(PAIR_FEATURES))
QUALITY_NETWORK: Final = head("worth", len(SEGMENT_FEATURES))


@dataclass(frozen=True, slots=True)
class ScoringNetwork:
    """A judge's numbers: weights and biases of its two layers."""

    first: np.ndarray
    bias: np.ndarray
    second: np.ndarray
    offset: float

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray]) -> ScoringNetwork:
        """From the arrays of a ``head``."""
        return cls(arrays["first.weight"][:, :, 0, 0], arrays["first.bias"], arrays["logit.weight"][0, :, 0, 0],
                   float(arrays["logit.bias"][0]))  # fmt: skip

    def chance(self, told: np.ndarray) -> np.ndarray:
        """Chances (N,) from numbers (N, inputs)."""
        return sigmoid(np.maximum(told @ self.first.T + self.bias, 0.0) @ self.second + self.offset)


@dataclass(frozen=True, slots=True)
class SegmentScorers:
    """Who says whether two pieces are one log, and what overlap with a log a region has."""

    joins: ScoringNetwork
    worth: ScoringNetwork


def judges(folder: Path = SHIPPED) -> SegmentScorers:
    """From ``joins.safetensors`` and ``worth.safetensors`` of a folder.

    Raises:
        WeightsError: they are missing, damaged or of other networks.
    """
    heads = (ScoringNetwork.of(load(folder / f"{network.name}.safetensors", network)[0]) for network in (MERGE_NETWORK, QUALITY_NETWORK))
    return SegmentScorers(*heads)


@cache
def shipped_scorers() -> SegmentScorers:
    """Those that come with the package."""
    return judges()


@dataclass(frozen=True, slots=True)
class LogSegment:
    """Pixels (N,) of the maps' foreground that are one log: its axis (2,) and score."""

    own: np.ndarray
    axis: np.ndarray
    score: float


def parted(scene: Foreground, by: SegmentScorers) -> list[LogSegment]:
    """The foreground of a scene as logs, the largest first."""
    pieces = cut(scene)
    joined = SegmentMerger(scene, pieces)
    joined.join(by.joins)
    chances = by.worth.chance(joined.looks(by.joins)) if pieces else np.zeros(0)
    regions = [LogSegment(p.own, p.told, float(c)) for p, c in zip(joined.pieces, chances, strict=True)]
    return sorted(regions, key=lambda r: -len(r.own))


def cut(scene: Foreground) -> list[Segment]:
    """The scene's pieces, too many rather than too few, the largest first."""
    labels = watershed(scene.wall, scene.foreground)[scene.y, scene.x]
    order = np.argsort(labels, kind="stable")
    cuts = np.searchsorted(labels[order], np.arange(1, labels.max(initial=0) + 2))
    parts = [order[a:b] for a, b in pairwise(cuts) if b - a >= LEAST_PX * scene.grain]
    return [piece(scene, own) for own in sorted(parts, key=lambda own: -len(own))[:MOST]]


class SegmentMerger:
    """Pieces of a scene, their borders with each other, and their relations, as they grow together."""

    def __init__(self, scene: Foreground, pieces: list[Segment]) -> None:
        self.scene, self.pieces = scene, list(pieces)
        self._touch, self._wall = _borders(scene, pieces)
        n = len(pieces)
        self._told = np.zeros((n, n, len(PAIR_FEATURES)), np.float32)
        self._may = np.zeros((n, n), bool)  # be one log; below the diagonal as above
        self._row = SegmentTable.of(pieces)
        self._relate(*np.tril_indices(n, -1))

    def _relate(self, i: np.ndarray, j: np.ndarray) -> None:
        """Note what pieces ``i`` (n,) have to do with pieces ``j`` (n,)."""
        first = self._row.count[i] >= self._row.count[j]
        big, small = self._row.take(np.where(first, i, j)), self._row.take(np.where(first, j, i))
        touch = self._touch[i, j]
        may = may_merge(self.scene, big, small, touch)
        self._may[i, j] = self._may[j, i] = may
        i, j, touch = i[may], j[may], touch[may]
        between = np.divide(self._wall[i, j], touch, out=np.zeros_like(touch), where=touch > 0.0)
        told = relations(self.scene, big.take(may), small.take(may), touch, between)
        self._told[i, j] = self._told[j, i] = told

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Every pair (N, 2) that may be one log, and its RELATIONS (N, 19)."""
        pairs = np.argwhere(np.tril(self._may))
        return pairs, self._told[pairs[:, 0], pairs[:, 1]]

    def join(self, judge: ScoringNetwork) -> None:
        """Put together what is likely to be one log, the likeliest first, until nothing is."""
        chances = self.chances(judge)
        while chances.size and chances.max() >= LEAST_CHANCE:
            i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(chances)), chances.shape))
            kept = self.merge(i, j)
            chances = chances[kept[:, None], kept]
            chances[i] = chances[:, i] = np.where(self._may[i], judge.chance(self._told[i]), 0.0)

    def chances(self, judge: ScoringNetwork) -> np.ndarray:
        """That two pieces are one log (n, n), 0 for a piece with itself."""
        pairs, told = self.pairs()
        chances = np.zeros(self._may.shape)
        chances[pairs[:, 0], pairs[:, 1]] = chances[pairs[:, 1], pairs[:, 0]] = judge.chance(told)
        return chances

    def merge(self, i: int, j: int) -> np.ndarray:
        """Make pieces ``i`` and ``j``, ``i`` the earlier one, one in its place; the places (n - 1,) that the pieces had
        before."""
        self.pieces[i] = piece(self.scene, np.concatenate([self.pieces[i].own, self.pieces[j].own]))
        for of in (self._touch, self._wall):
            of[i] += of[j]
            of[:, i] += of[:, j]
            of[i, i] = 0.0
        self._row.put(i, self.pieces[i])
        kept = np.flatnonzero(np.arange(len(self.pieces)) != j)
        del self.pieces[j]
        self._touch, self._wall, self._told, self._may = (
            of[kept[:, None], kept] for of in (self._touch, self._wall, self._told, self._may)
        )
        self._row = self._row.take(kept)
        others = np.flatnonzero(np.arange(len(kept)) != i)
        self._relate(np.full(len(others), i), others)
        return kept

    def looks(self, judge: ScoringNetwork) -> np.ndarray:
        """LOOKS (n, 14) of the pieces as they are now."""
        likeness = self.chances(judge).max(axis=1, initial=0.0)
        touch, around = self._touch.sum(axis=1), self._wall.sum(axis=1)
        around = np.divide(around, touch, out=np.ones_like(around), where=touch > 0.0)
        return np.array([
            look(self.scene, p, float(touch[k]), float(around[k]), float(likeness[k]))
            for k, p in enumerate(self.pieces)
        ], np.float32).reshape(-1, len(SEGMENT_FEATURES))  # fmt: skip


def _borders(scene: Foreground, pieces: list[Segment]) -> tuple[np.ndarray, np.ndarray]:
    """How many pixels of border every two pieces (n, n) share, and the wall's sum along it."""
    n = len(pieces)
    labels = np.zeros(scene.foreground.shape, np.int64)
    for number, one in enumerate(pieces, 1):
        labels[scene.y[one.own], scene.x[one.own]] = number
    touch, wall = np.zeros((n + 1) ** 2), np.zeros((n + 1) ** 2)
    # A pixel or two of wall may lie between what meets there.
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]), (np.s_[:, :-2], np.s_[:, 2:]),
                 (np.s_[:-2], np.s_[2:])):  # fmt: skip
        i, j = labels[a], labels[b]
        meet = (i != j) & (i > 0) & (j > 0)
        pair = i[meet] * (n + 1) + j[meet]
        touch += np.bincount(pair, minlength=(n + 1) ** 2)
        wall += np.bincount(pair, np.maximum(scene.wall[a], scene.wall[b])[meet], (n + 1) ** 2)
    grids = (of.reshape(n + 1, n + 1)[1:, 1:] for of in (touch, wall))
    touch, wall = ((g + g.T) / 4.0 for g in grids)  # four looks at each border
    return touch, wall
