"""The network that finds logs: a small U-net with a pyramid's merge, eight maps at half the picture's resolution.

Two variants: ``rgbd`` sees colour and depth, ``depth`` only depth.  Depth goes in as height over the picture's
prevailing plane, which does not depend on range or on how the camera stands; where it is unknown a second channel says
so.  Any size that is a multiple of 16 will do.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.networks.graph import Add, BatchNorm, Conv, Layer, Network, Relu, Resize
from autonomy.perception.segmentation.ground_plane import height_over_plane
from machine.geometry.optics import Intrinsics

MAPS: Final = ("mask", "centre", "offset_u", "offset_v", "cos2", "sin2", "ends", "edge")
"""Mask, centre, ends and edge are logits; the offset to the log's centre is in OFFSET_PX of the input; the angle's
double as cosine and sine."""
MASK, CENTRE, OFFSET_U, OFFSET_V, COS2, SIN2, ENDS, EDGE = range(8)
STRIDE: Final = 2  # input pixels for each pixel of a map
MULTIPLE: Final = 16
OFFSET_PX: Final = 32.0
CHANNELS: Final = {"rgbd": 5, "depth": 2}
HEIGHT_M: Final = 0.25  # one unit of the height channel
LEAST_SPREAD: Final = 6.0  # of colours 0..255: a plain picture's grain is not blown up
LEAST_KNOWN: Final = 0.1
CLIP_M: Final = (-0.5, 1.5)


def unet(variant: str) -> Network:
    """The network of a variant in CHANNELS; its one output ``maps`` has a channel for each of MAPS.

    Raises:
        ValueError: no such variant.
    """
    if variant not in CHANNELS:
        raise ValueError(f"variant {variant!r} is unknown; use one of {', '.join(CHANNELS)}")
    layers: list[Layer] = []

    def conv(name: str, out: int, kernel: int = 3, stride: int = 1, dilation: int = 1, source: str = "") -> str:
        layers.append(Conv(name, out, kernel, stride, dilation, bias=False, source=source))
        layers.extend((BatchNorm(f"{name}_norm"), Relu(f"{name}_relu")))
        return f"{name}_relu"

    def more(name: str, out: int, dilation: int = 1) -> None:
        """A step beside what it adds to."""
        before = layers[-1].name
        layers.append(Conv(name, out, 3, 1, dilation, bias=False))
        layers.extend((BatchNorm(f"{name}_norm"), Add(f"{name}_sum", (f"{name}_norm", before))))

    def up(name: str, out: int) -> str:
        layers.append(Conv(name, out, 1))
        layers.append(Resize(f"{name}_up", 2))
        return f"{name}_up"

    conv("in2", 16, stride=2)
    at2 = conv("at2", 16)
    conv("in4", 32, stride=2)
    at4 = conv("at4", 32)
    conv("in8", 48, stride=2)
    at8 = conv("at8", 48)
    conv("in16", 96, stride=2)
    conv("at16", 96)
    more("more16", 96, dilation=2)
    # A log may be longer than the picture is wide: its middle is seen from far away.
    conv("wide16", 96, dilation=4)
    conv("wider16", 96, dilation=8)
    layers.append(Add("sum8", (up("to8", 48), at8)))
    conv("out8", 48)
    more("more8", 48)
    layers.append(Add("sum4", (up("to4", 32), at4)))
    conv("out4", 32)
    layers.append(Add("sum2", (up("to2", 16), at2)))
    conv("out2", 24)
    layers.append(Conv("maps", len(MAPS), 1))
    return Network(f"logs_{variant}", CHANNELS[variant], tuple(layers), ("maps",))


def channels(
    rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics, variant: str, height_m: np.ndarray | None = None
) -> np.ndarray:
    """Input (C, H, W) float32 of a picture: rgb (H, W, 3) uint8 made standard, height over the plane (``height_m``
    where it is known beforehand), depth known."""
    height = height_over_plane(depth_m, pinhole) if height_m is None else height_m
    known = np.isfinite(height)
    image = np.empty((CHANNELS[variant], *height.shape), np.float32)
    np.clip(height, *CLIP_M, out=image[-2])
    image[-2] /= np.float32(HEIGHT_M)
    image[-2][~known] = 0.0
    image[-1] = known
    if variant == "rgbd":
        _standard_colour(rgb, known, image[:3])
    return image


def _standard_colour(rgb: np.ndarray, known: np.ndarray, out: np.ndarray) -> None:
    """Colours (3, H, W) of mean 0 and spread 1: what exposure and white balance do is gone.  Only what has a depth
    counts where enough has one: a bright sky would press everything else together."""
    sparse = rgb[::4, ::4].reshape(-1, 3).astype(np.float32)
    solid = known[::4, ::4].ravel()
    if solid.mean() > LEAST_KNOWN:
        sparse = sparse[solid]
    scale = 1.0 / (sparse.std(axis=0) + LEAST_SPREAD)
    out[:] = rgb.transpose(2, 0, 1)
    out -= sparse.mean(axis=0)[:, None, None]
    out *= scale[:, None, None]
