"""Average precision as COCO measures it, for one class, from overlaps.

In every picture the found ones take turns, surest first, and each takes the truth that it overlaps most of those still
free, if by at least the threshold; else, if it overlaps an ignored one so much, it does not count at all.  Precision is
made to fall with recall and read at 101 recalls.
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
    """One picture: scores (N,) of what was found, its overlaps (N, M) with the truths, which (M,) are ignored."""

    scores: np.ndarray
    overlaps: np.ndarray
    ignored: np.ndarray


@dataclass(frozen=True, slots=True)
class Curve:
    """Precision (K,) and recall (K,) as the least score falls, and the average precision."""

    precision: np.ndarray
    recall: np.ndarray
    scores: np.ndarray
    average: float


def box_overlaps(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Shared area over the union's (N, M) of boxes (N, 4) and (M, 4): left, top, right, bottom, the last exclusive."""
    found, truth = np.asarray(found, float).reshape(-1, 4), np.asarray(truth, float).reshape(-1, 4)
    low = np.maximum(found[:, None, :2], truth[None, :, :2])
    high = np.minimum(found[:, None, 2:], truth[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    areas = [np.prod(np.maximum(b[:, 2:] - b[:, :2], 0.0), axis=1) for b in (found, truth)]
    union = areas[0][:, None] + areas[1][None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0)


def mask_overlaps(found: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> np.ndarray:
    """Shared area over the union's (N, M) of masks (H, W)."""
    if not len(found) or not len(truth):
        return np.zeros((len(found), len(truth)))
    a, b = (np.stack([m.ravel() for m in masks]).astype(np.float32) for masks in (found, truth))
    shared = a @ b.T
    union = a.sum(axis=1)[:, None] + b.sum(axis=1)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0)


def curve(pictures: Sequence[Matches], threshold: float) -> Curve:
    """Precision over recall of all pictures at one least overlap.  Without truths the average is NaN."""
    scores, right, truths = [], [], 0
    for picture in pictures:
        truths += int(np.count_nonzero(~picture.ignored))
        for score, verdict in _judged(picture, threshold):
            scores.append(score)
            right.append(verdict)
    order = np.argsort(-np.array(scores), kind="stable")
    hits = np.cumsum(np.array(right, float)[order])
    found = np.arange(1, len(order) + 1)
    precision, recall = hits / found, hits / max(truths, 1)
    return Curve(precision, recall, np.array(scores)[order], _average(precision, recall) if truths else float("nan"))


def average_precision(pictures: Sequence[Matches], thresholds: Sequence[float] = THRESHOLDS) -> float:
    """Mean over the thresholds: mAP@0.5:0.95 by default."""
    return float(np.mean([curve(pictures, t).average for t in thresholds]))


def taken(picture: Matches, threshold: float) -> np.ndarray:
    """Which truths (M,) were found, at whatever score."""
    return _dealt(picture, threshold)[1]


def _judged(picture: Matches, threshold: float) -> list[tuple[float, bool]]:
    """Score and verdict of everything found that counts."""
    return _dealt(picture, threshold)[0]


def _dealt(picture: Matches, threshold: float) -> tuple[list[tuple[float, bool]], np.ndarray]:
    """Score and verdict of everything found that counts, and which truths (M,) it took."""
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
