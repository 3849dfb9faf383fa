"""The mask segmenter: a picture with or without depth in, instances of logs out.

A coarse view shows where wood may be; a window around it is seen once more, as large as the network's picture allows.
Where a picture has depth, what has none is no log: sky, glare and mist have no shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.networks import SHIPPED, OpenVinoNet, load
from autonomy.perception.camera.frame import RgbdFrame, check_frame, content_window
from autonomy.perception.segmentation.ground_plane import height_over_plane
from autonomy.perception.segmentation.instances import Instance, instance_at, shifted_instance
from autonomy.perception.segmentation.log_segmenter import View, crop, window_around
from autonomy.perception.segmentation.mask_network import (
    FEATURES,
    KERNEL_STRIDE,
    MASKS,
    MULTIPLE,
    PLACE_PX,
    mask_input,
)
from autonomy.perception.segmentation.network import COS2, ENDS, MAPS, MASK, SIN2, STRIDE
from autonomy.perception.segmentation.resize import doubled, shrunk
from autonomy.perception.segmentation.segment_merging import LogSegment
from autonomy.perception.segmentation.segments import boundary_map, sigmoid, watershed
from machine.geometry.optics import Intrinsics

# -- Logs from the mask network's kernels: a mask for each place where a log's middle may be, the best of them kept.


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
    """Find the logs of ``maps`` (8 + FEATURES, h, w) and ``kernels`` (1 + KERNEL, k, l), the surest first."""
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
    selected_indices: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if size[i] < MIN_LOG_PX:
            continue
        overlap = [shared[i, j] / (size[i] + size[j] - shared[i, j]) for j in selected_indices]
        within = [shared[i, j] / min(size[i], size[j]) for j in selected_indices]
        if not selected_indices or (max(overlap) < MAX_OVERLAP and max(within) < MAX_INSIDE):
            selected_indices.append(int(i))
    if not selected_indices:
        return KernelLogs(y, x, ())
    own = logits[selected_indices]
    claims = _shared_out(own, _segment_numbers(maps, x, y))
    logs = []
    for k, i in enumerate(selected_indices):
        members = np.flatnonzero(claims == k)
        if len(members) >= max(MIN_LOG_PX, MIN_OWN_SHARE * size[i]):
            logs.append(
                KernelLog(
                    members,
                    own[k, members],
                    float(heat[rows[i], columns[i]]),
                    float(certainty[i]),
                    len(members) / float(size[i]),
                )
            )
    return KernelLogs(y, x, tuple(logs))


def _segment_numbers(maps: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the watershed's segment of every pixel of the wood (N,), 0 for none."""
    wood = np.zeros(maps.shape[1:], bool)
    wood[y, x] = True
    return np.asarray(watershed(boundary_map(maps[: len(MAPS)]), wood)[y, x])


