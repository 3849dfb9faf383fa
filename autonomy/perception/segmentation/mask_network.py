"""The mask network: a light pretrained trunk on the picture at half its size, details at the full size.

Two outputs.  ``maps``, at half the picture's resolution: the eight maps of ``network`` and ``FEATURES`` features
of every pixel.  ``kernels``, at an eighth: how likely a log has its middle there, and the KERNEL numbers that turn
the features of all pixels, and their places relative to it, into the mask of that log (as in CondInst, with one layer
and with squares of the place, so that a kernel can bound a strip).  Logs are masks as wholes: two strips of one log
behind another belong together from the start.

Six channels go in: normalised colour, height over the dominant plane, logarithm of pixels per metre, whether depth is
known.  Colour or depth that is not there is 0, and the network was trained for both.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.networks.graph import Add, AveragePool, BatchNorm, Conv, Layer, Network, Relu, Resize
from autonomy.perception.segmentation.network import (
    HEIGHT_RANGE_M,
    HEIGHT_UNIT_M,
    MAPS,
    normalised_colour,
)
from machine.geometry.optics import Intrinsics

FEATURES: Final = 16
PLACES: Final = 5  # x, y, x squared, x y, y squared, relative to the kernel's place in units of PLACE_PX
KERNEL: Final = FEATURES + PLACES + 1
PLACE_PX: Final = 64.0  # of the network's picture
KERNEL_STRIDE: Final = 8
MULTIPLE: Final = 64
CHANNELS: Final = 6
PIXELS_PER_M_UNIT: Final = 100.0
TRUNK: Final = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2))
"""MobileNetV2 without its last block: expansion, channels, blocks, stride of the first."""
WIDTHS: Final = {64: 64, 32: 64, 16: 64, 8: 64, 4: 32, 2: 16}
"""Channels of the pyramid by stride in the picture."""


def mask_network() -> Network:
    """The network; names of the trunk's layers are those of ``pretrained``."""
    layers: list[Layer] = [AveragePool("half", 2)]
    taps: dict[int, str] = {}

    def conv(
        name: str, out: int, kernel: int = 3, stride: int = 1, groups: int = 1, source: str = "", bend: bool = True
    ) -> str:
        layers.extend((Conv(name, out, kernel, stride, 1, groups, False, source), BatchNorm(f"{name}_norm")))
        if bend:
            layers.append(Relu(f"{name}_relu"))
        return layers[-1].name

    last, width, stride, number = conv("stem", 32, stride=2), 32, 4, 0
    for expansion, out, blocks, first in TRUNK:
        for j in range(blocks):
            number += 1
            step = first if j == 0 else 1
            before, hidden, name = last, expansion * width, f"block{number}"
            if expansion > 1:
                last = conv(f"{name}_wide", hidden, 1, source=last)
            last = conv(f"{name}_depth", hidden, 3, step, hidden, source=last)
            last = conv(f"{name}_out", out, 1, bend=False)
            if step == 1 and out == width:
                layers.append(Add(f"{name}_sum", (last, before)))
                last = f"{name}_sum"
            width, stride = out, stride * step
            taps[stride] = last
    # Top-down pyramid, each level with the trunk's features of its stride.
    at = conv("top", WIDTHS[64], 1, source=taps[64])
    for level in (32, 16, 8, 4):
        layers.extend(
            (
                Conv(f"down{level}", WIDTHS[level], 1, source=at),
                Resize(f"up{level}", 2),
                Conv(f"side{level}", WIDTHS[level], 1, source=taps[level]),
                Add(f"sum{level}", (f"up{level}", f"side{level}")),
            )
        )
        at = conv(f"out{level}", WIDTHS[level])
        if level == KERNEL_STRIDE:
            conv("middle1", 64)
            conv("middle2", 64)
            layers.append(Conv("kernels", 1 + KERNEL, 1))
    # Details at half the picture's resolution, which a trunk of half the size does not see.
    layers.extend((Conv("down2", WIDTHS[2], 1, source="out4_relu"), Resize("up2", 2)))
    conv("detail1", 16, 3, 2, source="input")
    conv("detail2", WIDTHS[2])
    layers.append(Add("sum2", ("up2", "detail2_relu")))
    conv("out2", 24)
    layers.append(Conv("maps", len(MAPS) + FEATURES, 1))
    return Network("logs", CHANNELS, tuple(layers), ("maps", "kernels"))


def mask_input(rgb: np.ndarray | None, depth_m: np.ndarray, pinhole: Intrinsics, height_m: np.ndarray) -> np.ndarray:
    """Input (6, H, W) float32 of a picture; ``rgb`` (H, W, 3) uint8, None without colour; depth NaN where unknown."""
    known = np.isfinite(height_m)
    image = np.zeros((CHANNELS, *height_m.shape), np.float32)
    if rgb is not None:
        normalised_colour(rgb, known, image[:3])
    with np.errstate(invalid="ignore"):
        np.clip(height_m, *HEIGHT_RANGE_M, out=image[3])
        image[3] /= np.float32(HEIGHT_UNIT_M)
        np.log2(np.float32(pinhole.fx_px / PIXELS_PER_M_UNIT) / np.maximum(depth_m, np.float32(0.1)), out=image[4])
    image[5] = known
    image[3:5][:, ~known] = 0.0
    return image
