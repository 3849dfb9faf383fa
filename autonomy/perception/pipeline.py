"""From a picture with its masks to logs with identities: fit, refine, join pieces, refuse what is none, track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

import numpy as np
from scipy.ndimage import label

from autonomy.perception.camera.frame import Pose, RgbdFrame, RgbdFrameError, check, content_window
from autonomy.perception.fitting.contour import Contour, StereoSensor, log_contour
from autonomy.perception.fitting.cylinder import Cylinder, initial_cylinder
from autonomy.perception.fitting.cylinder_fit import CylinderFit, fit_cylinder
from autonomy.perception.fitting.log_fragments import LONGEST_M, groups, joined, refused
from autonomy.perception.tracking.displacement import is_displaced
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors, Track
from autonomy.perception.tracking.log_tracker import LogTracker
from machine.geometry.optics import Intrinsics
from machine.profile import Profile

MARGIN_PX: Final = 8  # of the window that is cut out around a mask
STEEPEST: Final = 0.5
"""Sine of the angle to the level from which on a thing is no log but a tong of the crane, a stump, a tree: what stands
so is not gripped either."""
SIGMA_D_PX: Final = 0.2  # of stereo disparity, assumed


class Masked(Protocol):
    """What is needed of an instance: its mask (H, W) bool."""

    @property
    def mask(self) -> np.ndarray: ...


@dataclass(frozen=True, slots=True)
class Refusal:
    """A mask, by its place in the list, that became no log, and why."""

    instance: int
    why: str


class Perception:
    """Logs from the frames of a machine's cameras."""

    def __init__(self, profile: Profile, errors: CameraErrors = NOMINAL_ERRORS) -> None:
        self._sensors = {
            name: StereoSensor(camera.fx_px * camera.baseline_m, SIGMA_D_PX) for name, camera in profile.cameras.items()
        }
        self._tracks = LogTracker(errors)
        self.refusals: tuple[Refusal, ...] = ()
        """Of the last step."""

    def step(self, frame: RgbdFrame, pose: Pose, instances: Sequence[Masked]) -> tuple[Track, ...]:
        """The logs believed in after ``frame``, taken at ``pose``: in the frame in which the poses are given.

        Raises:
            FrameRefused: the frame is none, or from a camera that the profile does not know.
        """
        fits = [fit for fit in self.fits(frame, instances) if abs(fit.body.axis @ pose.rotation[2]) < STEEPEST]
        return self._tracks.step(fits, pose, frame.stamp_ns, partial(is_displaced, frame, pose))

    def fits(self, frame: RgbdFrame, instances: Sequence[Masked]) -> list[CylinderFit]:
        """The logs of one frame alone, in its optical frame; what was refused is in ``refusals``."""
        check(frame)
        if frame.camera not in self._sensors:
            known = ", ".join(self._sensors) or "none"
            raise RgbdFrameError(f"frame of camera {frame.camera!r}, which the machine does not have; it has: {known}")
        found, why = measure(frame, [i.mask for i in instances], self._sensors[frame.camera])
        self.refusals = tuple(why)
        return found


def measure(frame: RgbdFrame, masks: Sequence[np.ndarray], sensor: StereoSensor) -> tuple[list[CylinderFit], list[Refusal]]:
    """Fits of all masks, pieces of one log joined, and what was refused."""
    scene = _Scene.of(frame, masks, sensor)
    firsts = {i: scene.first(i) for i in range(len(masks))}
    stray = [i for i, body in firsts.items() if body is not None and body.length_m > LONGEST_M]
    if stray:  # a log, and something else in line with it
        scene = _Scene.of(frame, [_main_part(m) if i in stray else m for i, m in enumerate(masks)], sensor)
        firsts |= {i: scene.first(i) for i in stray}
    known = {i: body for i, body in firsts.items() if body is not None}
    borders = {i: scene.border([i], body, known) for i, body in known.items()}
    fits: list[CylinderFit | None] = [None] * len(masks)
    # What shows most first: it hides others, and is hidden least.
    for i in sorted(known, key=lambda i: -scene.areas[i]):
        fits[i] = scene.fit([i], known[i], borders[i], fits)
    refusals = [Refusal(i, "too little of its depth is known") for i, fit in enumerate(fits) if fit is None]
    found = []
    for group in groups(fits):
        fit = fits[group[0]]
        if len(group) > 1:
            body = fits[group[0]].body
            for i in group[1:]:
                body = joined(body, fits[i].body)
            fit = scene.fit(group, body, scene.border(group, body, known), fits) or fit
        why = refused(fit)
        if why:
            refusals.append(Refusal(group[0], why))
        else:
            found.append(fit)
    return found, refusals


