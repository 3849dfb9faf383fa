"""Kinematics and limits of the arm for planning: poses of the hanger pin, their joints, and the limits with margin.

A pose is ``(slew_rad, r_m, z_m, ext_m, rot_rad)``: the place of the pin, the extension (the redundancy) and the
rotator. A straight line in poses is a straight line in the crane's plane while it slews, so a grapple keeps its
height.  The pin is its true place: where the profile knows the column's sag, that of crane and load is compensated.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin
from typing import Final, NamedTuple

import numpy as np

from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from machine.geometry.sag import AIM_TOLERANCE_M, FOOT_SHARE, GRAVITY_M_S2, MAX_AIM_ITERATIONS, aim, aim_free, true_pin
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
    """Compute how far what hangs from the pin is beside it, along the base's x and y, per metre below it [m/m].

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
        """Compute pump flow of joint velocities (n, 5) at positions (n, 5), as a share of what a plan may use, (n,)."""
        flow = np.zeros(len(q))
        for j, valve in enumerate(self._valves):
            per_speed = np.where(velocity[:, j] >= 0.0, valve.flow_plus, valve.flow_minus)
            lever = np.interp(q[:, j], valve.lever_at, valve.lever) if valve.lever else 1.0
            flow += np.abs(velocity[:, j]) * per_speed * lever
        return flow / self._pump_m3_s

    def pose(self, q: Sequence[float]) -> Pose:
        """Compute the pose of a joint vector (5 elements, rad and m)."""
        x, y, z = true_pin(self.profile.sag, self._kin, q, self.load_kg)
        return Pose(q[Joint.SLEW], hypot(x, y), z, q[Joint.EXT], q[Joint.ROT])

    def xy(self, pose: Pose) -> tuple[float, float]:
        """Compute the horizontal position of the jaws below a pose of the pin in the base frame, m."""
        theta, (x, y) = pose.slew_rad + self._kin.theta1_offset_rad, self._aside_m
        return pose.r_m * cos(theta) + x, pose.r_m * sin(theta) + y

    def joints(self, poses: np.ndarray) -> np.ndarray:
        """Compute joint vectors (n, 5) of poses (n, 5), with the sag compensated.

        The first pose is where a motion begins: it may be at a stop, from which the others keep away.

        Raises:
            Unreachable: a pose is outside the joint limits.
        """
        q, outside = self._sag_compensated(poses)
        return self._joints_or_reason(poses) if np.any(outside) else q

    def _sag_compensated(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute joints of all poses at once, and which are out of reach: `machine.geometry.sag.aim` for arrays."""
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
        """Compute joints pose by pose, which raises with the reason."""
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
        """Return the least and greatest joints of a motion that begins at joints (5,)."""
        low, high = np.array(self._limits).T
        inner, outer = low + STOP_MARGIN, high - STOP_MARGIN
        at = np.where(np.isfinite(first), np.clip(first, low, high), inner)
        return np.minimum(inner, at), np.maximum(outer, at)

    def approximate_joints(self, poses: np.ndarray) -> np.ndarray:
        """Compute joints of poses without sag, to compare many paths; raise ``Unreachable`` for a pose out of reach."""
        q, outside = self.straight_column_joints(poses)
        if np.any(outside):
            self.joints(poses[np.argmax(outside)][None])  # raises with the reason
            raise Unreachable("a pose of the path is at the edge of the crane's reach", "motion.edge-of-reach")
        return q

    def straight_column_joints(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute joint vectors (n, 5) of poses (n, 5) without sag, and which of them are out of reach (n,)."""
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


# -- The pose of the hanger pin in the crane's plane.


class Pose(NamedTuple):
    """Place of the hanger pin in the crane's plane, extension of the telescope, and rotator angle."""

    slew_rad: float
    r_m: float
    z_m: float
    ext_m: float
    rot_rad: float

    def at_height(self, z_m: float) -> Pose:
        """Return the same pose at another height of the pin."""
        return self._replace(z_m=z_m)


# -- Choice of the telescope's extension along a path, the arm's redundancy, for the shortest travel time.
#
# With a fixed telescope, a crane raises, lowers and retracts its grapple with the boom, its slowest joint;
# operators let the telescope do most of it.  The corners of a path get those extensions with which every joint, and
# the pump, has least to do. Speeds only, no time laws; no clock, no randomness.

EXTENSION_COUNT: Final = 13
"""Number of extensions that are compared."""
_SAMPLES: Final = 7
_TOTAL_WORK_WEIGHT: Final = 0.15
"""Weight of all joints' work relative to that of the busiest joint."""
OUTER_RESERVE_M: Final = 0.2
"""Reserve at the outer end for a descent, where a log may not be exactly where it was detected."""
END_RESERVE_M: Final = 0.03
"""Reserve at both ends."""


def candidate_extensions(arm: ArmKinematics) -> np.ndarray:
    """List the extensions to compare, m."""
    low, high = joint_limits(arm.profile)[Joint.EXT]
    return np.linspace(low + END_RESERVE_M, high - END_RESERVE_M, EXTENSION_COUNT)


def fastest_extension(arm: ArmKinematics, low: Pose, high: Pose, home: Pose) -> float | None:
    """Find the extension from which the crane gets up and over ``home`` fastest; None where none serves at both heights
    with `OUTER_RESERVE_M` to spare.
    """
    least, most = joint_limits(arm.profile)[Joint.EXT]
    free = np.linspace(least + END_RESERVE_M, most - OUTER_RESERVE_M, EXTENSION_COUNT)
    heights = np.array([low, low.at_height(0.5 * (low.z_m + high.z_m)), high])
    poses = np.repeat(heights[None], len(free), axis=0)
    poses[:, :, 3] = free[:, None]
    _, outside = arm.straight_column_joints(poses.reshape(-1, 5))
    any_way = candidate_extensions(arm)
    home_s = np.min(full_speed_times(arm, high, home, any_way, any_way), axis=1)
    seconds = np.min(full_speed_times(arm, low, high, free, any_way) + home_s, axis=1)
    seconds = np.where(outside.reshape(len(free), 3).any(axis=1), np.inf, seconds)
    best = int(np.argmin(seconds))
    return float(free[best]) if np.isfinite(seconds[best]) else None


def full_speed_times(arm: ArmKinematics, start: Pose, goal: Pose, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Time a straight path at full speed, from every extension ``before`` (n,) to every ``after`` (m,), (n, m).

    Infinite where it leaves the crane's reach.
    """
    share = np.linspace(0.0, 1.0, _SAMPLES)
    line = np.array(start) + share[:, None] * (np.array(goal) - np.array(start))
    n, m = len(before), len(after)
    poses = np.broadcast_to(line, (n, m, *line.shape)).copy()
    poses[..., Joint.EXT] = before[:, None, None] + share * (after[None, :, None] - before[:, None, None])
    q, outside = arm.straight_column_joints(poses.reshape(-1, 5))
    step = np.diff(q.reshape(n, m, _SAMPLES, 5), axis=2)
    middle = q.reshape(n, m, _SAMPLES, 5)[:, :, :-1] + 0.5 * step
    turned = np.sum(np.abs(step), axis=2) / arm.speed
    oil = arm.pump_load(middle.reshape(-1, 5), step.reshape(-1, 5)).reshape(n, m, -1).sum(axis=2)
    seconds = np.maximum(np.max(turned, axis=2), oil) + _TOTAL_WORK_WEIGHT * np.sum(turned, axis=2)
    return np.where(outside.reshape(n, m, _SAMPLES).any(axis=2), np.inf, seconds)


def with_fastest_extensions(arm: ArmKinematics, via: Sequence[Pose]) -> tuple[Pose, ...]:
    """Return the via points with the fastest extensions between the ends; unchanged where none is in reach."""
    if len(via) < 3:
        return tuple(via)
    free = candidate_extensions(arm)
    choices = [np.array([via[0].ext_m]), *[np.append(free, p.ext_m) for p in via[1:-1]], np.array([via[-1].ext_m])]
    best, came = np.zeros(1), []
    for k in range(len(via) - 1):
        total = best[:, None] + full_speed_times(arm, via[k], via[k + 1], choices[k], choices[k + 1])
        came.append(np.argmin(total, axis=0))
        best = np.min(total, axis=0)
    if not np.isfinite(best[0]):
        return tuple(via)
    at, out = 0, [via[-1]]
    for k in range(len(via) - 2, 0, -1):
        at = int(came[k][at])
        out.append(via[k]._replace(ext_m=float(choices[k][at])))
    return (via[0], *reversed(out))


# -- The arm for planning: poses above a point, with the telescope where it is fastest or most compact.
#
# Inputs: one machine with a load.  Failure: ``Unreachable``.

SLEW_MARGIN_RAD: Final = 0.01
_EXTENSION_CACHE_GRID_M: Final = 0.1
"""Grid of the cache of extensions: places within one cell share an extension."""
DEXTEROUS_STRETCH: Final = 0.88
"""Distance of the pin from the boom pin, as a share of the straight arm's length, that leaves speed in all
directions."""


class Arm(ArmKinematics):
    """One machine with a load [kg] in its grapple, prepared for planning; ``slope`` as in `ArmKinematics`.

    ``free_telescope``: `pose_above` chooses the extension from which the crane gets over the bunk fastest; otherwise it
    works like `compact_pose_above`.
    """

    def __init__(
        self, profile: Profile, load_kg: float = 0.0, free_telescope: bool = True, slope: tuple[float, float] = LEVEL
    ) -> None:
        super().__init__(profile, load_kg, slope)
        self._free_telescope = free_telescope
        self._extension_cache: dict[tuple[int, int, int], float | None] = {}

    def of(self, profile: Profile) -> Arm:
        """Return the same arm of another profile of the machine."""
        return Arm(profile, self.load_kg, self._free_telescope, self.slope)

    def loaded(self, load_kg: float) -> Arm:
        """Return the same machine with another load."""
        return self if load_kg == self.load_kg else Arm(self.profile, load_kg, self._free_telescope, self.slope)

    def pose_above(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """Compute the pose with the jaws above a point, the pin at ``low_z_m``, whose extension also serves at
        ``high_z_m``; rotator at 0.

        Raises:
            Unreachable: the point is out of reach at one of the heights.
        """
        x, y = x - self._aside_m[0], y - self._aside_m[1]
        if not self._free_telescope:
            return self._compact_pose(x, y, low_z_m, high_z_m)
        try:
            return self._pose_with_extension(
                x, y, low_z_m, high_z_m, self._fastest_extension(hypot(x, y), low_z_m, high_z_m)
            )
        except Unreachable:
            return self._compact_pose(x, y, low_z_m, high_z_m)

    def compact_pose_above(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """Compute the same with the telescope out only as far as leaves the arm speed in all directions there.

        Raises:
            Unreachable: the point is out of reach at one of the heights.
        """
        return self._compact_pose(x - self._aside_m[0], y - self._aside_m[1], low_z_m, high_z_m)

    def _compact_pose(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """Compute the pose with the pin above a point."""
        r = hypot(x, y) - self._kin.a1_m
        stretch = max(hypot(r, z - self._kin.d1_m) for z in (low_z_m, high_z_m)) / DEXTEROUS_STRETCH
        return self._pose_with_extension(x, y, low_z_m, high_z_m, stretch - self._kin.a2_m - self._kin.d4_m)

    def _pose_with_extension(self, x: float, y: float, low_z_m: float, high_z_m: float, wish_m: float) -> Pose:
        least, most = self._limits[Joint.EXT]
        wish_m = min(max(wish_m, least + 2.0 * STOP_MARGIN), most - 2.0 * STOP_MARGIN)
        slew, _, _, ext = aim_free(self.profile, x, y, low_z_m, wish_m, self.load_kg)
        low, high = self._limits[Joint.SLEW]
        if not low + SLEW_MARGIN_RAD <= slew <= high - SLEW_MARGIN_RAD:
            raise Unreachable(f"point ({x:.2f}, {y:.2f}) m is at the stop of the slew", "motion.at-slew-stop")
        pose = Pose(slew, hypot(x, y), low_z_m, ext, 0.0)
        heights = high_z_m, low_z_m, 0.5 * (low_z_m + high_z_m), high_z_m
        self.joints(np.array([pose.at_height(z) for z in heights]))
        return pose

    def _fastest_extension(self, r_m: float, low_z_m: float, high_z_m: float) -> float:
        """Find the extension from which the crane gets up and over the bunk fastest, from a horizontal distance, m."""
        key = (
            round(r_m / _EXTENSION_CACHE_GRID_M),
            round(low_z_m / _EXTENSION_CACHE_GRID_M),
            round(high_z_m / _EXTENSION_CACHE_GRID_M),
        )
        if key not in self._extension_cache:
            r, low, high = (k * _EXTENSION_CACHE_GRID_M for k in key)
            down, up = (Pose(0.0, r, z, 0.0, 0.0) for z in (low, high))
            self._extension_cache[key] = fastest_extension(
                self, down, up, up._replace(r_m=hypot(*self.profile.bunk.center_m))
            )
        if (extension_m := self._extension_cache[key]) is None:
            raise Unreachable("no extension serves at both heights", "motion.no-common-extension")
        return extension_m
