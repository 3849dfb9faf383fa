"""Cylinder fits of all masks of a frame: initial cylinders, visible contours, fits, merged fragments, rejections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.ndimage import label

from autonomy.perception.camera.frame import RgbdFrame, content_window
from autonomy.perception.fitting.contour import Contour, StereoSensor, log_contour
from autonomy.perception.fitting.cylinder import MIN_PIXELS, Cylinder, across_view
from autonomy.perception.fitting.cylinder_fit import CylinderFit, fit_cylinder
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused

# -- Plausibility of fits, and fits that are fragments of one log.
#
# A log that lies behind another one can show as two masks.  Fragments of one log lie on one line, have the same
# width, and miss the ends that face each other.  Paper A's two failures with real logs came from a width greater
# than the length, which turns the axis by 90 degrees: such fits are rejected.


MAX_ANGLE_RAD: Final = math.radians(6.0)  # between the axes of fragments, beside their uncertainty
MAX_GAP_M: Final = 1.5
MAX_RADIUS_DIFFERENCE: Final = 0.35  # of two fragments, as a share of the larger radius
MAX_DIRECTION_SIGMA_RAD: Final = 0.25  # of a usable axis
MIN_RADIUS_M, MAX_RADIUS_M = 0.02, 0.45  # of anything that the crane lifts
MAX_LENGTH_M: Final = 8.0  # of logs that a crane loads
MIN_EXPLAINED: Final = 0.5  # share of the contour


@dataclass(frozen=True, slots=True)
class Implausibility:
    """Why a fit is not a log."""

    code: str
    sentence: str


def implausibility(fit: CylinderFit) -> Implausibility | None:
    """Tell why a fit is not a log; None when it is plausible."""
    body = fit.body
    if 2.0 * body.radius_m >= body.length_m:
        return Implausibility("too-wide", f"{2 * body.radius_m:.2f} m wide and {body.length_m:.2f} m long: not a log")
    if not MIN_RADIUS_M <= body.radius_m <= MAX_RADIUS_M:
        return Implausibility("bad-width", f"{2 * body.radius_m:.2f} m wide: outside the range of logs")
    if body.length_m > MAX_LENGTH_M:
        return Implausibility("too-long", f"{body.length_m:.1f} m long: longer than any log")
    if fit.explained < MIN_EXPLAINED:
        return Implausibility("bad-contour", f"a cylinder explains only {100 * fit.explained:.0f} % of its contour")
    if math.sqrt(max(np.diag(fit.covariance)[2:4].max(), 0.0)) > MAX_DIRECTION_SIGMA_RAD:
        return Implausibility("unknown-direction", "too little of it is visible to determine its direction")
    return None


def same_log(a: CylinderFit, b: CylinderFit) -> bool:
    """Tell whether two fits are fragments of one log whose middle is hidden."""
    body_a, body_b = a.body, b.body
    between = body_b.center_m - body_a.center_m
    direction = between / max(1e-9, float(np.linalg.norm(between)))
    tilt = MAX_ANGLE_RAD + 2.0 * math.sqrt(max(np.diag(a.covariance)[2:4].max(), 0.0))
    tilt_b = MAX_ANGLE_RAD + 2.0 * math.sqrt(max(np.diag(b.covariance)[2:4].max(), 0.0))
    # The shorter a fragment, the less certain its own axis: the line between the middles must lie along both.
    if _angle(body_a.axis, direction) > tilt or _angle(body_b.axis, direction) > tilt_b:
        return False
    wide, narrow = max(body_a.radius_m, body_b.radius_m), min(body_a.radius_m, body_b.radius_m)
    if wide - narrow > MAX_RADIUS_DIFFERENCE * wide:
        return False
    gap = float(np.linalg.norm(between)) - 0.5 * (body_a.length_m + body_b.length_m)
    facing_a = a.ends_seen[1] if body_a.axis @ direction > 0.0 else a.ends_seen[0]
    facing_b = b.ends_seen[0] if body_b.axis @ direction > 0.0 else b.ends_seen[1]
    return gap < MAX_GAP_M and not facing_a and not facing_b


def joined_cylinder(a: Cylinder, b: Cylinder) -> Cylinder:
    """Make the initial cylinder of a log with two fragments: from the far end of one to the far end of the other."""
    direction = b.center_m - a.center_m
    ends = np.concatenate([_ends(a), _ends(b)])
    along = ends @ direction
    start, end = ends[np.argmin(along)], ends[np.argmax(along)]
    length = float(np.linalg.norm(end - start))
    radius = (a.radius_m * a.length_m + b.radius_m * b.length_m) / (a.length_m + b.length_m)
    return Cylinder(0.5 * (start + end), (end - start) / length, -0.5 * length, 0.5 * length, radius)


def fragment_groups(fits: Mapping[int, CylinderFit]) -> list[list[int]]:
    """List the numbers of the fits, in groups of one log each; the numbers ascend."""
    owner = {i: i for i in fits}
    for i in owner:
        for j in owner:
            if i < j and owner[i] != owner[j] and same_log(fits[i], fits[j]):
                old = owner[j]
                owner.update({k: owner[i] for k, group in owner.items() if group == old})
    return [[i for i in owner if owner[i] == group] for group in sorted(set(owner.values()))]


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.acos(min(1.0, abs(float(a @ b))))


def _ends(body: Cylinder) -> np.ndarray:
    return np.stack([body.point_m + body.start_m * body.axis, body.point_m + body.end_m * body.axis])


# -- The initial cylinder of a fit, from a mask and its depth.
#
# Stereo depth errs by about z^2 sigma_d / (f B), and neighbouring pixels err alike: at 5 m by as much as half a
# log's radius.  Surface normals of single points are useless at that noise.  Therefore the radius comes from the
# width of the mask and the tilt from a line through disparities.


RANSAC_PAIRS: Final = 48
_EPSILON: Final = 1e-12


def initial_cylinder(
    mask: np.ndarray, depth_m: np.ndarray, pin: Intrinsics, slack_1_m: float, seed: int = 0
) -> Cylinder | None:
    """Estimate a cylinder from a mask (H, W) bool and depth (H, W) [m]; None when too little depth is known.

    The axis in the picture is the mask's principal axis.  A line through inverse depth along it is found by RANSAC over
    ``RANSAC_PAIRS`` pairs with inliers within ``slack_1_m`` [1/m].  The radius is half the mask's width.
    """
    v, u = np.nonzero(mask)
    if len(u) < MIN_PIXELS:
        return None
    middle = np.array([u.mean(), v.mean()])
    du, dv = u - middle[0], v - middle[1]
    values, vectors = np.linalg.eigh(np.array([[du @ du, du @ dv], [du @ dv, dv @ dv]]) / len(u))
    direction = vectors[:, 1]
    along, inverse = du * direction[0] + dv * direction[1], 1.0 / depth_m[v, u]
    known = np.isfinite(inverse)
    if np.count_nonzero(known) < MIN_PIXELS:
        return None
    a, b = ransac_line(along[known], inverse[known], slack_1_m, seed)
    low, high = float(along.min()) - 0.5, float(along.max()) + 0.5
    width_px = min(len(u) / (high - low), math.sqrt(12.0 * max(values[0], 0.1)) * 1.3)
    far = 0.02 * max(a, 0.02)

    def axis_point(t: float) -> np.ndarray:
        return pin.deproject(middle[0] + t * direction[0], middle[1] + t * direction[1], 1.0 / max(a + b * t, far))

    span = axis_point(high) - axis_point(low)
    mid = axis_point(0.5 * (low + high))
    # Seen along its axis, the mask extends beyond the middle of both ends by the visible part of the end faces.
    slant = abs(float(span @ mid)) / float(np.linalg.norm(span) * np.linalg.norm(mid))
    inset = min(0.5 * width_px * slant, 0.4 * (high - low))
    start, end = axis_point(low + inset), axis_point(high - inset)
    mid = 0.5 * (start + end)
    axis, length = end - start, float(np.linalg.norm(end - start))
    if not math.isfinite(length) or length < 1e-6:
        return None
    axis /= length
    radius = 0.5 * width_px * float(mid[2]) / pin.fx_px
    deeper = across_view(axis, mid)[1]
    mid = mid + radius * deeper * math.copysign(1.0, float(deeper @ mid))
    return Cylinder(mid, axis, -0.5 * length, 0.5 * length, radius)


def ransac_line(x: np.ndarray, y: np.ndarray, slack: float, seed: int) -> tuple[float, float]:
    """Find a (intercept) and b (slope) of y = a + b x through most points: RANSAC, then least squares over inliers."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, len(x), (2, RANSAC_PAIRS))
    apart = x[j] - x[i]
    ok = np.abs(apart) > 0.2 * (x.max() - x.min())
    slopes = np.where(ok, (y[j] - y[i]) / np.where(ok, apart, 1.0), 0.0)
    starts = np.where(ok, y[i] - slopes * x[i], np.median(y))
    step = max(1, len(x) // 100)
    counts = np.count_nonzero(np.abs(y[::step] - starts[:, None] - slopes[:, None] * x[::step]) < slack, axis=1)
    best = int(np.argmax(counts))
    inside = np.abs(y - starts[best] - slopes[best] * x) < slack
    x, y = x[inside], y[inside]
    if len(x) < 3:
        return float(starts[best]), float(slopes[best])
    from_middle = x - x.mean()
    slope = float(from_middle @ y) / max(float(from_middle @ from_middle), _EPSILON)
    return float(y.mean()) - slope * float(x.mean()), slope


# -- Cylinder fits of all masks of a frame


MARGIN_PX: Final = 8  # of the window that is cut out around a mask


class Masked(Protocol):
    """An instance with a mask (H, W) bool."""

    @property
    def mask(self) -> np.ndarray: ...


@dataclass(frozen=True, slots=True)
class Rejection:
    """A mask, by its index in the list, that gave no log, and the reason (``code`` and ``sentence``)."""

    instance: int
    code: str
    sentence: str


def measure(
    frame: RgbdFrame, masks: Sequence[np.ndarray], sensor: StereoSensor
) -> tuple[list[CylinderFit], list[Rejection]]:
    """Fit all masks, with fragments of one log merged, and list the rejected masks.

    Raises:
        InputRefused: a mask is not bool or not of the frame's size.
    """
    scene = _MaskedFrame.of(frame, masks, sensor)
    initial = {i: scene.initial(i) for i in range(len(masks))}
    too_long = [i for i, body in initial.items() if body is not None and body.length_m > MAX_LENGTH_M]
    if too_long:  # a log, and something else in line with it
        scene = _MaskedFrame.of(frame, [_largest_part(m) if i in too_long else m for i, m in enumerate(masks)], sensor)
        initial |= {i: scene.initial(i) for i in too_long}
    known = {i: body for i, body in initial.items() if body is not None}
    contours = {i: scene.contour([i], body, known) for i, body in known.items()}
    fits: dict[int, CylinderFit] = {}
    # The largest mask first: its log hides others and is hidden least itself.
    for i in sorted(known, key=lambda i: -scene.areas[i]):
        fit = scene.fit([i], known[i], contours[i], fits)
        if fit is not None:
            fits[i] = fit
    unfitted = [i for i in range(len(masks)) if i not in fits]
    rejections = [Rejection(i, "too-little-depth", "too little of its depth is known") for i in unfitted]
    accepted = []
    for group in fragment_groups(dict(sorted(fits.items()))):
        fit = fits[group[0]]
        if len(group) > 1:
            body = fit.body
            for i in group[1:]:
                body = joined_cylinder(body, fits[i].body)
            fit = scene.fit(group, body, scene.contour(group, body, known), fits) or fit
        reason = implausibility(fit)
        if reason:
            rejections.append(Rejection(group[0], reason.code, reason.sentence))
        else:
            accepted.append(fit)
    return accepted, rejections


def _largest_part(mask: np.ndarray) -> np.ndarray:
    """Find the largest connected part of a mask (H, W)."""
    parts, count = label(mask)
    return mask if count < 2 else np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))