def _main_part(mask: np.ndarray) -> np.ndarray:
    """The largest connected part of a mask (H, W)."""
    parts, count = label(mask)
    return mask if count < 2 else np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))


@dataclass(frozen=True, slots=True)
class _Scene:
    """A frame with numbered masks and the window in which it shows anything."""

    frame: RgbdFrame
    labels: np.ndarray
    areas: tuple[int, ...]
    boxes: tuple[tuple[int, int, int, int], ...]
    window: tuple[int, int, int, int]
    sensor: StereoSensor

    @classmethod
    def of(cls, frame: RgbdFrame, masks: Sequence[np.ndarray], sensor: StereoSensor) -> _Scene:
        labels, areas, boxes = np.zeros(frame.depth_m.shape, np.int16), [], []
        top, bottom, left, right = content_window(frame.rgb)
        for i, mask in enumerate(masks):
            if mask.shape != labels.shape or mask.dtype != bool:
                raise RgbdFrameError(
                    f"mask {i} is {mask.dtype} of shape {mask.shape}, not bool of the frame's {labels.shape}"
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

    def _cut(self, group: list[int]) -> tuple[int, int, int, int]:
        boxes = [self.boxes[i] for i in group]
        height, width = self.labels.shape
        left, top = max(0, min(b[0] for b in boxes) - MARGIN_PX), max(0, min(b[1] for b in boxes) - MARGIN_PX)
        return (
            left,
            top,
            min(width, max(b[2] for b in boxes) + MARGIN_PX),
            min(height, max(b[3] for b in boxes) + MARGIN_PX),
        )

    def first(self, i: int) -> Cylinder | None:
        """The first guess of mask ``i``."""
        mask, depth_m, _, pin, _ = self._part([i])
        return initial_cylinder(mask, depth_m, pin, 3.0 * self.sensor.sigma_d_px / self.sensor.fb_px_m)

    def border(self, group: list[int], first: Cylinder, known: dict[int, Cylinder]) -> Contour:
        """The border of one or several masks as one log, by guesses."""
        mask, depth_m, labels, pin, (left, top) = self._part(group)
        seen = self.window
        window = (seen[0] - left, seen[1] - top, seen[2] - left, seen[3] - top)
        others = {i + 1: body for i, body in known.items() if i not in group}
        return log_contour(mask, depth_m, pin, first, self.sensor, window, labels, others)

    def fit(self, group: list[int], first: Cylinder, border: Contour, fits: list[CylinderFit | None]) -> CylinderFit | None:
        """The fit of one or several masks as one log; ``fits`` are those of all masks so far."""
        mask, depth_m, _, pin, _ = self._part(group)
        fitted = {i + 1: fit.body for i, fit in enumerate(fits) if fit is not None and i not in group}
        return fit_cylinder(mask, depth_m, pin, first, border.without(fitted, pin), self.sensor)

    def _part(self, group: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, Intrinsics, tuple[int, int]]:
        """Mask, depth, numbers of all masks, pinhole and corner of a group's part of the picture."""
        left, top, right, bottom = self._cut(group)
        labels, depth_m = self.labels[top:bottom, left:right], self.frame.depth_m[top:bottom, left:right]
        pin = self.frame.intrinsics.crop(left, top, right - left, bottom - top)
        mask = labels == group[0] + 1
        for i in group[1:]:
            mask |= labels == i + 1
        return mask, depth_m, labels, pin, (left, top)
