"""Kinematics and limits of the arm for planning: poses of the hanger pin, their joints, and the limits with margin.

A pose is ``(slew_rad, r_m, z_m, ext_m, rot_rad)``: the place of the pin, the extension (the redundancy) and the
rotator. A straight line in poses is a straight line in the crane's plane while it slews, so a grapple keeps its
height.  The pin is its true place: where the profile knows the column's sag, that of crane and load is compensated.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import Final

import numpy as np

from autonomy.motion.pose import Pose
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from machine.geometry.sag import AIM_TOLERANCE_M, FOOT_SHARE, GRAVITY_M_S2, MAX_AIM_ITERATIONS, aim, true_pin
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint_limits

SPEED_SHARE: Final = 0.99
ACCELERATION_SHARE: Final = 0.96
FLOW_SHARE: Final = 0.95
"""Shares of the profile's limits that a plan uses.  Speeds and accelerations keep a margin for rounding only, as the
joint law may exceed them to catch up; it needs the rest of the pump's flow for that, too.
"""
SAMPLED_ACCELERATION_SHARE: Final = 0.99
"""The same for the samples of a single leg: cubics between them overshoot where the acceleration turns, and the margin
of `ACCELERATION_SHARE` absorbs that; slowing the whole leg would spoil its swing compensation.
"""
STOP_MARGIN: Final = 0.005
"""Planned distance of a joint from its stops, rad (EXT m): curves overshoot their points a little, and a controller
refuses any setpoint outside the range.  A motion that begins nearer may stay there."""
STOP_ROUNDING: Final = 1e-9
"""Rounding tolerance of a joint at its stop."""


LEVEL: Final = (0.0, 0.0)


def slope_of(rotation: np.ndarray) -> tuple[float, float]:
    """How far what hangs from the pin is beside it, along the base's x and y, per metre below it [m/m].

    ``rotation`` (3, 3) turns the base's vectors into the level frame, z up.
    """
    x, y, z = rotation[2].tolist()
    return -x / z, -y / z


class ArmKinematics:
    """Kinematics and limits of one machine with a load [kg] in its grapple.

    ``slope``: where the machine does not stand level, what hangs from the pin is beside it, by this much per metre
    below it along the base's x and y (`slope_of`).
    """

    def __init__(self, profile: Profile, load_kg: float = 0.0, slope: tuple[float, float] = LEVEL) -> None:
        self.profile, self.load_kg, self.slope = profile, load_kg, slope
        below_m = lowest_tip_below_pin_m(profile.grapple.jaws)
        self._aside_m = slope[0] * below_m, slope[1] * below_m
        self._kin = profile.kinematics
        self._limits = joint_limits(profile)
        specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self.speed = SPEED_SHARE * np.array([s.speed_limit for s in specs])
        self.acceleration = ACCELERATION_SHARE * np.array([s.acceleration_limit for s in specs])
        self.sampled_acceleration = self.acceleration * (SAMPLED_ACCELERATION_SHARE / ACCELERATION_SHARE)
        self._valves = [s.valve for s in specs]
        self._pump_m3_s = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s

    def pump_load(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Pump flow of joint velocities (n, 5) at positions (n, 5), as a share of what a plan may use, (n,)."""
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
        """Horizontal position of the jaws below a pose of the pin in the base frame, m."""
        theta, (x, y) = pose.slew_rad + self._kin.theta1_offset_rad, self._aside_m
        return pose.r_m * cos(theta) + x, pose.r_m * sin(theta) + y

    def joints(self, poses: np.ndarray) -> np.ndarray:
        """Joint vectors (n, 5) of poses (n, 5), with the sag compensated.

        The first pose is where a motion begins: it may be at a stop, from which the others keep away.

        Raises:
            Unreachable: a pose is outside the joint limits.
        """
        q, outside = self._sag_compensated(poses)
        return self._joints_or_reason(poses) if np.any(outside) else q

    def _sag_compensated(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints of all poses at once, and which are out of reach: `machine.geometry.sag.aim` for arrays."""
        q, outside = self.straight_column_joints(poses)
        if (sag := self.profile.sag) is None:
            return q, outside
        kin, at = self._kin, poses
        for _ in range(MAX_AIM_ITERATIONS):
            head = kin.a1_m + kin.a2_m * np.cos(q[:, Joint.LIFT] + kin.theta2_offset_rad)
            r, up = at[:, 1], at[:, 2] - FOOT_SHARE * kin.d1_m
            weighed = sag.pin_rad_m + sag.load_rad_nm * GRAVITY_M_S2 * self.load_kg
            lean = sag.head_rad_m * head + weighed * r - sag.rest_rad
            c, s = np.cos(lean), np.sin(lean)
            off = np.column_stack([poses[:, 1] - r * c - up * s, poses[:, 2] - FOOT_SHARE * kin.d1_m - up * c + r * s])
            if np.any(outside) or np.max(np.abs(off)) < 0.5 * AIM_TOLERANCE_M:
                break
            at = at.copy()
            at[:, 1:3] += off
            q, outside = self.straight_column_joints(at)
        return q, outside

    def _joints_or_reason(self, poses: np.ndarray) -> np.ndarray:
        """Joints pose by pose, which raises with the reason."""
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
        """Joints of poses without sag, to compare many paths; raises ``Unreachable``."""
        q, outside = self.straight_column_joints(poses)
        if np.any(outside):
            self.joints(poses[np.argmax(outside)][None])  # raises with the reason
            raise Unreachable("a pose of the path is at the edge of the crane's reach", "motion.edge-of-reach")
        return q

    def straight_column_joints(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint vectors (n, 5) of poses (n, 5) without sag, and which of them are out of reach (n,)."""
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
