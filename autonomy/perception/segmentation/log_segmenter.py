"""Looking for logs in a picture: where wood may be, how near to look there, the network's maps, the logs they hold.

A picture is looked at in several sizes: in small pictures the network sees logs as wholes, in large ones the borders
between them.  Where all that may be wood is in a part of the picture, a window about it is looked at from nearer.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.networks.openvino_net import OpenVinoNet
from autonomy.networks.weights import SHIPPED, load
from autonomy.perception.camera.frame import RgbdFrame, check_frame, content_window
from autonomy.perception.segmentation.instances import Instance, instances, placed
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
    channels,
    unet,
)  # fmt: skip
from autonomy.perception.segmentation.resize import bilinear, doubled, shrunk
from autonomy.perception.segmentation.segment_merging import SegmentScorers, shipped_scorers
from autonomy.perception.segmentation.watershed import sigmoid
from machine.geometry.optics import Intrinsics

SIZE_PX: Final = 304
TWICE: Final = 1.5  # pictures so many times longer than what is asked for are looked at at half the size too
MAYBE: Final = 0.3  # what may be wood
WINDOWS: Final = ((352, 608), (464, 464), (608, 352))
"""Height and width of a nearer look [px of the network]; few, for the network is compiled for each."""
NEAREST: Final = 0.5  # a picture is not more than doubled
LIKELY: Final = 0.3
"""The best log of a nearer look is at least so good, or the whole picture is looked at."""
EDGE_PX: Final = 16  # left about the wood [px of the network]
THIN_PX: Final = 5  # of the finer maps: what is narrower is hardly two wide in the coarser ones
MASK_SHARE, EDGE_SHARE = 0.4, 0.8  # of the finer look in what two looks give

Shot = tuple[np.ndarray, np.ndarray, Intrinsics]
Window = tuple[int, int, int, int]
"""Top, bottom, left, right; the second and fourth exclusive."""


class LogSegmenter:
    """The network with its weights, for frames of any size; one thread.

    Args:
        variant: "rgbd" or "depth".
        weights: file; None are the shipped ones of the variant.
        size_px: about how long the network's picture is; frames are shrunk by a whole factor, or doubled when they
            are shorter.  Of a picture longer than SIZE_PX a look at half the size is taken first, and so on.
        precision: of the network, see ``OpenVinoNet``.
        judges: who says what is one log; None are the shipped ones.
        nearer: whether a window about the wood is looked at from nearer.

    Raises:
        WeightsError: the weights are missing, damaged or of another network.
    """

    def __init__(
        self,
        variant: str = "rgbd",
        weights: Path | None = None,
        size_px: int = 2 * SIZE_PX,
        precision: str = "bf16",
        judges: SegmentScorers | None = None,
        nearer: bool = True,
    ) -> None:
        self._looks_nearer = nearer
        self.variant, self.size_px, self._precision = variant, size_px, precision
        self._network = unet(variant)
        self._arrays, self.facts = load(weights or SHIPPED / f"logs_{variant}.safetensors", self._network)
        self._judges = judges or shipped_scorers()
        self._nets: dict[tuple[int, int], OpenVinoNet] = {}

    def segment(self, frame: RgbdFrame) -> tuple[Instance, ...]:
        """The logs of a frame, the surest first; none is an empty tuple.

        Raises:
            FrameRefused: the frame cannot be a picture of its camera.
        """
        check_frame(frame)
        return self.segment_picture(frame.rgb, frame.depth_m, frame.intrinsics)

    def segment_picture(self, rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics) -> tuple[Instance, ...]:
        """As ``segment``; depth may be unknown everywhere (a photograph)."""
        window = content_window(rgb)
        shot = cut((rgb, depth_m, pinhole), window)
        factor, known = self._factor(shot), None
        if self._looks_nearer:
            coarse = max(1, round(max(shot[1].shape) / SIZE_PX))
            known = coarse, self.maps(*shrunk(*shot, coarse))
            inner, finer = self._nearer(sigmoid(known[1][MASK]), coarse * STRIDE, shot[1].shape, factor)
            if finer < factor:
                found = self._found(
                    cut(shot, inner), finer, None, (window[0] + inner[0], window[2] + inner[2]), depth_m
                )
                if found and found[0].score > LIKELY:
                    return found
        # The glance is blind to thin logs: what drew the look nearer was something else.
        return self._found(shot, factor, known, (window[0], window[2]), depth_m)

    def _found(
        self,
        shot: Shot,
        factor: float,
        known: tuple[int, np.ndarray] | None,
        corner: tuple[int, int],
        whole: np.ndarray,
    ) -> tuple[Instance, ...]:
        """The logs of a part of a picture that begins at a corner (row, column) of the ``whole`` (H, W)."""
        maps, scale = self.multi_scale_maps(*shot, factor, known)
        found = instances(maps, scale, shot[1], self._judges)
        if shot[1].shape == whole.shape:
            return found
        return tuple(placed(i, corner[1], corner[0], whole.shape) for i in found)

    def multi_scale_maps(
        self,
        rgb: np.ndarray,
        depth_m: np.ndarray,
        pinhole: Intrinsics,
        factor: float | None = None,
        known: tuple[int, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, int]:
        """Maps of a picture, looked at once or more, and how many of its pixels one of theirs is wide.

        ``factor``: by what the picture is shrunk in the finest look (a half: doubled); ``known``: a factor whose maps
        are there already.
        """
        shot = rgb, depth_m, pinhole
        finest = self._factor(shot) if factor is None else factor
        rest, longest = max(1, round(finest)), max(depth_m.shape)
        factors = [rest]
        while longest >= TWICE * rest * SIZE_PX:
            rest *= 2
            factors.append(rest)
        looked = [known[1] if known and known[0] == f else self.maps(*shrunk(*shot, f)) for f in factors]
        if finest < 1.0:
            looked.insert(0, self.maps(*doubled(*shot)))
        maps = looked.pop()
        while looked:
            maps = both(looked.pop(), maps)
        return maps, round(finest * STRIDE)

    def _factor(self, shot: Shot) -> float:
        """By what a whole picture is shrunk in its finest look."""
        longest = max(shot[1].shape)
        return 0.5 if self.size_px >= TWICE * longest else max(1, round(longest / self.size_px))

    def _nearer(self, wood: np.ndarray, scale: int, shape: tuple[int, ...], factor: float) -> tuple[Window, float]:
        """The window that holds all that may be wood (h, w: how likely, each ``scale`` pixels wide) of a picture (H, W)
        and by what it is shrunk there: the nearest look that has room.
        """
        window, at = (0, shape[0], 0, shape[1]), factor
        rows, columns = (np.flatnonzero((wood > MAYBE).any(axis=k)) * scale for k in (1, 0))
        while len(rows) and at > NEAREST:
            at *= 0.5
            sizes = ((round(at * h), round(at * w)) for h, w in WINDOWS)
            found = (_about(rows, columns, scale, round(at * EDGE_PX), size, shape) for size in sizes)
            window, factor = next(((w, at) for w in found if w is not None), (window, factor))
        return window, factor

    def maps(self, rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics) -> np.ndarray:
        """Maps (8, h / 2, w / 2) of a picture of the network's size; padded to what the network takes."""
        image = channels(rgb, depth_m, pinhole, self.variant)
        h, w = image.shape[1:]
        high, wide = -(-h // MULTIPLE) * MULTIPLE, -(-w // MULTIPLE) * MULTIPLE
        padded = np.zeros((1, len(image), high, wide), np.float32)
        padded[0, :, :h, :w] = image
        if (high, wide) not in self._nets:
            self._nets[high, wide] = OpenVinoNet(self._network, self._arrays, padded.shape, self._precision)
        maps = self._nets[high, wide](padded)["maps"][0]
        return maps[:, : -(-h // STRIDE), : -(-w // STRIDE)]


@cache
def _shipped() -> LogSegmenter:
    return LogSegmenter()


def segment(frame: RgbdFrame) -> tuple[Instance, ...]:
    """The logs of a frame by the shipped RGB-D weights; see ``LogSegmenter.segment``."""
    return _shipped().segment(frame)


def _about(
    rows: np.ndarray, columns: np.ndarray, scale: int, edge: int, size: tuple[int, int], shape: tuple[int, ...]
) -> Window | None:
    """The window of a size about places at these rows and columns, each ``scale`` pixels wide, as far as it is in the
    picture (H, W); None where it does not hold them with an ``edge`` about them.
    """
    window: list[int] = []
    for at, long, whole in zip((rows, columns), size, shape, strict=True):
        first, last = int(at[0]), int(at[-1]) + scale
        if last - first + 2 * edge > long < whole:
            return None
        begin = min(max((first + last - long) // 2, 0), max(whole - long, 0))
        window += [begin, min(begin + long, whole)]
    return window[0], window[1], window[2], window[3]


def cut(shot: Shot, window: Window) -> Shot:
    """A window of colours, depth and pinhole."""
    (rgb, depth_m, pinhole), (top, bottom, left, right) = shot, window
    at = slice(top, bottom), slice(left, right)
    return rgb[at], depth_m[at], pinhole.crop(left, top, right - left, bottom - top)


def both(fine: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Maps (8, h, w) of a picture and of the same at half the size as one: votes from the coarse ones, which saw the
    logs as wholes; masks, angles and edges from both, ends from the fine ones.  What is so thin that the coarse ones
    are blind to it is as the fine ones have it.
    """
    h, w = fine.shape[1:]
    y, x = (np.minimum(np.arange(n) // 2, n2 - 1) for n, n2 in ((h, coarse.shape[1]), (w, coarse.shape[2])))
    east, south, *arrow = coarse[[OFFSET_U, OFFSET_V, COS2, SIN2]].take(x, axis=2).take(y, axis=1)
    maps = fine.copy()
    maps[COS2 : SIN2 + 1] += arrow
    pixel = np.float32(STRIDE / OFFSET_PX)
    maps[OFFSET_U] = 2.0 * east + pixel * (2.0 * x + 0.5 - np.arange(w)).astype(np.float32)
    maps[OFFSET_V] = 2.0 * south + pixel * (2.0 * y + 0.5 - np.arange(h)).astype(np.float32)[:, None]
    down, across = (bilinear(n2, 2) for n2 in coarse.shape[1:])
    rows, columns = np.minimum(np.arange(h), len(down) - 1), np.minimum(np.arange(w), len(across) - 1)
    for i, share in ((MASK, MASK_SHARE), (EDGE, EDGE_SHARE)):
        smooth = (down[rows] @ coarse[i] @ across[columns].T).astype(np.float32)
        maps[i] = share * fine[i] + (1.0 - share) * smooth
    wood = fine[MASK] > 0.0
    thin = wood & ~_opened(wood, THIN_PX)
    maps[:, thin] = fine[:, thin]
    return maps


def _opened(wood: np.ndarray, size: int) -> np.ndarray:
    """What of ``wood`` (h, w) bool a square of ``size`` (odd) pixels inside it covers."""
    for grow in (False, True):
        for axis in (0, 1):
            beyond = np.pad(wood, [(size // 2, size // 2) if a == axis else (0, 0) for a in (0, 1)])
            wood = np.full(wood.shape, not grow)
            for i in range(size):
                part = beyond[i : i + len(wood)] if axis == 0 else beyond[:, i : i + wood.shape[1]]
                wood = wood | part if grow else wood & part
    return wood
