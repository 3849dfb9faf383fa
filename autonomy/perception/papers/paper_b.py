"""Paper B's vision node (3.2.3), faithfully: a box and the depth at its middle give a position, and no more.

The box comes from a detector that sees the picture letterboxed to 608 x 608 (3.2.2).  Depth is the mean over 8 x 8 px
at the box's middle; the pinhole (equation 2) makes a point of it; the kinematic chain carries it into the machine's
frame; estimates of one log are averaged.  What it says is a point of the surface seen through the middle of the box:
near the log's middle when it lies across the view, and up to three decimetres short of it when it is seen end-on.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame
from machine.geometry.optics import Intrinsics

Box = tuple[float, float, float, float]

DETECTOR_PX: Final = 608
WINDOW_PX: Final = 8
ASSOCIATION_M: Final = 1.5
"""Estimates so near an average belong to it; the paper does not say (assumed)."""


def in_picture(box_px: Box, picture: Intrinsics) -> Box:
    """A box (left, top, right, bottom) of the 608 x 608 letterbox in pixels of the picture it was made of."""
    letterbox = picture.letterbox(DETECTOR_PX)
    scale = letterbox.inner.width_px / picture.width_px
    left, top, right, bottom = box_px
    at_u, at_v = letterbox.left_px, letterbox.top_px
    return ((left - at_u) / scale, (top - at_v) / scale, (right - at_u) / scale, (bottom - at_v) / scale)


def position_of(frame: RgbdFrame, box_px: Box) -> np.ndarray | None:
    """Point (3,) [m] in the optical frame of the log in a box (left, top, right, bottom; edges of pixels) of the
    frame; None where none of the 8 x 8 px has depth or the box's middle is outside."""
    u, v = 0.5 * (box_px[0] + box_px[2]) - 0.5, 0.5 * (box_px[1] + box_px[3]) - 0.5
    height, width = frame.depth_m.shape
    if not (0.0 <= u <= width - 1 and 0.0 <= v <= height - 1):
        return None
    left, top = round(u - 0.5 * WINDOW_PX + 0.5), round(v - 0.5 * WINDOW_PX + 0.5)
    window = frame.depth_m[max(0, top) : top + WINDOW_PX, max(0, left) : left + WINDOW_PX]
    known = window[np.isfinite(window)]
    return frame.intrinsics.deproject(u, v, float(known.mean())) if len(known) else None


class RunningAverage:
    """The averaged positions of the logs so far."""

    def __init__(self, radius_m: float = 0.0, association_m: float = ASSOCIATION_M) -> None:
        """``radius_m`` is added along the line of sight: the surface is seen, the middle wanted (not in the paper)."""
        self._radius_m, self._association_m = radius_m, association_m
        self._sums: list[np.ndarray] = []
        self._counts: list[int] = []

    def add(self, frame: RgbdFrame, pose: Pose, boxes_px: list[Box]) -> None:
        """Take the boxes of one frame in."""
        for box in boxes_px:
            point = position_of(frame, box)
            if point is None:
                continue
            base = pose.to_base(point * (1.0 + self._radius_m / float(np.linalg.norm(point))))
            apart = [float(np.linalg.norm(s / n - base)) for s, n in zip(self._sums, self._counts, strict=True)]
            if apart and min(apart) < self._association_m:
                i = int(np.argmin(apart))
                self._sums[i] = self._sums[i] + base
                self._counts[i] += 1
            else:
                self._sums.append(base)
                self._counts.append(1)

    def positions_m(self) -> list[np.ndarray]:
        """One position (3,) [m] a log."""
        return [s / n for s, n in zip(self._sums, self._counts, strict=True)]


def end_on_error_m(
    near_m: float, far_m: float, height_m: float, diameter_m: float, pitch_rad: float = 0.0
) -> tuple[float, float]:
    """How far short of a log's middle, and how high above it, the box's middle lies when the log is seen end-on [m].

    In closed form: the log lies on level ground along the line of sight, its ends ``near_m`` and ``far_m`` ahead of a
    camera ``height_m`` above the ground that looks down by ``pitch_rad``.  The box reaches from the lower rim of the
    near end to the upper rim of the far one.  Equal steps in the picture are steps in the inverse of the distance, so
    the box's middle lies near the harmonic mean of the distances, and what is seen there is the upper surface (or, in
    a steeper view, the near end).
    """
    top_m = height_m - diameter_m
    rows = [math.tan(math.atan2(h, d) - pitch_rad) for h, d in ((height_m, near_m), (top_m, far_m))]
    slope = math.tan(math.atan(0.5 * sum(rows)) + pitch_rad)
    ahead_m = max(near_m, top_m / slope)
    return 0.5 * (near_m + far_m) - ahead_m, height_m - slope * ahead_m - 0.5 * diameter_m
