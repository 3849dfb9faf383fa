"""One RGB-D picture as perception takes it, and where its camera stood.

A frame is taken or refused whole: a picture that cannot be one never becomes a log.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from machine.geometry.optics import Intrinsics


class RgbdFrameError(ValueError):
    """A frame that was refused whole; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One picture: rgb (H, W, 3) uint8; depth_m (H, W) float32, optical z, NaN = unknown; taken at ``stamp_ns``."""

    camera: str
    stamp_ns: int
    rgb: np.ndarray
    depth_m: np.ndarray
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True)
class Pose:
    """Where an optical frame stands in the crane's base frame: position (3,) [m]; the columns of ``rotation`` (3, 3)
    are the optical axes."""

    position_m: np.ndarray
    rotation: np.ndarray

    def to_base(self, points_m: np.ndarray) -> np.ndarray:
        """Optical-frame points (..., 3) in the base frame."""
        return np.asarray(points_m, float) @ self.rotation.T + self.position_m

    def to_optical(self, points_m: np.ndarray) -> np.ndarray:
        """Base-frame points (..., 3) in the optical frame."""
        return (np.asarray(points_m, float) - self.position_m) @ self.rotation


def rescaled(frame: RgbdFrame, depth_scale: float) -> RgbdFrame:
    """The frame with its depth divided by the scale that a survey of its camera found."""
    if depth_scale == 1.0:
        return frame
    return replace(frame, depth_m=frame.depth_m / np.float32(depth_scale))


def content_window(rgb: np.ndarray) -> tuple[int, int, int, int]:
    """Top, bottom, left, right, the second and fourth exclusive, of what a letterbox's black bars leave of a picture
    (H, W, 3) uint8 (all of it when all is black)."""
    rows = np.flatnonzero(rgb.reshape(len(rgb), -1).max(axis=1))
    columns = np.flatnonzero(rgb.max(axis=0).any(axis=1))
    if not len(rows):
        return 0, rgb.shape[0], 0, rgb.shape[1]
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def check(frame: RgbdFrame) -> None:
    """Raise FrameRefused, with a sentence, unless the frame can be one: sizes agree, intrinsics are those of a camera
    that took it, and some depth is known."""
    name, pin = f"frame of camera {frame.camera!r}", frame.intrinsics
    rgb, depth = np.asarray(frame.rgb), np.asarray(frame.depth_m)
    if depth.ndim != 2 or not depth.size:
        raise RgbdFrameError(f"{name} is empty: its depth has shape {depth.shape}, not (height, width); check the source")
    if rgb.shape != (*depth.shape, 3) or rgb.dtype != np.uint8:
        raise RgbdFrameError(
            f"{name}: colours are {rgb.dtype} of shape {rgb.shape}, but depth of shape {depth.shape} "
            f"needs uint8 of shape {(*depth.shape, 3)}; register depth to the colour picture"
        )
    if depth.dtype.kind != "f":
        raise RgbdFrameError(f"{name}: depth is {depth.dtype}, not floating metres with NaN for unknown; convert it")
    if (pin.height_px, pin.width_px) != depth.shape:
        raise RgbdFrameError(
            f"{name} is {depth.shape[1]} x {depth.shape[0]} px, but its intrinsics are for {pin.width_px} x "
            f"{pin.height_px} px; take the intrinsics from the source of the frame"
        )
    if not all(map(math.isfinite, (pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px))) or min(pin.fx_px, pin.fy_px) <= 0.0:
        raise RgbdFrameError(f"{name}: focal lengths {pin.fx_px:g}, {pin.fy_px:g} px and centre are no pinhole's")
    if not (0.5 < pin.fx_px / pin.fy_px < 2.0 and 0.1 < pin.fx_px / pin.width_px < 20.0):
        raise RgbdFrameError(f"{name}: focal lengths {pin.fx_px:g}, {pin.fy_px:g} px fit no picture of its size")
    if not (-0.5 <= pin.cx_px <= pin.width_px - 0.5 and -0.5 <= pin.cy_px <= pin.height_px - 0.5):
        raise RgbdFrameError(f"{name}: its centre ({pin.cx_px:g}, {pin.cy_px:g}) px lies outside the picture")
    nearest = float(np.fmin.reduce(depth, axis=None))
    if math.isnan(nearest) or nearest == math.inf:
        raise RgbdFrameError(f"{name} has no depth anywhere; is the lens covered, or is all of it nearer than the range?")
    if nearest <= 0.0:
        raise RgbdFrameError(f"{name} has depth of 0 m or less; unknown depth must be NaN")
