"""Frames of the crane's links for display: each in its parent, with the kinematics of `machine.geometry.kinematics`.

``column`` turns with the slew, x along the reach and z up.  ``boom``, ``stick`` and ``pin`` lie in the crane's plane, x
along the link; their origins are the boom pin, the stick pin and the hanger pin.  ``grapple`` hangs straight down at
the pivot of the jaws, x along their opening axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, pi, sin
from typing import Final, NamedTuple

from machine.geometry.grapple import grapple_yaw
from machine.geometry.kinematics import Point, chain_points
from machine.joints import Joint
from machine.profile import Profile

BASE: Final = "base"
Quaternion = tuple[float, float, float, float]


class LinkFrame(NamedTuple):
    """A frame in its parent: translation [m], then rotation (x, y, z, w)."""

    parent: str
    child: str
    translation_m: Point
    rotation: Quaternion


def link_frames(profile: Profile, q: Sequence[float]) -> tuple[LinkFrame, ...]:
    """Compute the frames at joint positions in ``Joint`` order [rad, m], without those that need an unknown joint."""
    if not all(map(isfinite, q[: Joint.ROT])):
        return ()
    kin = profile.kinematics
    boom_rad = q[Joint.LIFT] + kin.theta2_offset_rad
    stick_rad = q[Joint.TILT] + kin.theta3_offset_rad - pi / 2
    frames = [
        LinkFrame(BASE, "column", (0.0, 0.0, 0.0), _about_z(q[Joint.SLEW] + kin.theta1_offset_rad)),
        LinkFrame("column", "boom", (kin.a1_m, 0.0, kin.d1_m), _pitched_up(boom_rad)),
        LinkFrame("boom", "stick", (kin.a2_m, 0.0, 0.0), _pitched_up(stick_rad)),
        LinkFrame("stick", "pin", (kin.d4_m + q[Joint.EXT], 0.0, kin.a3_m), _about_z(0.0)),
    ]
    if isfinite(q[Joint.ROT]):
        hanging = chain_points(kin, q).grapple
        frames.append(LinkFrame(BASE, "grapple", hanging, _about_z(grapple_yaw(profile, q))))
    return tuple(frames)


def _about_z(angle_rad: float) -> Quaternion:
    return 0.0, 0.0, sin(angle_rad / 2), cos(angle_rad / 2)


def _pitched_up(angle_rad: float) -> Quaternion:
    return 0.0, -sin(angle_rad / 2), 0.0, cos(angle_rad / 2)
