"""Scaling of pictures with depth; pixel areas correspond, so that the ray of a pixel centre is preserved."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from machine.geometry.optics import Intrinsics


def shrunk(
    rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics, factor: int
) -> tuple[np.ndarray, np.ndarray, Intrinsics]:
    """Shrink the picture with every ``factor`` x ``factor`` block as one pixel: mean colour, depth of its middle pixel.

    A mean of depth would create points between near and far.  Incomplete blocks at the right and lower border are
    dropped.
    """
    if factor == 1:
        return rgb, depth_m, pinhole
    h, w = rgb.shape[0] // factor, rgb.shape[1] // factor
    middle = factor // 2
    depth = depth_m[middle : h * factor : factor, middle : w * factor : factor]
    small = pinhole.scaled(1.0 / factor)
    small = Intrinsics(w, h, small.fx_px, small.fy_px, small.cx_px, small.cy_px)
    return _means(rgb[: h * factor, : w * factor], factor), depth, small


def _means(rgb: np.ndarray, factor: int) -> np.ndarray:
    """Compute mean colours (H / factor, W / factor, 3) uint8 of blocks, rounded down."""
    wide: type[np.uint16 | np.uint32] = np.uint16 if factor <= 16 else np.uint32  # 16 x 16 x 255 fits into 16 bits
    rows: np.ndarray = rgb[::factor].astype(wide)
    for i in range(1, factor):
        rows += rgb[i::factor]
    means = np.empty((len(rows), rows.shape[1] // factor, 3), np.uint8)
    for colour in range(3):  # one at a time: numpy is several times faster along one stride
        total: np.ndarray = rows[:, ::factor, colour].copy()
        for j in range(1, factor):
            total += rows[:, j::factor, colour]
        means[:, :, colour] = total // wide(factor * factor)
    return means


def doubled(rgb: np.ndarray, depth_m: np.ndarray, pinhole: Intrinsics) -> tuple[np.ndarray, np.ndarray, Intrinsics]:
    """Return the picture at twice the size: colour interpolated, depth repeated."""
    return interpolated(rgb), repeated(depth_m), pinhole.scaled(2.0)


def repeated(values: np.ndarray) -> np.ndarray:
    """Repeat (H, W) to (2 H, 2 W)."""
    return values.repeat(2, axis=0).repeat(2, axis=1)


def interpolated(rgb: np.ndarray) -> np.ndarray:
    """Interpolate (H, W, 3) uint8 to (2 H, 2 W, 3), linear between pixel centres; the border repeats."""
    wide = rgb.astype(np.uint16)
    for axis in (0, 1):
        near = 3 * wide
        before = np.concatenate([wide.take([0], axis), wide.take(range(wide.shape[axis] - 1), axis)], axis)
        after = np.concatenate([wide.take(range(1, wide.shape[axis]), axis), wide.take([-1], axis)], axis)
        shape = list(wide.shape)
        shape[axis] *= 2
        wide = np.stack([(near + before + 2) // 4, (near + after + 2) // 4], axis + 1).reshape(shape)
    return wide.astype(np.uint8)


def interpolated_map(values: np.ndarray) -> np.ndarray:
    """Interpolate (H, W) float32 to (2 H, 2 W), linear between pixel centres; the border repeats.

    The matrices of `bilinear` give the same and take three times as long: all but two of a row's entries are zeros.
    """
    for _ in (0, 1):  # once along each axis: the transpose comes back the second time
        near, quarter = np.float32(0.75) * values, np.float32(0.25) * values
        fine = np.empty((2 * len(values), values.shape[1]), np.float32)
        fine[0::2], fine[1::2] = near, near
        fine[2::2] += quarter[:-1]
        fine[0] += quarter[0]
        fine[1:-1:2] += quarter[1:]
        fine[-1] += quarter[-1]
        values = fine.T
    return values


@lru_cache(maxsize=512)
def bilinear(size: int, scale: int) -> np.ndarray:
    """Make a matrix (size * scale, size) float32: linear interpolation between pixel centres, the border repeated."""
    at = np.clip((np.arange(size * scale) + 0.5) / scale - 0.5, 0.0, size - 1.0)
    low = np.minimum(at.astype(int), max(size - 2, 0))
    share = (at - low).astype(np.float32)
    matrix = np.zeros((size * scale, size), np.float32)
    rows = np.arange(size * scale)
    matrix[rows, low] = 1.0 - share
    if size > 1:
        matrix[rows, low + 1] += share
    return matrix
