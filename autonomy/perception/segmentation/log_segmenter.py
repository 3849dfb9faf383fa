"""The log segmenter: a picture with depth in, instances of logs out.

The network sees a picture at several scales: at small ones it sees logs as wholes, at large ones the borders between
them.  First a coarse view shows where wood may be.  When all of it is in a part of the picture, a window around it is
segmented at a finer scale.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.networks import SHIPPED, OpenVinoNet, load
from autonomy.perception.camera.frame import RgbdFrame, check_frame, content_window
from autonomy.perception.segmentation.instances import Instance, decode_instances, shifted_instance
from autonomy.perception.segmentation.network import (
    COS2,
    EDGE,
    MASK,
    MULTIPLE,
    OFFSET_PX,
    OFFSET_U,
    OFFSET_V,
    SIN2,
    STRIDE,
    interface_of,
    network_input,
)
from autonomy.perception.segmentation.resize import doubled, interpolated_map, shrunk
from autonomy.perception.segmentation.segment_merging import SegmentScorers, shipped_scorers
from autonomy.perception.segmentation.segments import sigmoid
from machine.geometry.optics import Intrinsics

SIZE_PX: Final = 304
COARSE_VIEW_RATIO: Final = 1.5  # a picture longer than the network's by this factor gets a view at half the size, too
MIN_WOOD_PROBABILITY: Final = 0.3
WINDOWS: Final = ((352, 608), (464, 464), (608, 352))
"""Height and width of a window [px of the network]; few sizes, because the network is compiled for each."""
MIN_FACTOR: Final = 0.5  # a picture is at most doubled
MIN_BEST_SCORE: Final = 0.3
"""When the best log of a window scores less, the whole picture is segmented."""
MARGIN_PX: Final = 16  # around the wood in a window [px of the network]
THIN_PX: Final = 5  # of the finer maps: what is narrower is hardly two pixels wide in the coarser ones
FINE_MASK_SHARE, FINE_EDGE_SHARE = 0.4, 0.8  # weight of the finer maps in the fusion of two scales

View = tuple[np.ndarray, np.ndarray, Intrinsics]
"""Colour (H, W, 3) uint8, depth (H, W) [m], intrinsics."""
Window = tuple[int, int, int, int]
"""Top, bottom, left, right; the second and fourth exclusive."""


class LogSegmenter:
    """The network with its weights, for frames of any size; one thread.

    Args:
        variant: "rgbd" or "depth".
        weights: weight file; None selects the shipped weights of the variant.
        size_px: approximate length of the network's picture; frames are shrunk by a whole factor, or doubled when they
            are shorter.  Pictures longer than SIZE_PX are also seen at half the size, and so on.
        precision: of the network, see ``OpenVinoNet``.
        scorers: scorers of segments; None selects the shipped ones.
        use_window: whether a window around the wood is segmented at a finer scale.

    Raises:
        InputRefused: the weights are missing, damaged or of another network.
    """

    def __init__(
        self,
        variant: str = "rgbd",
        weights: Path | None = None,
        size_px: int = 2 * SIZE_PX,
        precision: str = "bf16",
        scorers: SegmentScorers | None = None,
        use_window: bool = True,
    ) -> None:
        self._use_window = use_window
        self.variant, self.size_px, self._precision = variant, size_px, precision
        self._weights = load(weights or SHIPPED / f"logs_{variant}.onnx", interface_of(variant))
        self.facts = self._weights.facts
        self._scorers = scorers or shipped_scorers()
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
        window = content_window(rgb)
        view = crop((rgb, depth_m, pinhole), window)
        factor, known = self._finest_factor(view), None
        if self._use_window:
            coarse = max(1, round(max(view[1].shape) / SIZE_PX))
            known = coarse, self.maps(*shrunk(*view, coarse))
            inner, finer = self._finer_window(sigmoid(known[1][MASK]), coarse * STRIDE, view[1].shape, factor)
            if finer < factor:
                corner = (window[0] + inner[0], window[2] + inner[2])
                instances = self._segment_view(crop(view, inner), finer, None, corner, depth_m)
                if instances and instances[0].score > MIN_BEST_SCORE:
                    return instances
        # The coarse view misses thin logs: something else selected the window.
        return self._segment_view(view, factor, known, (window[0], window[2]), depth_m)

    def _segment_view(
        self,
        view: View,
        factor: float,
        known: tuple[int, np.ndarray] | None,
        corner: tuple[int, int],
        whole: np.ndarray,
    ) -> tuple[Instance, ...]:
        """Find the logs of a part of a picture with its corner (row, column) in the ``whole`` (H, W)."""
        maps, scale = self.multi_scale_maps(*view, factor, known)
        instances = decode_instances(maps, scale, view[1], self._scorers)
        if view[1].shape == whole.shape:
            return instances
        return tuple(shifted_instance(i, corner[1], corner[0], (whole.shape[0], whole.shape[1])) for i in instances)

    def multi_scale_maps(
        self,
        rgb: np.ndarray,
        depth_m: np.ndarray,
        pinhole: Intrinsics,
        factor: float | None = None,
        known: tuple[int, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, int]:
        """Fuse maps (8, h, w) of a picture at one or more scales; return also their pixels' width in the picture [px].

        ``factor``: by what the picture is shrunk at the finest scale (0.5: doubled); ``known``: a factor whose maps
        were computed before.
        """
        view = rgb, depth_m, pinhole
        finest = self._finest_factor(view) if factor is None else factor
        rest, longest = max(1, round(finest)), max(depth_m.shape)
        factors = [rest]
        while longest >= COARSE_VIEW_RATIO * rest * SIZE_PX:
            rest *= 2
            factors.append(rest)
        pyramid = [known[1] if known and known[0] == f else self.maps(*shrunk(*view, f)) for f in factors]
        if finest < 1.0:
            pyramid.insert(0, self.maps(*doubled(*view)))
        maps = pyramid.pop()
        while pyramid:
            maps = fuse_scales(pyramid.pop(), maps)
        return maps, round(finest * STRIDE)

    def _finest_factor(self, view: View) -> float:
        """Compute by what a whole picture is shrunk at its finest scale."""
        longest = max(view[1].shape)
        return 0.5 if self.size_px >= COARSE_VIEW_RATIO * longest else max(1, round(longest / self.size_px))

    def _finer_window(
        self, wood: np.ndarray, scale: int, shape: tuple[int, ...], factor: float
    ) -> tuple[Window, float]:
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

    def maps(self, rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics) -> np.ndarray:
        """Compute maps (8, h / 2, w / 2) of a picture of the network's size, padded to a multiple of MULTIPLE."""
        image = network_input(rgb, depth_m, pinhole, self.variant)
        h, w = image.shape[1:]
        high, wide = -(-h // MULTIPLE) * MULTIPLE, -(-w // MULTIPLE) * MULTIPLE
        padded = np.zeros((1, len(image), high, wide), np.float32)
        padded[0, :, :h, :w] = image
        if (high, wide) not in self._nets:
            self._nets[high, wide] = OpenVinoNet(self._weights, padded.shape, self._precision)
        maps = self._nets[high, wide](padded)["maps"][0]
        return np.asarray(maps[:, : -(-h // STRIDE), : -(-w // STRIDE)])


@cache
def _shipped() -> LogSegmenter:
    return LogSegmenter()


def segment(frame: RgbdFrame) -> tuple[Instance, ...]:
    """Find the logs of a frame by the shipped RGB-D weights; see ``LogSegmenter.segment``."""
    return _shipped().segment(frame)


def window_around(
    rows: np.ndarray, columns: np.ndarray, scale: int, margin: int, size: tuple[int, int], shape: tuple[int, ...]
) -> Window | None:
    """Find the window of ``size`` around rows and columns, each ``scale`` pixels wide, clipped to the picture (H, W).

    None when it does not hold them with ``margin`` around them.
    """
    window: list[int] = []
    for at, long, whole in zip((rows, columns), size, shape, strict=True):
        start, stop = int(at[0]), int(at[-1]) + scale
        if stop - start + 2 * margin > long < whole:
            return None
        begin = min(max((start + stop - long) // 2, 0), max(whole - long, 0))
        window += [begin, min(begin + long, whole)]
    return window[0], window[1], window[2], window[3]


def crop(view: View, window: Window) -> View:
    """Cut a window out of colour, depth and pinhole."""
    (rgb, depth_m, pinhole), (top, bottom, left, right) = view, window
    at = slice(top, bottom), slice(left, right)
    return rgb[at], depth_m[at], pinhole.crop(left, top, right - left, bottom - top)


def fuse_scales(fine: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Fuse maps (8, h, w) of a picture and of the same picture at half the size.

    Votes come from the coarse maps, which show logs as wholes; ends from the fine maps; masks, angles and edges from
    both.  Structures too thin for the coarse maps come from the fine maps alone.
    """
    h, w = fine.shape[1:]
    y, x = (np.minimum(np.arange(n) // 2, n2 - 1) for n, n2 in ((h, coarse.shape[1]), (w, coarse.shape[2])))
    east, south, *arrow = coarse[[OFFSET_U, OFFSET_V, COS2, SIN2]].take(x, axis=2).take(y, axis=1)
    maps = fine.copy()
    maps[COS2 : SIN2 + 1] += arrow
    pixel = np.float32(STRIDE / OFFSET_PX)
    maps[OFFSET_U] = 2.0 * east + pixel * (2.0 * x + 0.5 - np.arange(w)).astype(np.float32)
    maps[OFFSET_V] = 2.0 * south + pixel * (2.0 * y + 0.5 - np.arange(h)).astype(np.float32)[:, None]
    for i, share in ((MASK, FINE_MASK_SHARE), (EDGE, FINE_EDGE_SHARE)):
        smooth = interpolated_map(coarse[i])
        if smooth.shape != (h, w):  # an odd picture has one more row or column, which repeats
            smooth = smooth[np.minimum(np.arange(h), len(smooth) - 1)][:, np.minimum(np.arange(w), smooth.shape[1] - 1)]
        maps[i] = share * fine[i] + (1.0 - share) * smooth
    wood = fine[MASK] > 0.0
    thin = wood & ~_opened(wood, THIN_PX)
    maps[:, thin] = fine[:, thin]
    return maps


def _opened(wood: np.ndarray, size: int) -> np.ndarray:
    """Compute the morphological opening of ``wood`` (h, w) bool with a square of ``size`` (odd) pixels."""
    for grow in (False, True):
        for axis in (0, 1):
            lines = wood if axis == 0 else wood.T
            padded: np.ndarray = np.pad(lines, ((size // 2, size // 2), (0, 0)))
            lines = np.full(lines.shape, not grow)
            for i in range(size):
                part = padded[i : i + len(lines)]
                lines = lines | part if grow else lines & part
            wood = lines if axis == 0 else lines.T
    return wood
