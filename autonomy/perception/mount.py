"""Where a camera's optical frame stands in the crane's base frame, from joint positions; and how a mount is surveyed.

Links that carry cameras: ``base``, the moving parts of the crane (``turntable`` and ``mast``, ``boom``, ``stick``) and
the carrier's ``rear`` and ``front``.  Link frames are the machine's: from the turntable upwards y is along the reach,
x to the right, z up, the origin at the joint (machines.md 1.1); the carrier's are those of ``machine.carrier``.
Rigid kinematics: sag and the tyres' give are not in them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from msgspec.structs import replace
from scipy.optimize import least_squares

from autonomy.perception.frame import Pose
from machine.carrier import base_from_rear, rear_from_front
from machine.joints import Joint
from machine.kinematics import chain_points
from machine.optics import BODY_FROM_OPTICAL, Intrinsics, intrinsics, rpy_matrix
from machine.profile import Camera, Profile

LEAST_TARGETS: Final = 6
MOUNT_SPREAD: Final = (0.03, 0.03, 0.03, 0.035, 0.035, 0.035)
"""How far off a mount is that nobody has surveyed [m, rad] (machines.md 8)."""
AXES: Final = np.eye(3)


class MountRefused(ValueError):
    """A camera whose place is not known, or a survey that cannot give it; the message says why."""


def optical_pose(profile: Profile, camera: Camera, q: Sequence[float], articulation_rad: float = 0.0) -> Pose:
    """The optical frame in the crane's base frame; ``q`` are joint positions in ``Joint`` order [rad, m].

    Raises:
        MountRefused: the camera's link is none of those above.
    """
    at, turn = _link(profile, camera.link, q, articulation_rad)
    return Pose(at + turn @ np.asarray(camera.position_m, float), turn @ rpy_matrix(camera.rpy_rad) @ BODY_FROM_OPTICAL)


def _link(profile: Profile, name: str, q: Sequence[float], articulation: float) -> tuple[np.ndarray, np.ndarray]:
    kin, carrier = profile.kinematics, profile.carrier
    if name == "base":
        return np.zeros(3), np.eye(3)
    if name in ("rear", "front") and carrier is not None:
        bend = articulation if name == "front" else 0.0
        origin, *ends = (
            np.array(base_from_rear(carrier, rear_from_front(bend, tuple(p)))) for p in (np.zeros(3), *AXES)
        )
        return origin, np.stack([e - origin for e in ends], axis=1)
    points = chain_points(kin, q)
    slew = rpy_matrix((0.0, 0.0, q[Joint.SLEW] + kin.theta1_offset_rad - math.pi / 2))
    match name:
        case "boom":
            return np.array(points.boom_pin), slew @ rpy_matrix((q[Joint.LIFT], 0.0, 0.0))
        case "stick":
            return np.array(points.stick_pin), slew @ rpy_matrix((q[Joint.LIFT] + q[Joint.TILT], 0.0, 0.0))
    raise MountRefused(
        f"a camera on link {name!r} has no known place; mount it on base, boom or stick"
        + (", rear or front" if carrier is not None else "")
    )


@dataclass(frozen=True, slots=True)
class Survey:
    """A camera as a survey leaves it: its mount, and by what its depth must be divided."""

    camera: Camera
    depth_scale: float


def surveyed(
    camera: Camera,
    link: Pose,
    pixels_px: np.ndarray,
    depths_m: np.ndarray,
    targets_m: np.ndarray,
    pixel_sigma_px: float = 0.3,
) -> Survey:
    """Mount and scale of depth as ``LEAST_TARGETS`` or more surveyed targets show them.

    ``pixels_px`` (N, 2) is where the camera sees the targets ``targets_m`` (N, 3), ``depths_m`` (N,) their depth, NaN
    where it has none; ``link`` is the pose of its link (not of its optics) in the frame of the targets.  The profile's
    mount is the prior.

    Raises:
        MountRefused: too few targets, or ones that it cannot see where the survey says they are.
    """
    if len(targets_m) < LEAST_TARGETS:
        raise MountRefused(f"{len(targets_m)} targets do not fix a mount; survey at least {LEAST_TARGETS}")
    pin = intrinsics(camera)
    nominal_m, nominal = np.asarray(camera.position_m, float), rpy_matrix(camera.rpy_rad)
    local = link.to_optical(targets_m)  # in the link's frame

    def body(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return nominal_m + nominal @ x[:3], nominal @ rpy_matrix(x[3:])

    def optical(x: np.ndarray) -> np.ndarray:
        at, turn = body(x)
        return (local - at) @ (turn @ BODY_FROM_OPTICAL)

    def misses(x: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [((_seen(pin, optical(x)) - pixels_px) / pixel_sigma_px).ravel(), x / np.array(MOUNT_SPREAD)]
        )

    found = least_squares(misses, np.zeros(6), x_scale=MOUNT_SPREAD)
    rest = found.fun[: 2 * len(targets_m)]
    off_px = math.sqrt(float(np.mean(rest * rest))) * pixel_sigma_px
    if not off_px < 5.0 * pixel_sigma_px:
        raise MountRefused(
            f"the targets are {off_px:.1f} px from where any mount near the profile's puts them; "
            "check which target is which, and their places"
        )
    true_m = optical(found.x)[:, 2]
    known = np.isfinite(depths_m)
    # The error of depth grows with its square: of the ratio it grows with depth.
    weights = 1.0 / true_m[known] ** 2
    scale = float(np.sum(weights * depths_m[known] / true_m[known]) / np.sum(weights)) if known.any() else 1.0
    if not 0.9 < scale < 1.1:
        raise MountRefused(
            f"depth is {scale:.2f} of what the survey says; the camera's baseline or focal length is wrong"
        )
    at, turn = body(found.x)
    pitch = math.asin(max(-1.0, min(1.0, -turn[2, 0])))
    rpy = (math.atan2(turn[2, 1], turn[2, 2]), pitch, math.atan2(turn[1, 0], turn[0, 0]))
    return Survey(replace(camera, position_m=tuple(float(v) for v in at), rpy_rad=rpy), scale)


def _seen(pin: Intrinsics, optical: np.ndarray) -> np.ndarray:
    ahead = np.where(optical[:, 2:] > 0.05, optical[:, 2:], 0.05)
    return pin.project(np.concatenate([optical[:, :2], ahead], axis=1))
