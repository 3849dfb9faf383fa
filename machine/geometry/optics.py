"""Pinhole cameras: projection between pixels and points, and the orientation of a camera's axes.

Integer pixel coordinates are pixel centres (as in OpenCV), so the picture spans -0.5..width-0.5.  The optical frame is
x right, y down, z forward; depth is the optical z.  A body frame is x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from machine.profile import Camera

Array = NDArray[Any]

BODY_FROM_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the optical axes x right, y down, z forward in a body frame of x forward, y left, z up."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera: picture size, focal lengths and principal point [px]."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def scaled(self, factor: float) -> Intrinsics:
        """Return the same view sampled with ``factor`` times the pixels along each side (sizes rounded)."""
        return Intrinsics(
            round(self.width_px * factor),
            round(self.height_px * factor),
            self.fx_px * factor,
            self.fy_px * factor,
            (self.cx_px + 0.5) * factor - 0.5,
            (self.cy_px + 0.5) * factor - 0.5,
        )

    def crop(self, left_px: int, top_px: int, width_px: int, height_px: int) -> Intrinsics:
        """Cut a window of this picture; it may extend beyond the picture (a negative left or top pads)."""
        return Intrinsics(width_px, height_px, self.fx_px, self.fy_px, self.cx_px - left_px, self.cy_px - top_px)

    def square(self, size_px: int) -> Intrinsics:
        """Cut the largest centred square, rendered directly at ``size_px``."""
        side = min(self.width_px, self.height_px)
        window = self.crop((self.width_px - side) // 2, (self.height_px - side) // 2, side, side)
        return window.scaled(size_px / side)

    def letterbox(self, size_px: int) -> Letterbox:
        """Fit, as paper B 3.2.2, the whole view inside a square of ``size_px``, padded with black bars."""
        inner = self.scaled(size_px / max(self.width_px, self.height_px))
        left, top = (size_px - inner.width_px) // 2, (size_px - inner.height_px) // 2
        return Letterbox(inner.crop(-left, -top, size_px, size_px), inner, left, top)

    def project(self, points_m: Array) -> Array:
        """Compute the pixels (N, 2) of optical-frame points (N, 3) [m] with positive z."""
        z = points_m[:, 2]
        u = points_m[:, 0] / z * self.fx_px + self.cx_px
        return np.stack([u, points_m[:, 1] / z * self.fy_px + self.cy_px], axis=1)

    def deproject(self, u_px: float, v_px: float, z_m: float) -> Array:
        """Compute the optical-frame point (3,) [m] of a pixel at depth ``z_m``."""
        return np.array([(u_px - self.cx_px) / self.fx_px * z_m, (v_px - self.cy_px) / self.fy_px * z_m, z_m])


@dataclass(frozen=True, slots=True)
class Letterbox:
    """A padded square ``outer`` and the picture ``inner`` inside it, whose corner is at (left, top)."""

    outer: Intrinsics
    inner: Intrinsics
    left_px: int
    top_px: int

    def pad(self, picture: Array, fill: float) -> Array:
        """Make the square with ``picture`` of the inner size in it and ``fill`` in the bars."""
        square = np.full((self.outer.height_px, self.outer.width_px, *picture.shape[2:]), fill, picture.dtype)
        rows = slice(self.top_px, self.top_px + self.inner.height_px)
        square[rows, self.left_px : self.left_px + self.inner.width_px] = picture
        return square


def intrinsics(camera: Camera) -> Intrinsics:
    """Return the pinhole of a profile's camera."""
    c = camera
    return Intrinsics(c.width_px, c.height_px, c.fx_px, c.fy_px, c.cx_px, c.cy_px)


def pinhole(width_px: int, height_px: int, hfov_rad: float) -> Intrinsics:
    """Make a centred pinhole with square pixels and a horizontal field of view."""
    f = width_px / 2 / math.tan(hfov_rad / 2)
    return Intrinsics(width_px, height_px, f, f, (width_px - 1) / 2, (height_px - 1) / 2)


def rpy_matrix(rpy_rad: Sequence[float]) -> Array:
    """Compute the rotation matrix (3, 3) of roll, pitch, yaw about the fixed axes x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy_rad), np.sin(rpy_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
