"""The perception of papers A and B, implemented faithfully for comparison."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image
from scipy import ndimage

from autonomy.networks import SHIPPED, Interface, OpenVinoNet, load
from autonomy.perception.camera.frame import Pose, RgbdFrame
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused

# -- Paper A's perception (II-B), implemented faithfully: pose, length and diameter from a mask and a point cloud.
#
# The paper names the steps (masks of a segmentation network "coupled with a point-cloud obtained from a depth
# camera are then combined to infer the length and diameter of the logs, and localize them") but gives no formulas.
# This is how a practitioner reads them: the first principal axis of the cloud is the axis, without the mask's edge,
# where stereo fattens, and without outliers; the diameter is the mean width of the mask; the centre lies behind the
# visible surface; the ends are trimmed.  Where another log hides a part, the mask is too narrow or too short; when the
# diameter comes out greater than the length, the axis is 90 degrees off, as in the paper's two failures (IV).

MIN_POINTS: Final = 16
EDGE_PX: Final = 2
"""Width of the mask's edge."""
OUTLIER_SHARE: Final = 0.05
"""So many of the points are the farthest from the axis, and are left out."""
TRIMMED_SHARE: Final = 0.02
"""So much of the points beyond each end is left out; the length is that of all if they are spread evenly."""


@dataclass(frozen=True, slots=True)
class LogCylinder:
    """Centre (3,) [m] and unit axis (3,) in the optical frame, length and diameter [m]."""

    center_m: np.ndarray
    axis: np.ndarray
    length_m: float
    diameter_m: float


def log_from_mask(frame: RgbdFrame, mask: np.ndarray) -> LogCylinder | None:
    """Measure the log of a mask (H, W) bool; None with fewer than ``MIN_POINTS`` points of known depth."""
    v, u = np.nonzero(ndimage.binary_erosion(mask, iterations=EDGE_PX) & np.isfinite(frame.depth_m))
    if len(u) < MIN_POINTS:
        return None
    pin, z = frame.intrinsics, frame.depth_m[v, u].astype(float)
    cloud = np.stack([(u - pin.cx_px) / pin.fx_px * z, (v - pin.cy_px) / pin.fy_px * z, z], axis=1)
    middle, axis = _principal_axis(cloud)
    off_axis_m = np.linalg.norm(np.cross(cloud - middle, axis), axis=1)
    cloud = cloud[off_axis_m <= np.quantile(off_axis_m, 1.0 - OUTLIER_SHARE)]
    middle, axis = _principal_axis(cloud)
    along_m = np.quantile((cloud - middle) @ axis, (TRIMMED_SHARE, 1.0 - TRIMMED_SHARE))
    metres_per_px = float(middle[2]) / pin.fx_px
    length_m = float(np.ptp(along_m)) / (1.0 - 2.0 * TRIMMED_SHARE) + 2.0 * EDGE_PX * metres_per_px
    width_px = np.count_nonzero(mask) * metres_per_px / length_m
    radius_m = 0.5 * width_px * metres_per_px
    # The points are spread over this share of the width, and lie so deep before the axis on average.
    share = min(max(1.0 - 2.0 * EDGE_PX / width_px, 0.1), 1.0)
    before_axis = 0.5 * (math.sqrt(1.0 - share * share) + math.asin(share) / share)
    sight = middle / np.linalg.norm(middle)
    radial = sight - (sight @ axis) * axis
    center = middle + float(along_m.mean()) * axis + before_axis * radius_m * radial / np.linalg.norm(radial)
    return LogCylinder(center, axis, length_m, 2.0 * radius_m)


