"""Collision geometry: obstacles as boxes, capsules and the ground, and the moving crane as swept capsules.

Everything that moves is a capsule: boom, stick with telescope, the hanging grapple and the log in it.  Everything that
stands still is a box turned about the vertical, a capsule (logs, trees) or the ground.  ``autonomy.motion.clearance``
computes their distances.  Crane base frame, m and rad.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from math import asin, atan2, cos, pi, remainder, sin
from typing import Final

import numpy as np

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.bunk import stake_walls
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m, pin_to_jaw_pivot_m
from machine.joints import Joint
from machine.profile import Bunk, Profile

FLOOR_THICKNESS_M: Final = 0.12
FRAME_HALF_WIDTH_M: Final = 0.45
HOOD_M: Final = (0.6, 0.65, 0.6)
"""Start of the hood ahead of the articulation, half its width, half its height."""
FRONT_OVERHANG_M: Final = 0.85
REAR_OVERHANG_M: Final = 2.0
"""Overhang of the frames beyond their axles."""
BOOM_RADIUS_M: Final = 0.17
STICK_RADIUS_M: Final = 0.14
GRAPPLE_RADIUS_M: Final = 0.20
JAW_RADIUS_M: Final = 0.10

Ground = float | Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A height, or heights at x and y."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box turned about the vertical: centre, half edges, turn [rad]; ``name`` is for sentences."""

    name: str
    center_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Capsule:
    """A capsule between two points."""

    name: str
    a_m: tuple[float, float, float]
    b_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True, slots=True)
class ObstacleArrays:
    """Obstacles as arrays: k boxes (centres, half edges, cos and sin of their turn) and j capsules (middles, half axes,
    radii), and the names of the ground and of them all.
    """

    ground: Ground
    names: tuple[str, ...]
    center: np.ndarray
    half: np.ndarray
    turn: np.ndarray
    middle: np.ndarray
    along: np.ndarray
    radius: np.ndarray

    def near(self, low: np.ndarray, high: np.ndarray) -> ObstacleArrays:
        """Return the obstacles without those wholly outside a range (3,) to (3,)."""
        wide = np.hypot(self.half[:, 0], self.half[:, 1])
        box = np.column_stack([wide, wide, self.half[:, 2]])
        rod = np.abs(self.along) + self.radius[:, None]
        boxes = np.all((self.center - box < high) & (self.center + box > low), axis=1)
        capsules = np.all((self.middle - rod < high) & (self.middle + rod > low), axis=1)
        names = tuple(n for n, in_range in zip(self.names, [True, *boxes, *capsules], strict=True) if in_range)
        return ObstacleArrays(
            self.ground,
            names,
            self.center[boxes],
            self.half[boxes],
            self.turn[boxes],
            self.middle[capsules],
            self.along[capsules],
            self.radius[capsules],
        )


