"""Logs from the mask network's kernels: a mask for each place where a log's middle may be, the best of them kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.segmentation.mask_network import FEATURES, KERNEL_STRIDE, PLACE_PX
from autonomy.perception.segmentation.network import MAPS, MASK, STRIDE
from autonomy.perception.segmentation.watershed import boundary_map, sigmoid, watershed

MIN_HEAT: Final = 0.12
MAX_KERNELS: Final = 160
MIN_WOOD: Final = 0.3  # probability of wood below which a pixel belongs to no log
MIN_LOG_PX: Final = 8  # pixels of the maps
MAX_OVERLAP, MAX_INSIDE = 0.5, 0.75  # of two logs' masks: over their union, over the smaller
MIN_MAJORITY, MIN_CLAIM = 0.7, 0.35  # of a segment's claimed pixels, and of all, that make it one kernel's
MIN_OWN_SHARE: Final = 0.4  # of a mask that no better log claims


@dataclass(frozen=True, slots=True)
class KernelLog:
    """One log: its pixels (n,) among those of the wood, their logits, its heat, the share of its mask that it keeps."""

    members: np.ndarray
    logits: np.ndarray
    heat: float
    certainty: float
    own_share: float


@dataclass(frozen=True, slots=True)
class KernelLogs:
    """The logs of maps; ``y`` and ``x`` (N,) are the pixels of the wood that members count."""

    y: np.ndarray
    x: np.ndarray
    logs: tuple[KernelLog, ...]


def kernel_logs(maps: np.ndarray, kernels: np.ndarray) -> KernelLogs:
    """The logs of ``maps`` (8 + FEATURES, h, w) and ``kernels`` (1 + KERNEL, k, l), the surest first."""
    wood = maps[MASK] > np.log(MIN_WOOD / (1.0 - MIN_WOOD))
    y, x = np.nonzero(wood)
    heat = sigmoid(kernels[0])
    rows, columns = np.nonzero(heat >= MIN_HEAT)
    order = np.argsort(-heat[rows, columns], kind="stable")[:MAX_KERNELS]
    rows, columns = rows[order], columns[order]
    if not len(rows) or not len(x):
        return KernelLogs(y, x, ())
    logits = _logits(maps[len(MAPS) :, y, x], x, y, kernels[1:, rows, columns], rows, columns)
    inside = logits > 0.0
    size = inside.sum(axis=1)
    certainty = (sigmoid(logits) * inside).sum(axis=1) / np.maximum(size, 1)
    score = heat[rows, columns] * certainty
    dense = inside.astype(np.float32)
    shared = dense @ dense.T
    kept: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if size[i] < MIN_LOG_PX:
            continue
        overlap = [shared[i, j] / (size[i] + size[j] - shared[i, j]) for j in kept]
        within = [shared[i, j] / min(size[i], size[j]) for j in kept]
        if not kept or (max(overlap) < MAX_OVERLAP and max(within) < MAX_INSIDE):
            kept.append(int(i))
    if not kept:
        return KernelLogs(y, x, ())
    own = logits[kept]
    claims = _shared_out(own, _segment_numbers(maps, x, y))
    found = []
    for k, i in enumerate(kept):
        members = np.flatnonzero(claims == k)
        if len(members) >= max(MIN_LOG_PX, MIN_OWN_SHARE * size[i]):
            found.append(KernelLog(members, own[k, members], float(heat[rows[i], columns[i]]), float(certainty[i]),
                                   len(members) / float(size[i])))  # fmt: skip
    return KernelLogs(y, x, tuple(found))


def _segment_numbers(maps: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The watershed's segment of every pixel of the wood (N,), 0 for none."""
    wood = np.zeros(maps.shape[1:], bool)
    wood[y, x] = True
    return np.asarray(watershed(boundary_map(maps[: len(MAPS)]), wood)[y, x])


def _shared_out(logits: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """The kernel (N,) that each pixel belongs to, -1 none: a segment that is mostly one kernel's is wholly its.

    Kernels know which parts are one log; the watershed of the edges knows where it ends.
    """
    best = np.argmax(logits, axis=0)
    best[logits.max(axis=0) <= 0.0] = -1
    count = int(segment.max(initial=0)) + 1
    votes = np.zeros((count, len(logits) + 1))
    np.add.at(votes, (segment, best + 1), 1.0)
    size = votes.sum(axis=1)
    most = np.argmax(votes[:, 1:], axis=1)
    top = votes[np.arange(count), most + 1]
    claimed = np.maximum(size - votes[:, 0], 1.0)
    whole = (top >= MIN_MAJORITY * claimed) & (top >= MIN_CLAIM * size)
    whole[0] = False
    return np.asarray(np.where(whole[segment], most[segment], best))


def _logits(
    features: np.ndarray, x: np.ndarray, y: np.ndarray, kernels: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Logits (K, N) of kernels (KERNEL, K) at cells for pixels (N,) with features (FEATURES, N)."""
    middle, half = KERNEL_STRIDE / 2.0 - 0.5, 0.5 * (STRIDE - 1)
    u, v = ((STRIDE * at + half) / PLACE_PX for at in (x, y))
    u0, v0 = ((KERNEL_STRIDE * at + middle) / PLACE_PX for at in (columns, rows))
    a, b, c, d, e, one = kernels[FEATURES:]
    # The polynomial about the kernel's place, written about the origin: one product for all pixels.
    about = np.stack([a - 2.0 * c * u0 - d * v0, b - 2.0 * e * v0 - d * u0, c, d, e,
                      one - a * u0 - b * v0 + c * u0 * u0 + d * u0 * v0 + e * v0 * v0])  # fmt: skip
    places = np.stack([u, v, u * u, u * v, v * v, np.ones_like(u)]).astype(np.float32)
    weights = np.concatenate([kernels[:FEATURES], about]).astype(np.float32)
    return np.asarray(weights.T @ np.concatenate([features, places]))
