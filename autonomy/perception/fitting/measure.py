"""Cylinder fits of all masks of a frame: initial cylinders, visible contours, fits, merged fragments, rejections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.ndimage import label

from autonomy.perception.camera.frame import RgbdFrame, RgbdFrameError, content_window
from autonomy.perception.fitting.contour import Contour, StereoSensor, log_contour
from autonomy.perception.fitting.cylinder import Cylinder
from autonomy.perception.fitting.cylinder_fit import CylinderFit, fit_cylinder
from autonomy.perception.fitting.initial_cylinder import initial_cylinder
from autonomy.perception.fitting.log_fragments import (
    MAX_LENGTH_M,
    fragment_groups,
    implausibility,
    joined_cylinder,
)
from machine.geometry.optics import Intrinsics

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
    """Fits of all masks, with fragments of one log merged, and the rejected masks.

    Raises:
        RgbdFrameError: a mask is not bool or not of the frame's size.
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
    """The largest connected part of a mask (H, W)."""
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
                raise RgbdFrameError(
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
        """The initial cylinder of mask ``i``."""
        mask, depth_m, _, pin, _ = self._part([i])
        return initial_cylinder(mask, depth_m, pin, 3.0 * self.sensor.sigma_d_px / self.sensor.fb_px_m)

    def contour(self, group: list[int], first: Cylinder, known: dict[int, Cylinder]) -> Contour:
        """The contour of one or several masks as one log, classified with the initial cylinders ``known``."""
        mask, depth_m, labels, pin, (left, top) = self._part(group)
        content = self.window
        window = (content[0] - left, content[1] - top, content[2] - left, content[3] - top)
        others = {i + 1: body for i, body in known.items() if i not in group}
        return log_contour(mask, depth_m, pin, first, self.sensor, window, labels, others)

    def fit(
        self, group: list[int], first: Cylinder, contour: Contour, fits: dict[int, CylinderFit]
    ) -> CylinderFit | None:
        """The fit of one or several masks as one log; ``fits`` are those of all masks so far."""
        mask, depth_m, _, pin, _ = self._part(group)
        fitted = {i + 1: fits[i].body for i in sorted(fits) if i not in group}
        return fit_cylinder(mask, depth_m, pin, first, contour.without(fitted, pin), self.sensor)

    def _part(self, group: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, Intrinsics, tuple[int, int]]:
        """Mask, depth, numbers of all masks, pinhole and top left corner of a group's part of the picture."""
        left, top, right, bottom = self._crop(group)
        labels, depth_m = self.labels[top:bottom, left:right], self.frame.depth_m[top:bottom, left:right]
        pin = self.frame.intrinsics.crop(left, top, right - left, bottom - top)
        mask = labels == group[0] + 1
        for i in group[1:]:
            mask |= labels == i + 1
        return mask, depth_m, labels, pin, (left, top)
