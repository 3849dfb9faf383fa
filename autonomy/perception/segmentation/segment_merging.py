"""Merging of segments into logs: the pair with the highest probability first, until none is likely to be one log.

Two small networks score pairs of segments (are they one log?) and merged segments (how well do they overlap a log?).
They are trained on drawn pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.networks import SHIPPED, Interface, load
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES, SegmentTable, may_merge, pair_features
from autonomy.perception.segmentation.segments import (
    SEGMENT_FEATURES,
    Foreground,
    Segment,
    make_segment,
    segment_features,
    sigmoid,
    watershed,
)

MIN_SEGMENT_PX: Final = 6  # pixels of a map; smaller segments are dropped
MAX_SEGMENTS: Final = 100  # of a picture; only the largest are kept, because more are noise
HIDDEN_UNITS: Final = 24
MIN_MERGE_PROBABILITY: Final = 0.5


MERGE_NETWORK: Final = Interface("segment_merging", len(PAIR_FEATURES), {"logit": 1})
QUALITY_NETWORK: Final = Interface("segment_quality", len(SEGMENT_FEATURES), {"logit": 1})
"""Features in and the logit of a probability out, both as channels of a picture."""


@dataclass(frozen=True, slots=True)
class Scorer:
    """A scoring network evaluated by numpy: weights and biases of its two layers."""

    first: np.ndarray
    bias: np.ndarray
    second: np.ndarray
    offset: float

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray]) -> Scorer:
        """Make a scorer from the arrays of a scoring network."""
        return cls(
            arrays["first.weight"][:, :, 0, 0],
            arrays["first.bias"],
            arrays["logit.weight"][0, :, 0, 0],
            float(arrays["logit.bias"][0]),
        )

    def probability(self, features: np.ndarray) -> np.ndarray:
        """Compute probabilities (N,) from features (N, inputs)."""
        return sigmoid(np.maximum(features @ self.first.T + self.bias, 0.0) @ self.second + self.offset)


@dataclass(frozen=True, slots=True)
class SegmentScorers:
    """``merge``: the probability that two segments are one log; ``quality``: a segment's overlap with a log."""

    merge: Scorer
    quality: Scorer


def load_scorers(folder: Path = SHIPPED) -> SegmentScorers:
    """Load the scorers from ``segment_merging.onnx`` and ``segment_quality.onnx`` of a folder.

    Raises:
        InputRefused: the files are missing, damaged or of other networks.
    """
    networks = (MERGE_NETWORK, QUALITY_NETWORK)
    merge, quality = (Scorer.of(load(folder / f"{network.name}.onnx", network).arrays()) for network in networks)
    return SegmentScorers(merge, quality)


@cache
def shipped_scorers() -> SegmentScorers:
    """Load the scorers that are shipped with the package."""
    return load_scorers()


@dataclass(frozen=True, slots=True)
class LogSegment:
    """The pixels ``members`` (N,) of the foreground that are one log, its axis (2,) and score."""

    members: np.ndarray
    axis: np.ndarray
    score: float


def segment_logs(foreground: Foreground, scorers: SegmentScorers) -> list[LogSegment]:
    """Find the logs of a foreground, in descending order of size."""
    segments = over_segment(foreground)
    merger = SegmentMerger(foreground, segments)
    merger.merge_all(scorers.merge)
    scores = scorers.quality.probability(merger.features(scorers.merge)) if segments else np.zeros(0)
    logs = [LogSegment(s.members, s.predicted_axis, float(c)) for s, c in zip(merger.segments, scores, strict=True)]
    return sorted(logs, key=lambda log: -len(log.members))


def over_segment(foreground: Foreground) -> list[Segment]:
    """Divide the foreground into segments, rather too many than too few, in descending order of size."""
    labels = watershed(foreground.boundary, foreground.mask)[foreground.y, foreground.x]
    order = np.argsort(labels, kind="stable")
    cuts = np.searchsorted(labels[order], np.arange(1, labels.max(initial=0) + 2))
    parts = [order[a:b] for a, b in pairwise(cuts) if b - a >= MIN_SEGMENT_PX * foreground.grain]
    return [make_segment(foreground, part) for part in sorted(parts, key=lambda part: -len(part))[:MAX_SEGMENTS]]


