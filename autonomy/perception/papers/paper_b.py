"""Paper B's vision node (3.2.3), implemented faithfully: a position from a box and the depth at its middle.

The box comes from a detector that sees the picture letterboxed to 608 x 608 (3.2.2).  Depth is the mean over 8 x 8 px
at the middle of the box.  The pinhole model (equation 2) turns it into a point, the kinematic chain transforms the
point into the machine's frame, and estimates of one log are averaged.  The result is a point of the surface that is
seen through the middle of the box: near the log's middle when the log lies across the view, and up to three decimetres
short of it when the log is seen end-on.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame
from machine.geometry.optics import Intrinsics

Box = tuple[float, float, float, float]

DETECTOR_PX: Final = 608
DEPTH_WINDOW_PX: Final = 8
MAX_ASSOCIATION_M: Final = 1.5
"""An estimate this close to an average belongs to it; the paper does not state it (assumed)."""


def box_in_picture(box_px: Box, picture: Intrinsics) -> Box:
    """A box (left, top, right, bottom) of the 608 x 608 letterbox in pixels of the original picture."""
    letterbox = picture.letterbox(DETECTOR_PX)
    scale = letterbox.inner.width_px / picture.width_px
    left, top, right, bottom = box_px
    at_u, at_v = letterbox.left_px, letterbox.top_px
    return ((left - at_u) / scale, (top - at_v) / scale, (right - at_u) / scale, (bottom - at_v) / scale)


def position_in_box(frame: RgbdFrame, box_px: Box) -> np.ndarray | None:
    """Point (3,) [m] in the optical frame of the log in a box (left, top, right, bottom; edges of pixels).

    None when none of the 8 x 8 px has depth or the middle of the box is outside the picture.
    """
    u, v = 0.5 * (box_px[0] + box_px[2]) - 0.5, 0.5 * (box_px[1] + box_px[3]) - 0.5
    height, width = frame.depth_m.shape
    if not (0.0 <= u <= width - 1 and 0.0 <= v <= height - 1):
        return None
    left, top = round(u - 0.5 * DEPTH_WINDOW_PX + 0.5), round(v - 0.5 * DEPTH_WINDOW_PX + 0.5)
    window = frame.depth_m[max(0, top) : top + DEPTH_WINDOW_PX, max(0, left) : left + DEPTH_WINDOW_PX]
    known = window[np.isfinite(window)]
    return frame.intrinsics.deproject(u, v, float(known.mean())) if len(known) else None


class RunningAverage:
    """The averaged positions of the logs so far."""

    def __init__(self, radius_m: float = 0.0, association_m: float = MAX_ASSOCIATION_M) -> None:
        """``radius_m`` is added along the line of sight, from the surface to the middle (not in the paper)."""
        self._radius_m, self._association_m = radius_m, association_m
        self._sums: list[np.ndarray] = []
        self._counts: list[int] = []

    def add(self, frame: RgbdFrame, pose: Pose, boxes_px: list[Box]) -> None:
        """Add the boxes of one frame."""
        for box in boxes_px:
            point = position_in_box(frame, box)
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
        """One position (3,) [m] for each log."""
        return [s / n for s, n in zip(self._sums, self._counts, strict=True)]


def end_on_error_m(
    near_m: float, far_m: float, height_m: float, diameter_m: float, pitch_rad: float = 0.0
) -> tuple[float, float]:
    """Distance [m] by which the box's middle lies short of a log's middle, and above it, when the log is seen end-on.

    Closed form.  The log lies on level ground along the line of sight, its ends ``near_m`` and ``far_m`` ahead of a
    camera ``height_m`` above the ground that is pitched down by ``pitch_rad``.  The box extends from the lower edge of
    the near end to the upper edge of the far end.  Equal steps in the picture are equal steps in inverse distance, so
    the box's middle lies near the harmonic mean of the distances, and shows the upper surface (or, in a steeper view,
    the near end).
    """
    top_m = height_m - diameter_m
    rows = [math.tan(math.atan2(h, d) - pitch_rad) for h, d in ((height_m, near_m), (top_m, far_m))]
    slope = math.tan(math.atan(0.5 * sum(rows)) + pitch_rad)
    ahead_m = max(near_m, top_m / slope)
    return 0.5 * (near_m + far_m) - ahead_m, height_m - slope * ahead_m - 0.5 * diameter_m
