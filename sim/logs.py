"""Ground, bunk and logs as bodies of the physics client, and the logs' state for display and judging."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from machine.profile import Bunk, Profile
from sim.crane import Quaternion, Shape, Vector
from sim.physics import BulletClient
from sim.scene import LogSpec
from sim.truth import Contact

STAKE_M = 0.08
# Stakes along the bunk, in bunk lengths: the grapple opens in the wide middle gap, two stakes still carry a log.
STAKE_PLACES = (-0.40, -0.14, 0.40)


@dataclass(frozen=True, slots=True)
class LogState:
    """One log now: centre, orientation (x, y, z, w), unit vector along it, speed of its fastest point; base frame."""

    position_m: Vector
    quaternion: Quaternion
    axis: Vector
    length_m: float
    diameter_m: float
    mass_kg: float
    speed_m_s: float


def bunk_shapes(profile: Profile) -> list[Shape]:
    """Floor and stakes of the bunk, in the base frame."""
    b = profile.bunk
    half = b.yaw_rad / 2
    turn = (0.0, 0.0, math.sin(half), math.cos(half))
    ground = profile.workspace.ground_z_m
    boxes = [((b.length_m, b.width_m, b.floor_z_m - ground), (0.0, 0.0, (b.floor_z_m + ground) / 2))]
    side = b.width_m / 2 + STAKE_M / 2
    stake = (STAKE_M, STAKE_M, b.stake_height_m)
    boxes += [
        (stake, (place * b.length_m, y, b.floor_z_m + b.stake_height_m / 2))
        for place in STAKE_PLACES
        for y in (-side, side)
    ]
    return [Shape("base", size, from_bunk(b, at), turn, (0.35, 0.37, 0.4)) for size, at in boxes]


def from_bunk(b: Bunk, point: Vector) -> Vector:
    """Point of the bunk's frame (x along it, z as in the base frame) in the base frame."""
    c, s = math.cos(b.yaw_rad), math.sin(b.yaw_rad)
    return (b.center_m[0] + c * point[0] - s * point[1], b.center_m[1] + s * point[0] + c * point[1], point[2])


def to_bunk(b: Bunk, point: Sequence[float]) -> Vector:
    """Point of the base frame in the bunk's frame."""
    c, s = math.cos(b.yaw_rad), math.sin(b.yaw_rad)
    x, y = point[0] - b.center_m[0], point[1] - b.center_m[1]
    return (c * x + s * y, c * y - s * x, point[2])


class Yard:
    """Ground, bunk and logs.  ``logs`` is a tuple of body ids in scene order."""

    def __init__(self, client: BulletClient, profile: Profile, contact: Contact, scene: Sequence[LogSpec]) -> None:
        self._p, self._scene = client, tuple(scene)
        ground = profile.workspace.ground_z_m
        box = client.createCollisionShape(client.GEOM_BOX, halfExtents=[15.0, 15.0, 0.5])
        look = client.createVisualShape(client.GEOM_BOX, halfExtents=[15.0, 15.0, 0.5], rgbaColor=[0.55, 0.6, 0.45, 1])
        self.ground: int = client.createMultiBody(0.0, box, look, basePosition=[0.0, 0.0, ground - 0.5])
        client.changeDynamics(self.ground, -1, lateralFriction=contact.ground_friction)
        self.bunk = tuple(self._fixed_box(s, contact.bunk_friction) for s in bunk_shapes(profile))
        self.masses: list[float] = []
        self.logs = tuple(self._log(spec, ground, contact) for spec in self._scene)

    def _fixed_box(self, s: Shape, friction: float) -> int:
        p, half = self._p, [x / 2 for x in s.size_m]
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half)
        look = p.createVisualShape(p.GEOM_BOX, halfExtents=half, rgbaColor=[*s.colour, 1])
        body: int = p.createMultiBody(0.0, shape, look, basePosition=s.position_m, baseOrientation=s.quaternion)
        p.changeDynamics(body, -1, lateralFriction=friction)
        return body

    def _log(self, s: LogSpec, ground: float, contact: Contact) -> int:
        p, r = self._p, s.diameter_m / 2
        mass = s.density_kg_m3 * math.pi * r * r * s.length_m
        shape = p.createCollisionShape(p.GEOM_CYLINDER, radius=r, height=s.length_m)
        look = p.createVisualShape(p.GEOM_CYLINDER, radius=r, length=s.length_m, rgbaColor=[0.55, 0.35, 0.18, 1])
        turn = p.getQuaternionFromEuler([0.0, math.pi / 2, s.yaw_rad])
        at = [s.x_m, s.y_m, ground + r]
        body: int = p.createMultiBody(mass, shape, look, basePosition=at, baseOrientation=turn)
        across = mass * (3.0 * r * r + s.length_m**2) / 12.0
        p.changeDynamics(
            body,
            -1,
            localInertiaDiagonal=[across, across, mass * r * r / 2.0],
            lateralFriction=contact.log_friction,
            rollingFriction=contact.log_rolling_m,
            spinningFriction=contact.log_rolling_m,
            linearDamping=0.0,
            angularDamping=0.0,
        )
        self.masses.append(mass)
        return body

    def states(self) -> list[LogState]:
        """The logs now, in scene order."""
        out = []
        for body, spec, mass in zip(self.logs, self._scene, self.masses, strict=True):
            position, turn = self._p.getBasePositionAndOrientation(body)
            m = self._p.getMatrixFromQuaternion(turn)
            linear, angular = self._p.getBaseVelocity(body)
            axis = (m[2], m[5], m[8])
            roll = sum(w * a for w, a in zip(angular, axis, strict=True))
            turn_rate = math.sqrt(max(0.0, sum(w * w for w in angular) - roll * roll))
            # No point of the log is faster than this.
            speed = math.hypot(*linear) + spec.length_m / 2 * turn_rate + spec.diameter_m / 2 * abs(roll)
            out.append(LogState(position, turn, axis, spec.length_m, spec.diameter_m, mass, speed))
        return out
