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

from autonomy.networks import Interface
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
MASKS: Final = Interface("logs", CHANNELS, {"maps": len(MAPS) + FEATURES, "kernels": 1 + KERNEL})


def mask_input(rgb: np.ndarray | None, depth_m: np.ndarray, pinhole: Intrinsics, height_m: np.ndarray) -> np.ndarray:
    """Make a picture's input (6, H, W) float32; ``rgb`` (H, W, 3) uint8, None without colour; depth NaN if unknown."""
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