@dataclass(frozen=True)
class CollisionScene:
    """The obstacles about the crane."""

    ground: Ground
    boxes: tuple[Box, ...] = ()
    capsules: tuple[Capsule, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the ground, the boxes and the capsules: the columns of `clearances`."""
        return ("the ground", *(b.name for b in self.boxes), *(r.name for r in self.capsules))

    @cached_property
    def arrays(self) -> ObstacleArrays:
        """The obstacles as arrays."""
        yaw = np.array([b.yaw_rad for b in self.boxes])
        begin, end = (np.array([getattr(r, f) for r in self.capsules]).reshape(-1, 3) for f in ("a_m", "b_m"))
        return ObstacleArrays(
            self.ground,
            self.names,
            np.array([b.center_m for b in self.boxes]).reshape(-1, 3),
            np.array([b.half_m for b in self.boxes]).reshape(-1, 3),
            np.column_stack([np.cos(yaw), np.sin(yaw)]),
            (begin + end) / 2,
            (end - begin) / 2,
            np.array([r.radius_m for r in self.capsules]),
        )


@dataclass(frozen=True, slots=True)
class HeldLog:
    """A log in the grapple, gripped ``along_m`` from its middle, its axis ``skew_rad`` off the jaws' and ``tilt_rad``
    off the level.
    """

    length_m: float
    diameter_m: float
    along_m: float = 0.0
    skew_rad: float = 0.0
    tilt_rad: float = 0.0


def held_log(arm: Arm, pose: Pose, log: LogObservation) -> HeldLog:
    """Describe a log as the grapple holds it at a pose: seen hanging in it, or lying where it will be gripped."""
    yaw = grapple_yaw(arm.profile, (pose.slew_rad, 0.0, 0.0, 0.0, pose.rot_rad)) - pi / 2
    skew = remainder(atan2(log.axis[1], log.axis[0]) - yaw, pi)
    x, y = arm.xy(pose)
    ahead = cos(yaw + skew), sin(yaw + skew)
    along = (x - log.center_m[0]) * ahead[0] + (y - log.center_m[1]) * ahead[1]
    up = log.axis[2] if log.axis[0] * ahead[0] + log.axis[1] * ahead[1] > 0.0 else -log.axis[2]
    return HeldLog(log.length_m, log.diameter_m, along, skew, asin(min(max(up, -1.0), 1.0)))


@dataclass(frozen=True, slots=True)
class SweptCapsules:
    """Moving capsules: ends (n, m, 3) of m parts at n samples, radii (m,), names, and which of them hang (m,)."""

    a: np.ndarray
    b: np.ndarray
    radius: np.ndarray
    names: tuple[str, ...]
    hangs: np.ndarray = field(repr=False)

    def rows(self, at: list[int]) -> SweptCapsules:
        """Select some samples alone."""
        return SweptCapsules(self.a[at], self.b[at], self.radius, self.names, self.hangs)

    def shifted(self, offset: np.ndarray, depth_m: float) -> SweptCapsules:
        """Swing the hanging parts of the capsules: ``offset`` (n, 2) moves a point ``depth_m`` below the pin."""
        move = np.zeros((len(offset), 1, 3))
        move[:, 0, :2] = offset
        hanging = self.hangs[None, :, None]
        # Parts that begin at the pin stay there at their upper end; the log moves as a whole.
        top = self.a + move * hanging * (self.depth(self.a) / depth_m)
        low = self.b + move * hanging * (self.depth(self.b) / depth_m)
        return SweptCapsules(top, low, self.radius, self.names, self.hangs)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Compute the depth of points (n, m, 3) below the pin, (n, m, 1)."""
        pin_z = self.b[:, 1:2, 2:3]
        result: np.ndarray = np.maximum(pin_z - points[..., 2:3], 0.0)
        return result


def bunk_boxes(bunk: Bunk) -> tuple[Box, ...]:
    """Return the floor, and each row of stakes as a wall: a log passes over the whole row wherever the stakes are."""
    x, y = bunk.center_m
    rows = zip(("left", "right"), stake_walls(bunk), strict=True)
    walls = tuple(Box(f"the {name} stakes", row.center_m, row.half_m, row.yaw_rad) for name, row in rows)
    floor = (bunk.length_m / 2, bunk.width_m / 2, FLOOR_THICKNESS_M / 2)
    return (Box("the bunk's floor", (x, y, bunk.floor_z_m - FLOOR_THICKNESS_M / 2), floor, bunk.yaw_rad), *walls)


def carrier_boxes(profile: Profile) -> tuple[Box, ...]:
    """Return frames, hood and wheels of the carrier, straight and lowest; none on a machine without wheels."""
    c = profile.carrier
    if c is None:
        return ()
    x0, y0, z0 = c.crane_base_m
    turn, s = cos(c.crane_yaw_rad), sin(c.crane_yaw_rad)

    def box(name: str, at: tuple[float, float, float], half: tuple[float, float, float]) -> Box:
        x, y = at[0] - x0, at[1] - y0
        return Box(name, (turn * x + s * y, turn * y - s * x, at[2] - z0), half, -c.crane_yaw_rad)

    front, rear = c.front_axle_m + FRONT_OVERHANG_M, c.rear_axle_m + REAR_OVERHANG_M
    wheel = (c.wheel_radius_m, c.wheel_width_m / 2, c.wheel_radius_m)
    return (
        box("the rear frame", (-rear / 2, 0.0, 0.1), (rear / 2, FRAME_HALF_WIDTH_M, 0.2)),
        box("the front half", ((front + HOOD_M[0]) / 2, 0.0, HOOD_M[2] / 2), ((front - HOOD_M[0]) / 2, *HOOD_M[1:])),
        *(
            box("a wheel", (axle, side * c.track_width_m / 2, -c.arm_drop_low_m), wheel)
            for axle in (c.front_axle_m, -c.rear_axle_m)
            for side in (-1.0, 1.0)
        ),
    )


def log_capsules(logs: Iterable[LogObservation]) -> tuple[Capsule, ...]:
    """Convert logs to capsules; their round ends stay inside the logs."""
    capsules = []
    for log in logs:
        half = max(log.length_m - log.diameter_m, 0.0) / 2
        ends = ((c - half * a, c + half * a) for c, a in zip(log.center_m, log.axis, strict=True))
        a, b = zip(*ends, strict=True)
        capsules.append(Capsule(f"log {log.id}", a, b, log.diameter_m / 2))
    return tuple(capsules)


def tree_capsule(
    x_m: float, y_m: float, radius_m: float, foot_z_m: float, height_m: float = 15.0, number: int = 1
) -> Capsule:
    """Return a standing tree."""
    return Capsule(f"tree {number}", (x_m, y_m, foot_z_m), (x_m, y_m, foot_z_m + height_m), radius_m)


def collision_scene(
    profile: Profile,
    logs: Iterable[LogObservation] = (),
    trees: Iterable[Capsule] = (),
    ground: Ground | None = None,
    without: Iterable[int] = (),
) -> CollisionScene:
    """Collect the machine's own obstacles, the logs except those of ``without``, the trees and the ground."""
    left_out = set(without)
    capsules = (*log_capsules(log for log in logs if log.id not in left_out), *trees)
    level = profile.workspace.ground_z_m if ground is None else ground
    return CollisionScene(level, (*carrier_boxes(profile), *bunk_boxes(profile.bunk)), capsules)


def swept_capsules(
    profile: Profile, q: np.ndarray, pin: np.ndarray, held: HeldLog | None, opened: bool = True
) -> SweptCapsules:
    """Model the crane at joints (n, 5) with its true pin at (n, 3), and its load; ``opened``: the jaws are open."""
    kin, n = profile.kinematics, len(q)
    theta = q[:, Joint.SLEW] + kin.theta1_offset_rad
    c, s = np.cos(theta), np.sin(theta)
    lift = q[:, Joint.LIFT] + kin.theta2_offset_rad

    def at(r: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.column_stack([r * c, r * s, z])

    foot = at(np.full(n, kin.a1_m), np.full(n, kin.d1_m))
    elbow = at(kin.a1_m + kin.a2_m * np.cos(lift), kin.d1_m + kin.a2_m * np.sin(lift))
    # The stick reaches back behind its pin no farther than its radius; the telescope ends at the hanger.
    yaw = q[:, Joint.SLEW] + q[:, Joint.ROT] + grapple_yaw(profile, [0.0] * len(Joint))
    opening = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(n)])
    jaws = profile.grapple.jaws
    pivot = pin - np.array([0.0, 0.0, pin_to_jaw_pivot_m(kin)])
    parts: list[tuple[str, np.ndarray, np.ndarray, float, bool]] = [
        ("boom", foot, elbow, BOOM_RADIUS_M, False),
        ("stick", elbow, pin, STICK_RADIUS_M, False),
        ("grapple", pin, pivot, GRAPPLE_RADIUS_M, True),
    ]
    half_gap = jaws.half_gap_m[0] if opened and held is None else 0.25
    deep = jaws.tip_below_pin_m[0] if opened and held is None else lowest_tip_below_pin_m(jaws)
    for side in (-1.0, 1.0):
        tip = pin + side * half_gap * opening - np.array([0.0, 0.0, deep - JAW_RADIUS_M])
        parts.append(("tong", pivot, tip, JAW_RADIUS_M, True))
    if held is not None:
        turn = yaw - pi / 2 + held.skew_rad
        level, up = cos(held.tilt_rad), sin(held.tilt_rad)
        axis = np.column_stack([level * np.cos(turn), level * np.sin(turn), np.full(n, up)])
        low = lowest_tip_below_pin_m(jaws) - held.diameter_m / 2
        middle = pin - held.along_m * axis - np.array([0.0, 0.0, low])
        half = max(held.length_m - held.diameter_m, 0.0) / 2
        parts.append(("log", middle - half * axis, middle + half * axis, held.diameter_m / 2, True))
    names, a, b, radius, hangs = zip(*parts, strict=True)
    return SweptCapsules(np.stack(a, 1), np.stack(b, 1), np.array(radius), names, np.array(hangs))