def _shared_out(logits: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Find the kernel (N,) that each pixel belongs to, -1 none: a segment that is mostly one kernel's is wholly its.

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
    """Compute logits (K, N) of kernels (KERNEL, K) at cells for pixels (N,) with features (FEATURES, N)."""
    middle, half = KERNEL_STRIDE / 2.0 - 0.5, 0.5 * (STRIDE - 1)
    u, v = ((STRIDE * at + half) / PLACE_PX for at in (x, y))
    u0, v0 = ((KERNEL_STRIDE * at + middle) / PLACE_PX for at in (columns, rows))
    a, b, c, d, e, constant = kernels[FEATURES:]
    # The polynomial about the kernel's place, written about the origin: one product for all pixels.
    about = np.stack(
        [
            a - 2.0 * c * u0 - d * v0,
            b - 2.0 * e * v0 - d * u0,
            c,
            d,
            e,
            constant - a * u0 - b * v0 + c * u0 * u0 + d * u0 * v0 + e * v0 * v0,
        ]
    )
    places = np.stack([u, v, u * u, u * v, v * v, np.ones_like(u)]).astype(np.float32)
    weights = np.concatenate([kernels[:FEATURES], about]).astype(np.float32)
    return np.asarray(weights.T @ np.concatenate([features, places]))


# -- The mask segmenter


SIZE_PX: Final = 320  # of the coarse view
WINDOWS: Final = ((320, 640), (448, 448), (640, 320))
"""Height and width of a window [px of the network]; few sizes, because the network is compiled for each."""
MIN_FACTOR: Final = 0.5  # a picture is at most doubled
MIN_WOOD_PROBABILITY: Final = 0.3
MARGIN_PX: Final = 12  # around the wood in a window [px of the network]
MIN_BEST_SCORE: Final = 0.3
"""When the best log of a window scores less, the whole picture is segmented."""
MIN_PICTURE_SHARE, MIN_LOG_SHARE = 0.1, 0.2
"""Where at least the first share of a picture has depth, a log needs depth in at least the second share of its
pixels."""
MODES: Final = ("rgbd", "depth", "colour")
WOOD_SHIFT: Final = 1.5  # by which the outline trusts a log's own mask more than the wood's
STEEPNESS, EVEN_ODDS = 16.0, 0.58
"""Of the logistic curve from heat times certainty to a probability, fitted on training pictures: see the card."""


class MaskSegmenter:
    """The mask network with its weights, for frames of any size; one thread.

    Args:
        mode: "rgbd", or one sense alone: "depth" or "colour".
        weights: weight file; None selects the shipped weights.
        size_px: approximate length of the network's picture of a whole frame.
        precision: of the network, see ``OpenVinoNet``.
        use_window: whether a window around the wood is segmented at a finer scale.

    Raises:
        InputRefused: the weights are missing, damaged or of another network.
    """

    def __init__(
        self,
        mode: str = "rgbd",
        weights: Path | None = None,
        size_px: int = 2 * SIZE_PX,
        precision: str = "bf16",
        use_window: bool = True,
    ) -> None:
        self.mode, self.size_px, self._precision, self._use_window = mode, size_px, precision, use_window
        self._weights = load(weights or SHIPPED / "logs.onnx", MASKS)
        self.facts = self._weights.facts
        self._nets: dict[tuple[int, int], OpenVinoNet] = {}

    def segment(self, frame: RgbdFrame) -> tuple[Instance, ...]:
        """Find the logs of a frame in descending order of score; empty when there is none.

        Raises:
            InputRefused: the frame is invalid.
        """
        check_frame(frame)
        return self.segment_picture(frame.rgb, frame.depth_m, frame.intrinsics)

    def segment_picture(self, rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics) -> tuple[Instance, ...]:
        """Segment as ``segment`` does; depth may be unknown everywhere (a photograph)."""
        if self.mode == "colour":
            depth_m = np.full_like(depth_m, np.nan)
        outer = content_window(rgb)
        view = crop((rgb, depth_m, pinhole), outer)
        longest = max(view[1].shape)
        factor = max(1, round(longest / self.size_px))
        corner = (outer[0], outer[2])
        if self._use_window:
            coarse = max(1, math.ceil(longest / SIZE_PX))
            maps, _ = self.answers(*shrunk(*view, coarse))
            inner, finer = finer_window(sigmoid(maps[MASK]), coarse * STRIDE, view[1].shape, factor)
            if finer < factor:
                top, left = inner[0], inner[2]
                instances = self._logs(crop(view, inner), finer, (corner[0] + top, corner[1] + left), depth_m)
                if instances and instances[0].score > MIN_BEST_SCORE:
                    return instances
        return self._logs(view, factor, corner, depth_m)

    def _logs(self, view: View, factor: float, corner: tuple[int, int], whole: np.ndarray) -> tuple[Instance, ...]:
        """Find the logs of a part of a picture with its corner (row, column) in the ``whole`` (H, W)."""
        maps, kernels = self.answers(*(doubled(*view) if factor < 1.0 else shrunk(*view, round(factor))))
        instances = decoded(maps, kernels, round(factor * STRIDE), view[1])
        if view[1].shape == whole.shape:
            return instances
        return tuple(shifted_instance(i, corner[1], corner[0], (whole.shape[0], whole.shape[1])) for i in instances)

    def answers(self, rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
        """Compute maps and kernels of a picture of the network's size, which is padded to a multiple of MULTIPLE."""
        image = mask_input(None if self.mode == "depth" else rgb, depth_m, pinhole, height_over_plane(depth_m, pinhole))
        h, w = image.shape[1:]
        high, wide = -(-h // MULTIPLE) * MULTIPLE, -(-w // MULTIPLE) * MULTIPLE
        padded = np.zeros((1, len(image), high, wide), np.float32)
        padded[0, :, :h, :w] = image
        if (high, wide) not in self._nets:
            self._nets[high, wide] = OpenVinoNet(self._weights, padded.shape, self._precision)
        answer = self._nets[high, wide](padded)
        return answer["maps"][0][:, : -(-h // STRIDE), : -(-w // STRIDE)], answer["kernels"][0]


@cache
def _shipped() -> MaskSegmenter:
    return MaskSegmenter()


def segment(frame: RgbdFrame) -> tuple[Instance, ...]:
    """Find the logs of a frame by the shipped weights; see ``MaskSegmenter.segment``."""
    return _shipped().segment(frame)


def finer_window(
    wood: np.ndarray, scale: int, shape: tuple[int, ...], factor: float
) -> tuple[tuple[int, int, int, int], float]:
    """Find the window of a picture (H, W) that holds all wood at the finest possible scale, and its shrink factor.

    ``wood`` (h, w) is the probability of wood, in pixels that are ``scale`` pixels of the picture wide.
    """
    window, at = (0, shape[0], 0, shape[1]), factor
    rows, columns = (np.flatnonzero((wood > MIN_WOOD_PROBABILITY).any(axis=k)) * scale for k in (1, 0))
    while len(rows) and at > MIN_FACTOR:
        at *= 0.5
        sizes = ((round(at * h), round(at * w)) for h, w in WINDOWS)
        windows = (window_around(rows, columns, scale, round(at * MARGIN_PX), size, shape) for size in sizes)
        window, factor = next(((w, at) for w in windows if w is not None), (window, factor))
    return window, factor


def decoded(maps: np.ndarray, kernels: np.ndarray, scale: int, depth_m: np.ndarray) -> tuple[Instance, ...]:
    """Decode the logs of maps (24, h, w) and kernels, whose pixels are ``scale`` pixels of the picture (H, W) wide."""
    known = np.isfinite(depth_m[scale // 2 :: scale, scale // 2 :: scale])
    candidates = kernel_logs(maps, kernels)
    logs = [log for log in candidates.logs if _has_shape(candidates, log, known)]
    if not logs:
        return ()
    labels = np.zeros(maps.shape[1:], np.int32)
    probability = np.zeros(maps.shape[1:])
    for number, log in enumerate(logs, 1):
        at = candidates.y[log.members], candidates.x[log.members]
        labels[at] = number
        probability[at] = sigmoid(np.minimum(log.logits, maps[MASK][at] + WOOD_SHIFT))
    nearest = ndimage.distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
    labels = labels[tuple(nearest)]
    ends, instances = sigmoid(maps[ENDS]), []
    for number, log in enumerate(logs, 1):
        x, y = candidates.x[log.members], candidates.y[log.members]
        segment_ = LogSegment(log.members, _axis(maps, x, y), score(log))
        instance = instance_at(
            segment_, number, candidates.x, candidates.y, labels, probability, ends, scale, depth_m.shape
        )
        if instance is not None:
            instances.append(instance)
    return tuple(sorted(instances, key=lambda i: -i.score))


def _has_shape(found: KernelLogs, log: KernelLog, known: np.ndarray) -> bool:
    """Tell whether enough of a log's pixels have depth, in a picture that has any."""
    if known.mean() < MIN_PICTURE_SHARE:
        return True
    y, x = found.y[log.members], found.x[log.members]
    inside = (y < known.shape[0]) & (x < known.shape[1])
    return bool(inside.any()) and float(known[y[inside], x[inside]].mean()) >= MIN_LOG_SHARE


def _axis(maps: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the unit axis (2,) of a log by the network's angles at its pixels."""
    c, s = maps[COS2, y, x].sum(), maps[SIN2, y, x].sum()
    angle = 0.5 * math.atan2(float(s), float(c))
    return np.array([math.cos(angle), math.sin(angle)])


def score(log: KernelLog) -> float:
    """Compute the probability that a log overlaps a true one by half, from heat and certainty."""
    return 1.0 / (1.0 + math.exp(-STEEPNESS * (log.heat * log.certainty - EVEN_ODDS)))