@dataclass(frozen=True, slots=True)
class _MaskedFrame:
    """A frame with numbered masks and the window without black bars."""

    frame: RgbdFrame
    labels: np.ndarray
    areas: tuple[int, ...]
    boxes: tuple[tuple[int, int, int, int], ...]
    window: tuple[int, int, int, int]
    sensor: StereoSensor

    @classmethod
    def of(cls, frame: RgbdFrame, masks: Sequence[np.ndarray], sensor: StereoSensor) -> _MaskedFrame:
        labels = np.zeros(frame.depth_m.shape, np.int16)
        areas: list[int] = []
        boxes: list[tuple[int, int, int, int]] = []
        top, bottom, left, right = content_window(frame.rgb)
        for i, mask in enumerate(masks):
            if mask.shape != labels.shape or mask.dtype != bool:
                raise InputRefused(
                    "frame.bad-mask",
                    f"mask {i} is {mask.dtype} of shape {mask.shape} instead of bool of the frame's {labels.shape}",
                )
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            if not len(rows):
                areas.append(0)
                boxes.append((0, 0, 0, 0))
                continue
            box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
            part = mask[box[1] : box[3], box[0] : box[2]]
            labels[box[1] : box[3], box[0] : box[2]][part] = i + 1
            areas.append(int(np.count_nonzero(part)))
            boxes.append(box)
        return cls(frame, labels, tuple(areas), tuple(boxes), (left, top, right, bottom), sensor)

    def _crop(self, group: list[int]) -> tuple[int, int, int, int]:
        boxes = [self.boxes[i] for i in group]
        height, width = self.labels.shape
        left, top = max(0, min(b[0] for b in boxes) - MARGIN_PX), max(0, min(b[1] for b in boxes) - MARGIN_PX)
        return (
            left,
            top,
            min(width, max(b[2] for b in boxes) + MARGIN_PX),
            min(height, max(b[3] for b in boxes) + MARGIN_PX),
        )

    def initial(self, i: int) -> Cylinder | None:
        """Estimate the initial cylinder of mask ``i``."""
        mask, depth_m, _, pin, _ = self._part([i])
        return initial_cylinder(mask, depth_m, pin, 3.0 * self.sensor.sigma_d_px / self.sensor.fb_px_m)

    def contour(self, group: list[int], first: Cylinder, known: dict[int, Cylinder]) -> Contour:
        """Find the contour of one or several masks as one log, classified with the initial cylinders ``known``."""
        mask, depth_m, labels, pin, (left, top) = self._part(group)
        content = self.window
        window = (content[0] - left, content[1] - top, content[2] - left, content[3] - top)
        others = {i + 1: body for i, body in known.items() if i not in group}
        return log_contour(mask, depth_m, pin, first, self.sensor, window, labels, others)

    def fit(
        self, group: list[int], first: Cylinder, contour: Contour, fits: dict[int, CylinderFit]
    ) -> CylinderFit | None:
        """Fit one or several masks as one log; ``fits`` are those of all masks so far."""
        mask, depth_m, _, pin, _ = self._part(group)
        fitted = {i + 1: fits[i].body for i in sorted(fits) if i not in group}
        return fit_cylinder(mask, depth_m, pin, first, contour.without(fitted, pin), self.sensor)

    def _part(self, group: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, Intrinsics, tuple[int, int]]:
        """Return mask, depth, numbers of all masks, pinhole and top left corner of a group's part of the picture."""
        left, top, right, bottom = self._crop(group)
        labels, depth_m = self.labels[top:bottom, left:right], self.frame.depth_m[top:bottom, left:right]
        pin = self.frame.intrinsics.crop(left, top, right - left, bottom - top)
        mask = labels == group[0] + 1
        for i in group[1:]:
            mask |= labels == i + 1
        return mask, depth_m, labels, pin, (left, top)
