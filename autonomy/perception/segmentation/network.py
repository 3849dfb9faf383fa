"""The segmentation network: a small U-net with a feature pyramid and eight maps at half the picture's resolution.

Two variants: ``rgbd`` takes colour and depth, ``depth`` takes depth only.  Depth is given as height over the dominant
plane of the picture, which does not depend on range or on the camera's orientation; a second channel marks where it is
known.  The size must be a multiple of 16.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from autonomy.networks import Interface
from autonomy.perception.segmentation.ground_plane import height_over_plane
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused

MAPS: Final = ("mask", "centre", "offset_u", "offset_v", "cos2", "sin2", "ends", "edge")
"""Mask, centre, ends and edge are logits; the offset to the log's centre is in units of OFFSET_PX of the input; the
angle is given by cosine and sine of its double."""
MASK, CENTRE, OFFSET_U, OFFSET_V, COS2, SIN2, ENDS, EDGE = range(8)
STRIDE: Final = 2  # input pixels for each pixel of a map
MULTIPLE: Final = 16
OFFSET_PX: Final = 32.0
CHANNELS: Final = {"rgbd": 5, "depth": 2}
HEIGHT_UNIT_M: Final = 0.25  # of the height channel
MIN_COLOUR_SPREAD: Final = 6.0  # of colours 0..255: the noise of a plain picture is not amplified
MIN_KNOWN_SHARE: Final = 0.1  # of pixels with depth, for the statistics of colour
HEIGHT_RANGE_M: Final = (-0.5, 1.5)


def interface_of(variant: str) -> Interface:
    """Return the network of a variant in CHANNELS; its only output ``maps`` has a channel for each of MAPS.

    Raises:
        InputRefused: the variant is unknown.
    """
    if variant not in CHANNELS:
        raise InputRefused(
            "network.unknown-variant", f"variant {variant!r} is unknown; use one of {', '.join(CHANNELS)}"
        )
    return Interface(f"logs_{variant}", CHANNELS[variant], {"maps": len(MAPS)})


def network_input(
    rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics, variant: str, height_m: np.ndarray | None = None
) -> np.ndarray:
    """Make the input (C, H, W) float32 of a picture: normalised colour, height over the dominant plane, depth known.

    ``rgb`` is (H, W, 3) uint8; ``height_m`` (H, W) is used when it was computed before.
    """
    height = height_over_plane(depth_m, pinhole) if height_m is None else height_m
    known = np.isfinite(height)
    image = np.empty((CHANNELS[variant], *height.shape), np.float32)
    np.clip(height, *HEIGHT_RANGE_M, out=image[-2])
    image[-2] /= np.float32(HEIGHT_UNIT_M)
    image[-2][~known] = 0.0
    image[-1] = known
    if variant == "rgbd":
        normalised_colour(rgb, known, image[:3])
    return image


def normalised_colour(rgb: np.ndarray, known: np.ndarray, out: np.ndarray) -> None:
    """Write colours (3, H, W) of mean 0 and standard deviation 1, which removes exposure and white balance.

    The statistics are those of pixels with depth when there are enough: a bright sky would compress everything else.
    """
    sparse = rgb[::4, ::4].reshape(-1, 3).astype(np.float32)
    solid = known[::4, ::4].ravel()
    if solid.mean() > MIN_KNOWN_SHARE:
        sparse = sparse[solid]
    scale = 1.0 / (sparse.std(axis=0) + MIN_COLOUR_SPREAD)
    out[:] = rgb.transpose(2, 0, 1)
    out -= sparse.mean(axis=0)[:, None, None]
    out *= scale[:, None, None]