def _principal_axis(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the centroid (3,) and the first principal axis (3,) of points (N, 3)."""
    middle = cloud.mean(axis=0)
    return middle, np.linalg.svd(cloud - middle, full_matrices=False)[2][0]


# -- Paper B's vision node (3.2.3), implemented faithfully: a position from a box and the depth at its middle.
#
# The box comes from a detector that sees the picture letterboxed to 608 x 608 (3.2.2).  Depth is the mean over 8 x
# 8 px at the middle of the box.  The pinhole model (equation 2) turns it into a point, the kinematic chain
# transforms the point into the machine's frame, and estimates of one log are averaged.  The result is a point of
# the surface that is seen through the middle of the box: near the log's middle when the log lies across the view,
# and up to three decimetres short of it when the log is seen end-on.

Box = tuple[float, float, float, float]

DETECTOR_PX: Final = 608
DEPTH_WINDOW_PX: Final = 8
MAX_ASSOCIATION_M: Final = 1.5
"""An estimate this close to an average belongs to it; the paper does not state it (assumed)."""


def box_in_picture(box_px: Box, picture: Intrinsics) -> Box:
    """Convert a box (left, top, right, bottom) of the 608 x 608 letterbox to pixels of the original picture."""
    letterbox = picture.letterbox(DETECTOR_PX)
    scale = letterbox.inner.width_px / picture.width_px
    left, top, right, bottom = box_px
    at_u, at_v = letterbox.left_px, letterbox.top_px
    return ((left - at_u) / scale, (top - at_v) / scale, (right - at_u) / scale, (bottom - at_v) / scale)


def position_in_box(frame: RgbdFrame, box_px: Box) -> np.ndarray | None:
    """Compute the point (3,) [m] in the optical frame of the log in a box (left, top, right, bottom; edges of pixels).

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


def centres_of(frame: RgbdFrame, pose: Pose, boxes_px: Iterable[Box], radius_m: float) -> list[np.ndarray]:
    """Compute the points (3,) [m] of the boxes whose middle has a depth, in the frame of ``pose``.

    ``radius_m`` is added along the line of sight, from the surface to the middle (not in the paper).
    """
    points = (position_in_box(frame, box) for box in boxes_px)
    return [pose.to_base(p * (1.0 + radius_m / float(np.linalg.norm(p)))) for p in points if p is not None]


class RunningAverage:
    """The averaged positions of the logs so far."""

    def __init__(self, radius_m: float = 0.0, association_m: float = MAX_ASSOCIATION_M) -> None:
        """Start empty; ``radius_m`` as in `centres_of`."""
        self._radius_m, self._association_m = radius_m, association_m
        self._sums: list[np.ndarray] = []
        self._counts: list[int] = []

    def add(self, frame: RgbdFrame, pose: Pose, boxes_px: list[Box]) -> None:
        """Add the boxes of one frame."""
        for base in centres_of(frame, pose, boxes_px, self._radius_m):
            apart = [float(np.linalg.norm(s / n - base)) for s, n in zip(self._sums, self._counts, strict=True)]
            if apart and min(apart) < self._association_m:
                i = int(np.argmin(apart))
                self._sums[i] = self._sums[i] + base
                self._counts[i] += 1
            else:
                self._sums.append(base)
                self._counts.append(1)

    def positions_m(self) -> list[np.ndarray]:
        """Return one position (3,) [m] for each log."""
        return [s / n for s, n in zip(self._sums, self._counts, strict=True)]


def end_on_error_m(
    near_m: float, far_m: float, height_m: float, diameter_m: float, pitch_rad: float = 0.0
) -> tuple[float, float]:
    """Compute by how much [m] the box's middle lies short of a log's middle, and above it, when the log is seen end-on.

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


# -- A box detector in the role of paper B's (3.2.2): a letterboxed picture of 608 x 608 px in, boxes of logs out.
#
# The paper uses YOLOv3 (62 million parameters).  This is a small network for the same task: at every eighth pixel
# it predicts whether the middle of a log's box is there, and the distances of the box's sides.

SIZE_PX: Final = 608
STRIDE: Final = 8
MIN_SCORE: Final = 0.05
SURE_SCORE: Final = 0.5
"""A box with a lower score is no log: logs within ten metres score 0.7 and more, parts of the machine up to 0.3."""
MAX_OVERLAP: Final = 0.75  # intersection over union of two logs' boxes: those of slanting neighbours overlap a lot
SIDE_COUNT: Final = 4  # left, top, right, bottom: logarithms of distances in STRIDE


BOXES: Final = Interface("log_boxes", 3, {"boxes": 1 + SIDE_COUNT})
"""Colour (3, H, W), about -1..1, in; ``boxes`` (5, H / 8, W / 8) out: a logit and four sides."""


class BoxDetector:
    """The detector with its weights (default: the shipped ones), on one thread.

    Raises:
        InputRefused: the weights are missing, damaged or of another network.
    """

    def __init__(self, weights: Path | None = None, precision: str = "f32") -> None:
        read = load(weights or SHIPPED / "log_boxes.onnx", BOXES)
        self.facts = read.facts
        self._net = OpenVinoNet(read, (1, 3, SIZE_PX, SIZE_PX), precision)

    def detect(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Detect boxes (N, 4) left, top, right, bottom [px] in a picture (608, 608, 3) uint8 and their scores (N,),
        descending.

        Raises:
            InputRefused: the picture has another size or type.
        """
        if rgb.shape != (SIZE_PX, SIZE_PX, 3) or rgb.dtype != np.uint8:
            raise InputRefused(
                "network.bad-picture",
                f"the box detector needs letterboxed pictures of {SIZE_PX} x {SIZE_PX} px, uint8, not {rgb.dtype} of "
                f"shape {rgb.shape}",
            )
        return decode_boxes(self._net(network_input(rgb)[None])["boxes"][0])


@dataclass(frozen=True, slots=True)
class BoxMask:
    """A box as a mask (H, W) bool of whole pixels, with its score 0..1."""

    mask: np.ndarray
    score: float


class BoxSegmenter:
    """Paper B's detector where others segment: every box of a frame is a mask.

    Raises:
        InputRefused: the weights are missing, damaged or of another network.
    """

    def __init__(self) -> None:
        self._detector = BoxDetector()

    def segment(self, frame: RgbdFrame) -> tuple[BoxMask, ...]:
        """Detect the boxes in a frame of any size, which is shrunk to the letterbox of 608 x 608 px."""
        letterbox, picture = frame.intrinsics.letterbox(SIZE_PX), Image.fromarray(frame.rgb)
        inner_size = letterbox.inner.width_px, letterbox.inner.height_px
        if picture.size != inner_size:
            picture = picture.resize(inner_size, Image.Resampling.BOX)
        boxes, scores = self._detector.detect(letterbox.pad(np.asarray(picture), 0))
        masks = []
        for box, score in zip(boxes.tolist(), scores.tolist(), strict=True):
            if score < SURE_SCORE:
                continue
            left, top, right, bottom = (max(0, round(edge)) for edge in box_in_picture(tuple(box), frame.intrinsics))
            mask = np.zeros(frame.depth_m.shape, bool)
            mask[top:bottom, left:right] = True
            masks.append(BoxMask(mask, score))
        return tuple(masks)


def network_input(rgb: np.ndarray) -> np.ndarray:
    """Make the network's input (3, H, W) float32 from a picture (H, W, 3) uint8."""
    return np.ascontiguousarray(rgb.transpose(2, 0, 1), np.float32) * np.float32(1.0 / 127.5) - np.float32(1.0)


def decode_boxes(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decode boxes (N, 4) [px] and scores (N,) of maps (5, h, w): local maxima after non-maximum suppression."""
    score = 1.0 / (1.0 + np.exp(-maps[0]))
    peak = (score >= MIN_SCORE) & (score == ndimage.maximum_filter(score, 3, mode="constant"))
    y, x = np.nonzero(peak)
    order = np.argsort(-score[y, x], kind="stable")
    y, x = y[order], x[order]
    middle = np.stack([x, y], axis=1) * STRIDE + 0.5 * STRIDE
    sides = np.exp(np.clip(maps[1:, y, x].T, -4.0, 5.0)) * STRIDE
    boxes = np.concatenate([middle - sides[:, :2], middle + sides[:, 2:]], axis=1)
    boxes = np.clip(boxes, 0.0, (maps.shape[2] * STRIDE, maps.shape[1] * STRIDE) * 2)
    selected_indices: list[int] = []
    for i in range(len(boxes)):
        if not selected_indices or _overlaps(boxes[i], boxes[selected_indices]).max() < MAX_OVERLAP:
            selected_indices.append(i)
    return boxes[selected_indices], score[y[selected_indices], x[selected_indices]]


def _overlaps(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    shared = np.prod(np.maximum(np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2]), 0.0), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.asarray(np.divide(shared, areas - shared, out=np.zeros_like(shared), where=areas > shared))
