"""The arm as the planner sees it: cylindrical poses of the hanger pin, their joints, and the limits with
margin.

A pose is ``(slew_rad, r_m, z_m, ext_m, rot_rad)``: where the pin is, how far the telescope is out (the
redundancy) and how the rotator stands.  A straight line in poses is a straight line in the crane's plane
while it slews, which is how a grapple keeps its height.
The pin is where it truly is: where the profile knows how the column leans, its sag, and that of the load, are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import Final, NamedTuple

import numpy as np

from autonomy.motion.telescope import easiest
from machine.joints import JOINTS, Joint
from machine.kinematics import Unreachable
from machine.profile import Profile, joint_limits
from machine.sag import FOOT_SHARE, GRAVITY_M_S2, NEAR_M, ROUNDS, aim, aim_free, true_pin

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
SLEW_MARGIN_RAD: Final = 0.01
STOP_MARGIN: Final = 0.005
"""How far from its stops a joint is planned to stay, rad (EXT m): curves overshoot their points a little, and a
controller refuses what leaves the range by anything.  A motion that begins nearer may do so."""
ABOUT: Final = 1e-9
"""Rounding of a joint at its stop."""
_GRAIN_M: Final = 0.1
"""Places are as good as each other for the telescope within this."""
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
    """Kinematics and limits of one machine with a load [kg] in its grapple, prepared for planning.

    ``stretches``: over a place the telescope is where it is quickest from there over the bunk, else as in `reach`.
    """

    def __init__(self, profile: Profile, load_kg: float = 0.0, stretches: bool = True) -> None:
        self.profile, self.load_kg, self._stretches = profile, load_kg, stretches
        self._kin = profile.kinematics
        self._limits = joint_limits(profile)
        specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self.speed = SPEED_SHARE * np.array([s.speed_limit for s in specs])
        self.acceleration = ACCELERATION_SHARE * np.array([s.acceleration_limit for s in specs])
        self.sampled_acceleration = self.acceleration * (SAMPLED_ACCELERATION_SHARE / ACCELERATION_SHARE)
        self._easy: dict[tuple[int, int, int], float | None] = {}
        self._valves = [s.valve for s in specs]
        self._pump_m3_s = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s

    def loaded(self, load_kg: float) -> Arm:
        """The same machine with another load."""
        return self if load_kg == self.load_kg else Arm(self.profile, load_kg, self._stretches)

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
        q, outside = self._settled(poses)
        return self._one_by_one(poses) if np.any(outside) else q

    def _settled(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All at once, and which are out of reach: `machine.sag.aim` for arrays."""
        q, outside = self.joints_or_outside(poses)
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
            q, outside = self.joints_or_outside(at)
        return q, outside

    def _one_by_one(self, poses: np.ndarray) -> np.ndarray:
        """The same, to say what is in the way."""
        sag, out, limits = self.profile.sag, np.empty_like(poses), self._limits
        for i, (slew, r, z, ext, rot) in enumerate(poses.tolist()):
            theta = slew + self._kin.theta1_offset_rad
            angles = aim(sag, self._kin, limits, r * cos(theta), r * sin(theta), z, ext, self.load_kg)
            out[i] = (slew, angles[1], angles[2], ext, rot)
            if i == 0:
                low, high = self._room(out[0])
                limits = tuple(zip(low.tolist(), high.tolist(), strict=True))
        return out

    def _room(self, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest joints of a motion that begins at joints (5,)."""
        low, high = np.array(self._limits).T
        inner, outer = low + STOP_MARGIN, high - STOP_MARGIN
        at = np.where(np.isfinite(first), np.clip(first, low, high), inner)
        return np.minimum(inner, at), np.maximum(outer, at)

    def joints_about(self, poses: np.ndarray) -> np.ndarray:
        """The same all at once, as if the column stood straight: to look at many ways, not to drive one."""
        q, outside = self.joints_or_outside(poses)
        if np.any(outside):
            self.joints(poses[np.argmax(outside)][None])  # says what is in the way
            raise Unreachable("a pose of the way is at the edge of the crane's reach")
        return q

    def joints_or_outside(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        low, high = self._room(q[0])
        return q, ~np.all((q >= low - ABOUT) & (q <= high + ABOUT), axis=1) | (heron < 0.0)

    def over(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """The pose above a point at ``low_z_m`` whose telescope also serves at ``high_z_m``; rotator at 0.

        Raises:
            Unreachable: with the reason.
        """
        if not self._stretches:
            return self.reach(x, y, low_z_m, high_z_m)
        try:
            return self._over(x, y, low_z_m, high_z_m, self._easy_extension(hypot(x, y), low_z_m, high_z_m))
        except Unreachable:
            return self.reach(x, y, low_z_m, high_z_m)

    def reach(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """The same with the telescope out only as far as leaves the arm speed in all directions there.

        Raises:
            Unreachable: with the reason.
        """
        r = hypot(x, y) - self._kin.a1_m
        stretch = max(hypot(r, z - self._kin.d1_m) for z in (low_z_m, high_z_m)) / EASY_STRETCH
        return self._over(x, y, low_z_m, high_z_m, stretch - self._kin.a2_m - self._kin.d4_m)

    def _over(self, x: float, y: float, low_z_m: float, high_z_m: float, wish_m: float) -> Pose:
        least, most = self._limits[Joint.EXT]
        wish_m = min(max(wish_m, least + 2.0 * STOP_MARGIN), most - 2.0 * STOP_MARGIN)
        slew, _, _, ext = aim_free(self.profile, x, y, low_z_m, wish_m, self.load_kg)
        low, high = self._limits[Joint.SLEW]
        if not low + SLEW_MARGIN_RAD <= slew <= high - SLEW_MARGIN_RAD:
            raise Unreachable(f"point ({x:.2f}, {y:.2f}) m is at the stop of the slew")
        pose = Pose(slew, hypot(x, y), low_z_m, ext, 0.0)
        heights = high_z_m, low_z_m, 0.5 * (low_z_m + high_z_m), high_z_m
        self.joints(np.array([pose.at_height(z) for z in heights]))
        return pose

    def _easy_extension(self, r_m: float, low_z_m: float, high_z_m: float) -> float:
        """The telescope's best extension at a distance, m, about: for the way up and over the bunk."""
        key = round(r_m / _GRAIN_M), round(low_z_m / _GRAIN_M), round(high_z_m / _GRAIN_M)
        if key not in self._easy:
            r, low, high = (k * _GRAIN_M for k in key)
            down, up = (Pose(0.0, r, z, 0.0, 0.0) for z in (low, high))
            self._easy[key] = easiest(self, down, up, up._replace(r_m=hypot(*self.profile.bunk.center_m)))
        if (found := self._easy[key]) is None:
            raise Unreachable("no extension serves at both heights")
        return found
