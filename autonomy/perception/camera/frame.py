"""One RGB-D picture and the pose of its camera.

``check_frame`` accepts or refuses a frame as a whole, so that a broken picture never becomes a log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from machine.geometry.carrier import base_from_rear, rear_from_front
from machine.geometry.kinematics import chain_points
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, rpy_matrix
from machine.joints import Joint
from machine.profile import Camera, Profile
from runtime.errors import InputRefused


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
    """An optical frame in the crane's base frame: position (3,) [m]; columns of ``rotation`` (3, 3) are its axes."""

    position_m: np.ndarray
    rotation: np.ndarray

    def to_base(self, points_m: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) of the optical frame into the base frame."""
        return np.asarray(np.asarray(points_m, float) @ self.rotation.T + self.position_m)

    def to_optical(self, points_m: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) of the base frame into the optical frame."""
        return np.asarray((np.asarray(points_m, float) - self.position_m) @ self.rotation)


def rescaled(frame: RgbdFrame, depth_scale: float) -> RgbdFrame:
    """Return the frame with its depth divided by ``depth_scale``, which a survey of the camera gives."""
    if depth_scale == 1.0:
        return frame
    return replace(frame, depth_m=frame.depth_m / np.float32(depth_scale))


def content_window(rgb: np.ndarray) -> tuple[int, int, int, int]:
    """Find top, bottom, left, right (bottom and right exclusive) of a picture (H, W, 3) uint8 without its black bars.

    The bars are those of a letterbox.  A picture that is black everywhere is returned whole.
    """
    rows = np.flatnonzero(rgb.reshape(len(rgb), -1).max(axis=1))
    columns = np.flatnonzero(rgb.max(axis=0).any(axis=1))
    if not len(rows):
        return 0, rgb.shape[0], 0, rgb.shape[1]
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def check_frame(frame: RgbdFrame) -> None:
    """Check that sizes agree, that the intrinsics are a camera's, and that some depth is known.

    Raises:
        InputRefused: one of these does not hold.
    """
    name, pin = f"frame of camera {frame.camera!r}", frame.intrinsics
    rgb, depth = np.asarray(frame.rgb), np.asarray(frame.depth_m)
    if depth.ndim != 2 or not depth.size:
        raise InputRefused(
            "frame.no-depth-array",
            f"{name}: depth has shape {depth.shape} instead of (height, width); check the source of the frame",
        )
    if rgb.shape != (*depth.shape, 3) or rgb.dtype != np.uint8:
        raise InputRefused(
            "frame.bad-colour",
            f"{name}: colour is {rgb.dtype} of shape {rgb.shape}, but depth of shape {depth.shape} "
            f"needs uint8 of shape {(*depth.shape, 3)}; register depth to the colour picture",
        )
    if depth.dtype.kind != "f":
        raise InputRefused(
            "frame.bad-depth-type",
            f"{name}: depth is {depth.dtype} instead of floating-point metres with NaN for unknown; convert it",
        )
    if (pin.height_px, pin.width_px) != depth.shape:
        raise InputRefused(
            "frame.bad-size",
            f"{name} is {depth.shape[1]} x {depth.shape[0]} px, but its intrinsics are for {pin.width_px} x "
            f"{pin.height_px} px; take the intrinsics from the source of the frame",
        )
    if not all(map(math.isfinite, (pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px))) or min(pin.fx_px, pin.fy_px) <= 0.0:
        raise InputRefused(
            "frame.bad-intrinsics",
            f"{name}: focal lengths {pin.fx_px:g}, {pin.fy_px:g} px and principal point are not a pinhole camera's",
        )
    if not (0.5 < pin.fx_px / pin.fy_px < 2.0 and 0.1 < pin.fx_px / pin.width_px < 20.0):
        raise InputRefused(
            "frame.bad-intrinsics",
            f"{name}: focal lengths {pin.fx_px:g}, {pin.fy_px:g} px do not fit the size of the picture",
        )
    if not (-0.5 <= pin.cx_px <= pin.width_px - 0.5 and -0.5 <= pin.cy_px <= pin.height_px - 0.5):
        raise InputRefused(
            "frame.bad-intrinsics",
            f"{name}: principal point ({pin.cx_px:g}, {pin.cy_px:g}) px is outside the picture",
        )
    nearest = float(np.fmin.reduce(depth, axis=None))
    if math.isnan(nearest) or nearest == math.inf:
        raise InputRefused(
            "frame.depth-unknown",
            f"{name} has no known depth; check that the lens is not covered and the scene not nearer than the range",
        )
    if nearest <= 0.0:
        raise InputRefused("frame.depth-not-positive", f"{name} has depth of 0 m or less; mark unknown depth with NaN")


# -- The pose of a camera in the crane's base frame, from joint positions.
#
# Links that carry cameras: ``base``, ``boom`` and ``stick`` of the crane, ``rear`` and ``front`` of the carrier.
# Link frames are the machine's: of boom and stick y is along the reach, x to the right, z up, the origin at the
# joint (docs/reference/machines.md section 1.1); the carrier's are those of ``machine.geometry.carrier``. The
# kinematics are rigid: the sag of the arm and the deflection of the tyres are not modelled.

UNIT_VECTORS: Final = np.eye(3)


def optical_pose(profile: Profile, camera: Camera, q: Sequence[float], articulation_rad: float = 0.0) -> Pose:
    """Compute the optical frame in the crane's base frame; ``q`` are joint positions in ``Joint`` order [rad, m].

    Raises:
        InputRefused: the camera's link is none of those above.
    """
    link = link_pose(profile, camera.link, q, articulation_rad)
    turn = link.rotation @ rpy_matrix(camera.rpy_rad) @ BODY_FROM_OPTICAL
    return Pose(link.to_base(np.asarray(camera.position_m, float)), turn)


def link_pose(profile: Profile, name: str, q: Sequence[float], articulation_rad: float = 0.0) -> Pose:
    """Compute the frame of a link that may carry a camera, in the crane's base frame.

    Raises:
        InputRefused: the link is none of those above.
    """
    kin, carrier = profile.kinematics, profile.carrier
    if name == "base":
        return Pose(np.zeros(3), np.eye(3))
    if name in ("rear", "front") and carrier is not None:
        bend = articulation_rad if name == "front" else 0.0
        origin, *ends = (
            np.array(base_from_rear(carrier, rear_from_front(bend, tuple(p)))) for p in (np.zeros(3), *UNIT_VECTORS)
        )
        return Pose(origin, np.stack([e - origin for e in ends], axis=1))
    points = chain_points(kin, q)
    slew = rpy_matrix((0.0, 0.0, q[Joint.SLEW] + kin.theta1_offset_rad - math.pi / 2))
    match name:
        case "boom":
            return Pose(np.array(points.boom_pin), slew @ rpy_matrix((q[Joint.LIFT], 0.0, 0.0)))
        case "stick":
            turn = slew @ rpy_matrix((q[Joint.LIFT] + q[Joint.TILT], 0.0, 0.0))
            return Pose(np.array(points.stick_pin), turn)
    raise InputRefused(
        "camera-mount.unknown-link",
        f"the pose of link {name!r} is unknown; mount the camera on base, boom or stick"
        + (", rear or front" if carrier is not None else ""),
    )
