"""Average precision as COCO measures it, for one class, from overlaps (intersection over union).

In every picture, detections are matched in descending order of score.  Each takes the free ground truth that it
overlaps most, if by at least the threshold.  Otherwise, a detection that overlaps an ignored ground truth by the
threshold does not count at all.  Precision is made monotonic in recall and read at 101 recalls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

THRESHOLDS: Final = tuple(round(0.5 + 0.05 * i, 2) for i in range(10))
RECALLS: Final = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, slots=True)
class Matches:
    """One picture: scores (N,) of detections, their overlaps (N, M) with ground truths, which of these are ignored
    (M,)."""

    scores: np.ndarray
    overlaps: np.ndarray
    ignored: np.ndarray


@dataclass(frozen=True, slots=True)
class Curve:
    """Precision (K,) and recall (K,) for falling scores (K,), and the average precision."""

    precision: np.ndarray
    recall: np.ndarray
    scores: np.ndarray
    average: float


def box_overlaps(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Compute the intersection over union (N, M) of boxes (N, 4) and (M, 4): left, top, right, bottom, the last two
    exclusive."""
    found, truth = np.asarray(found, float).reshape(-1, 4), np.asarray(truth, float).reshape(-1, 4)
    low = np.maximum(found[:, None, :2], truth[None, :, :2])
    high = np.minimum(found[:, None, 2:], truth[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    areas = [np.prod(np.maximum(b[:, 2:] - b[:, :2], 0.0), axis=1) for b in (found, truth)]
    union = areas[0][:, None] + areas[1][None] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0))


def mask_overlaps(found: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> np.ndarray:
    """Compute the intersection over union (N, M) of masks (H, W)."""
    if not len(found) or not len(truth):
        return np.zeros((len(found), len(truth)))
    a, b = (np.stack([m.ravel() for m in masks]).astype(np.float32) for masks in (found, truth))
    shared = a @ b.T
    union = a.sum(axis=1)[:, None] + b.sum(axis=1)[None] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0))


def curve(pictures: Sequence[Matches], threshold: float) -> Curve:
    """Compute precision over recall of all pictures at an overlap threshold; the average is NaN without ground
    truths."""
    scores, correct, truths = [], [], 0
    for picture in pictures:
        truths += int(np.count_nonzero(~picture.ignored))
        for score, is_true in _matched(picture, threshold)[0]:
            scores.append(score)
            correct.append(is_true)
    order = np.argsort(-np.array(scores), kind="stable")
    hits = np.cumsum(np.array(correct, float)[order])
    detection_counts = np.arange(1, len(order) + 1)
    precision, recall = hits / detection_counts, hits / max(truths, 1)
    return Curve(precision, recall, np.array(scores)[order], _average(precision, recall) if truths else float("nan"))


def average_precision(pictures: Sequence[Matches]) -> float:
    """Compute the mean over `THRESHOLDS`: mAP@0.5:0.95."""
    return float(np.mean([curve(pictures, t).average for t in THRESHOLDS]))


def matched_truths(picture: Matches, threshold: float) -> np.ndarray:
    """Tell which ground truths (M,) were detected, at any score."""
    return _matched(picture, threshold)[1]


def _matched(picture: Matches, threshold: float) -> tuple[list[tuple[float, bool]], np.ndarray]:
    """Return the score of every detection that counts, whether it is true, and which ground truths (M,) were
    matched."""
    free = np.ones(len(picture.ignored), bool)
    out = []
    for i in np.argsort(-picture.scores, kind="stable"):
        overlaps = np.where(free & ~picture.ignored, picture.overlaps[i], -1.0)
        best = int(np.argmax(overlaps)) if len(overlaps) else -1
        if best >= 0 and overlaps[best] >= threshold:
            free[best] = False
            out.append((float(picture.scores[i]), True))
        elif not (picture.overlaps[i][picture.ignored] >= threshold).any():
            out.append((float(picture.scores[i]), False))
    return out, ~free


def _average(precision: np.ndarray, recall: np.ndarray) -> float:
    falling = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, RECALLS - 1e-12, side="left")
    return float(np.where(at < len(falling), np.append(falling, 0.0)[np.minimum(at, len(falling))], 0.0).mean())