class SegmentMerger:
    """Segments of a foreground with their shared borders and pair features, updated as segments merge."""

    def __init__(self, foreground: Foreground, segments: list[Segment]) -> None:
        self.foreground, self.segments = foreground, list(segments)
        self._border_px, self._boundary_sum = _borders(foreground, segments)
        n = len(segments)
        self._features = np.zeros((n, n, len(PAIR_FEATURES)), np.float32)
        self._may = np.zeros((n, n), bool)  # be one log; symmetric
        self._table = SegmentTable.of(segments)
        self._update_pairs(*np.tril_indices(n, -1))

    def _update_pairs(self, i: np.ndarray, j: np.ndarray) -> None:
        """Update the features of the pairs of segments ``i`` (n,) and ``j`` (n,)."""
        first_is_bigger = self._table.count[i] >= self._table.count[j]
        big, small = (
            self._table.take(np.where(first_is_bigger, i, j)),
            self._table.take(np.where(first_is_bigger, j, i)),
        )
        border_px = self._border_px[i, j]
        may = may_merge(self.foreground, big, small, border_px)
        self._may[i, j] = self._may[j, i] = may
        i, j, border_px = i[may], j[may], border_px[may]
        boundary = np.divide(self._boundary_sum[i, j], border_px, out=np.zeros_like(border_px), where=border_px > 0.0)
        features = pair_features(self.foreground, big.take(may), small.take(may), border_px, boundary)
        self._features[i, j] = self._features[j, i] = features

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all pairs (N, 2) that may be one log, and their PAIR_FEATURES (N, 19)."""
        pairs = np.argwhere(np.tril(self._may))
        return pairs, self._features[pairs[:, 0], pairs[:, 1]]

    def merge_all(self, scorer: Scorer) -> None:
        """Merge the most probable pair, again and again, until no pair reaches ``MIN_MERGE_PROBABILITY``."""
        probabilities = self.merge_probabilities(scorer)
        while probabilities.size and probabilities.max() >= MIN_MERGE_PROBABILITY:
            i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(probabilities)), probabilities.shape))
            remaining_indices = self.merge_pair(i, j)
            probabilities = probabilities[remaining_indices[:, None], remaining_indices]
            updated = np.where(self._may[i], scorer.probability(self._features[i]), 0.0)
            probabilities[i] = probabilities[:, i] = updated

    def merge_probabilities(self, scorer: Scorer) -> np.ndarray:
        """Compute the probability that two segments are one log (n, n), 0 for a segment with itself."""
        pairs, features = self.pairs()
        probabilities = np.zeros(self._may.shape)
        probabilities[pairs[:, 0], pairs[:, 1]] = probabilities[pairs[:, 1], pairs[:, 0]] = scorer.probability(features)
        return probabilities

    def merge_pair(self, i: int, j: int) -> np.ndarray:
        """Merge segment ``j`` into ``i``, ``i`` < ``j``, and return the former indices (n - 1,) of the segments."""
        members = np.concatenate([self.segments[i].members, self.segments[j].members])
        self.segments[i] = make_segment(self.foreground, members)
        for of in (self._border_px, self._boundary_sum):
            of[i] += of[j]
            of[:, i] += of[:, j]
            of[i, i] = 0.0
        self._table.put(i, self.segments[i])
        remaining_indices = np.flatnonzero(np.arange(len(self.segments)) != j)
        del self.segments[j]
        self._border_px, self._boundary_sum, self._features, self._may = (
            of[remaining_indices[:, None], remaining_indices]
            for of in (self._border_px, self._boundary_sum, self._features, self._may)
        )
        self._table = self._table.take(remaining_indices)
        others = np.flatnonzero(np.arange(len(remaining_indices)) != i)
        self._update_pairs(np.full(len(others), i), others)
        return remaining_indices

    def features(self, scorer: Scorer) -> np.ndarray:
        """Compute SEGMENT_FEATURES (n, 14) of the current segments."""
        merge_probability = self.merge_probabilities(scorer).max(axis=1, initial=0.0)
        border_px, around = self._border_px.sum(axis=1), self._boundary_sum.sum(axis=1)
        around = np.divide(around, border_px, out=np.ones_like(around), where=border_px > 0.0)
        return np.array(
            [
                segment_features(self.foreground, s, float(border_px[k]), float(around[k]), float(merge_probability[k]))
                for k, s in enumerate(self.segments)
            ],
            np.float32,
        ).reshape(-1, len(SEGMENT_FEATURES))


def _borders(foreground: Foreground, segments: list[Segment]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the border that each pair of segments shares [px], and the sum of the boundary map along it (n, n)."""
    n = len(segments)
    labels = np.zeros(foreground.mask.shape, np.int64)
    for number, segment in enumerate(segments, 1):
        labels[foreground.y[segment.members], foreground.x[segment.members]] = number
    border, boundary = np.zeros((n + 1) ** 2), np.zeros((n + 1) ** 2)
    # There may be a pixel or two of boundary between segments that meet.
    for a, b in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[:, :-2], np.s_[:, 2:]),
        (np.s_[:-2], np.s_[2:]),
    ):
        i, j = labels[a], labels[b]
        meet = (i != j) & (i > 0) & (j > 0)
        pair = i[meet] * (n + 1) + j[meet]
        border += np.bincount(pair, minlength=(n + 1) ** 2)
        boundary += np.bincount(pair, np.maximum(foreground.boundary[a], foreground.boundary[b])[meet], (n + 1) ** 2)
    grids = (of.reshape(n + 1, n + 1)[1:, 1:] for of in (border, boundary))
    border, boundary = ((g + g.T) / 4.0 for g in grids)  # each border is counted four times
    return border, boundary
