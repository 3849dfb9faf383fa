"""x"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import Final

import numpy as np

from autonomy.motion.pose import Pose
from machine.joints import JOINTS, Joint
from machine.geometry.kinematics import Unreachable
from machine.profile import Profile, joint_limits
from machine.geometry.sag import FOOT_SHARE, GRAVITY_M_S2, NEAR_M, ROUNDS, aim, true_pin

SPEED_SHARE: Final = 0.99
ACCELERATION_SHARE: Final = 0.96
FLOW_SHARE: Final = 0.95
"""Shares of the profile's limits that a plan uses.  Speeds and accelerations keep a margin for rounding only, as a law
may go beyond them to catch up; of the pump's oil it needs the rest itself.
"""
SAMPLED_ACCELERATION_SHARE: Final = 0.99
"""The same of the samples of a single leg: cubics between them overshoot where the acceleration turns, and the margin
of `ACCELERATION_SHARE` is there to bear that; slowing the whole leg for it would undo what its swing was planned for.
"""
STOP_MARGIN: Final = 0.005
"""How far from its stops a joint is planned to stay, rad (EXT m): curves overshoot their points a little, and a
controller refuses what leaves the range by anything.  A motion that begins nearer may do so."""
STOP_ROUNDING: Final = 1e-9
"""Rounding of a joint at its stop."""


class ArmKinematics:
    """x"""

    def __init__(self, profile: Profile, load_kg: float = 0.0) -> None:
        self.profile, self.load_kg = profile, load_kg
        self._kin = profile.kinematics
        self._limits = joint_limits(profile)
        specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self.speed = SPEED_SHARE * np.array([s.speed_limit for s in specs])
        self.acceleration = ACCELERATION_SHARE * np.array([s.acceleration_limit for s in specs])
        self.sampled_acceleration = self.acceleration * (SAMPLED_ACCELERATION_SHARE / ACCELERATION_SHARE)
        self._valves = [s.valve for s in specs]
        self._pump_m3_s = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s

    def pump_load(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Flow that joint velocities (n, 5) at positions (n, 5) take, over what a plan may ask of the pump, (n,)."""
        flow = np.zeros(len(q))
        for j, valve in enumerate(self._valves):
            per_speed = np.where(velocity[:, j] >= 0.0, valve.flow_plus, valve.flow_minus)
            lever = np.interp(q[:, j], valve.lever_at, valve.lever) if valve.lever else 1.0
            flow += np.abs(velocity[:, j]) * per_speed * lever
        return flow / self._pump_m3_s

    def pose(self, q: Sequence[float]) -> Pose:
        """The pose of a joint vector (5 elements, rad and m)."""
        x, y, z = true_pin(self.profile.sag, self._kin, q, self.load_kg)
        return Pose(q[Joint.SLEW], hypot(x, y), z, q[Joint.EXT], q[Joint.ROT])

    def xy(self, pose: Pose) -> tuple[float, float]:
        """Horizontal position of the pin in the base frame, m."""
        theta = pose.slew_rad + self._kin.theta1_offset_rad
        return pose.r_m * cos(theta), pose.r_m * sin(theta)

    def joints(self, poses: np.ndarray) -> np.ndarray:
        """Joint vectors (n, 5) of poses (n, 5).

        The first is where a motion begins: it may be at a stop, from which the others keep away.

        Raises:
            Unreachable: a pose is outside the joint limits.
        """
        q, outside = self._sag_compensated(poses)
        return self._joints_or_reason(poses) if np.any(outside) else q

    def _sag_compensated(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All at once, and which are out of reach: `machine.geometry.sag.aim` for arrays."""
        q, outside = self.straight_column_joints(poses)
        if (sag := self.profile.sag) is None:
            return q, outside
        kin, at = self._kin, poses
        for _ in range(ROUNDS):
            head = kin.a1_m + kin.a2_m * np.cos(q[:, Joint.LIFT] + kin.theta2_offset_rad)
            r, up = at[:, 1], at[:, 2] - FOOT_SHARE * kin.d1_m
            weighed = sag.pin_rad_m + sag.load_rad_nm * GRAVITY_M_S2 * self.load_kg
            lean = sag.head_rad_m * head + weighed * r - sag.rest_rad
            c, s = np.cos(lean), np.sin(lean)
            off = np.column_stack([poses[:, 1] - r * c - up * s, poses[:, 2] - FOOT_SHARE * kin.d1_m - up * c + r * s])
            if np.any(outside) or np.max(np.abs(off)) < 0.5 * NEAR_M:
                break
            at = at.copy()
            at[:, 1:3] += off
            q, outside = self.straight_column_joints(at)
        return q, outside

    def _joints_or_reason(self, poses: np.ndarray) -> np.ndarray:
        """The same, to say what is in the way."""
        sag, out, limits = self.profile.sag, np.empty_like(poses), self._limits
        for i, (slew, r, z, ext, rot) in enumerate(poses.tolist()):
            theta = slew + self._kin.theta1_offset_rad
            angles = aim(sag, self._kin, limits, r * cos(theta), r * sin(theta), z, ext, self.load_kg)
            out[i] = (slew, angles[1], angles[2], ext, rot)
            if i == 0:
                low, high = self._joint_bounds(out[0])
                limits = tuple(zip(low.tolist(), high.tolist(), strict=True))
        return out

    def _joint_bounds(self, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest joints of a motion that begins at joints (5,)."""
        low, high = np.array(self._limits).T
        inner, outer = low + STOP_MARGIN, high - STOP_MARGIN
        at = np.where(np.isfinite(first), np.clip(first, low, high), inner)
        return np.minimum(inner, at), np.maximum(outer, at)

    def approximate_joints(self, poses: np.ndarray) -> np.ndarray:
        """The same all at once, as if the column stood straight: to look at many ways, not to drive one."""
        q, outside = self.straight_column_joints(poses)
        if np.any(outside):
            self.joints(poses[np.argmax(outside)][None])  # says what is in the way
            raise Unreachable("a pose of the way is at the edge of the crane's reach")
        return q

    def straight_column_joints(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint vectors (n, 5) of poses (n, 5), the column straight, and which of them are out of reach (n,)."""
        kin, (slew, r, z, ext, rot) = self._kin, poses.T
        boom, length = kin.a2_m, kin.d4_m + ext
        ahead, up = r - kin.a1_m, z - kin.d1_m
        d, stick = np.hypot(ahead, up), np.hypot(kin.a3_m, length)
        heron = (boom + stick + d) * (boom + stick - d) * (d + boom - stick) * (d - boom + stick)
        area4 = np.sqrt(np.maximum(heron, 0.0))
        lift = np.arctan2(up, ahead) + np.arctan2(area4, boom**2 + d**2 - stick**2) - kin.theta2_offset_rad
        elbow = np.arctan2(area4, d**2 - boom**2 - stick**2)
        tilt = np.arctan2(length, kin.a3_m) - elbow - kin.theta3_offset_rad
        q = np.column_stack([slew, lift, tilt, ext, rot])
        low, high = self._joint_bounds(q[0])
        return q, ~np.all((q >= low - STOP_ROUNDING) & (q <= high + STOP_ROUNDING), axis=1) | (heron < 0.0)
