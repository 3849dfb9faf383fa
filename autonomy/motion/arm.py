"""The arm as the planner sees it: cylindrical poses of the hanger pin, their joints, and the limits with
margin.

A pose is ``(slew_rad, r_m, z_m, ext_m, rot_rad)``: where the pin is, how far the telescope is out (the
redundancy) and how the rotator stands.  A straight line in poses is a straight line in the crane's plane
while it slews, which is how a grapple keeps its height.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import Final, NamedTuple

import numpy as np

from machine.joints import JOINTS, Joint
from machine.kinematics import Unreachable, inverse, pin_position, solve
from machine.profile import Profile, joint_limits

SPEED_SHARE: Final = 0.85
ACCELERATION_SHARE: Final = 0.75
"""Shares of the profile's limits that a plan uses; the rest is for the joint law to catch up with."""
SLEW_MARGIN_RAD: Final = 0.01
EASY_STRETCH: Final = 0.88
"""Distance of the pin from the boom pin over the length of the straight arm that leaves speed in all
directions.
"""


class Pose(NamedTuple):
    """Hanger pin in the crane's plane, telescope and rotator."""

    slew_rad: float
    r_m: float
    z_m: float
    ext_m: float
    rot_rad: float

    def at_height(self, z_m: float) -> Pose:
        """The same pose at another height of the pin."""
        return self._replace(z_m=z_m)


class Arm:
    """Kinematics and limits of one machine, prepared for planning."""

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._kin = profile.kinematics
        self._limits = joint_limits(profile)
        specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self.speed = SPEED_SHARE * np.array([s.speed_limit for s in specs])
        self.acceleration = ACCELERATION_SHARE * np.array([s.acceleration_limit for s in specs])

    def pose(self, q: Sequence[float]) -> Pose:
        """The pose of a joint vector (5 elements, rad and m)."""
        x, y, z = pin_position(self._kin, q)
        return Pose(q[Joint.SLEW], hypot(x, y), z, q[Joint.EXT], q[Joint.ROT])

    def xy(self, pose: Pose) -> tuple[float, float]:
        """Horizontal position of the pin in the base frame, m."""
        theta = pose.slew_rad + self._kin.theta1_offset_rad
        return pose.r_m * cos(theta), pose.r_m * sin(theta)

    def joints(self, poses: np.ndarray) -> np.ndarray:
        """Joint vectors (n, 5) of poses (n, 5).

        Raises:
            Unreachable: a pose is outside the joint limits.
        """
        out = np.empty_like(poses)
        for i, (slew, r, z, ext, rot) in enumerate(poses.tolist()):
            theta = slew + self._kin.theta1_offset_rad
            angles = inverse(self._kin, self._limits, r * cos(theta), r * sin(theta), z, ext)
            out[i] = (slew, angles[1], angles[2], ext, rot)
        return out

    def over(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """The pose above a point at ``low_z_m`` whose telescope also serves at ``high_z_m``; rotator at 0.

        Raises:
            Unreachable: with the reason.
        """
        r = hypot(x, y) - self._kin.a1_m
        stretch = max(hypot(r, z - self._kin.d1_m) for z in (low_z_m, high_z_m)) / EASY_STRETCH
        wish = stretch - self._kin.a2_m - self._kin.d4_m
        slew, _, _, ext = solve(self.profile, x, y, low_z_m, wish)
        low, high = self._limits[Joint.SLEW]
        if not low + SLEW_MARGIN_RAD <= slew <= high - SLEW_MARGIN_RAD:
            raise Unreachable(f"point ({x:.2f}, {y:.2f}) m is at the stop of the slew")
        pose = Pose(slew, hypot(x, y), low_z_m, ext, 0.0)
        self.joints(np.array([pose, pose.at_height(0.5 * (low_z_m + high_z_m)), pose.at_height(high_z_m)]))
        return pose
