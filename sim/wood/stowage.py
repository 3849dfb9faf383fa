"""Stowage: the load at rest in a carrier's bunk as one rigid body of the carrier.

Bullet lets logs at rest on the ground sleep, but never those on a moving machine, and solves their contacts anew 400
times a second: with a full bunk, nine tenths of a step.  When no log has moved against the bunk for a while, the logs
are therefore *stowed*: their contacts rest, and a body with their mass, centre and inertia is fixed to the rear frame,
so tyres, arms and frame carry the same load.  They wake where they lie, with the bunk's speed, before anything comes
near them, and when the direction of their weight differs from that at rest (a start, a stop, a slope, a bump): then
friction has to hold them again.  Nothing in or near the grapple is ever stowed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machine.profile import Profile
from sim.bullet.body import Body, Pose
from sim.bullet.client import GRAVITY_M_S2, BulletClient
from sim.geometry import Quaternion, Vector, rpy_quaternion
from sim.wood.bunk import to_bunk
from sim.wood.logs import LogBodies

STILL_M_S: Final = 0.01
STILL_RAD_S: Final = 0.03
"""A log slower than STILL_M_S and this, relative to the bunk, is still."""
STILL_S: Final = 0.5
"""All logs are stowed when all have been still for this long."""
NEAR_M: Final = 0.15
"""Whatever comes this near wakes them: several times what the fastest log of a grasp moves between two checks."""
WEIGHT_TILT_RAD: Final = 0.05
"""Limit of the weight's change of direction: less than what sets a log rolling on a flat floor (0.08)."""
WEIGHT_SHARE: Final = 0.1
"""Limit of the weight's relative change."""
WEIGHT_FILTER_S: Final = 0.1
"""Time constant of the bunk's filtered acceleration: faster vibration of the steel moves no log."""
FOLLOW_M: Final = 0.0005
FOLLOW_RAD: Final = 0.0002
"""Stowed logs follow the bunk once it has moved by more than FOLLOW_M or this."""
FIXED_JOINT_N: Final = 1e9
COLLIDE_ALL, COLLISION_GROUP, COLLIDE_NONE = -1, 1, 0
"""Bullet's masks and groups of collision."""

Box = tuple[Vector, Vector]


class Stowage:
    """Call ``watch`` after every ``check_period_s`` of physics.

    ``machine`` is the carrier's body, its root the rear frame with the bunk; ``grapple_links`` are the links that may
    touch a load.
    """

    def __init__(
        self,
        client: BulletClient,
        machine: Body,
        profile: Profile,
        grapple_links: Iterable[str],
        log_bodies: LogBodies,
        check_period_s: float,
    ) -> None:
        self._p, self._machine, self._bunk, self._log_bodies, self._check_period_s = (
            client,
            machine,
            profile.bunk,
            log_bodies,
            check_period_s,
        )
        self._grapple_links = {machine.link[name] for name in grapple_links}
        self._log_of = {body: i for i, body in enumerate(log_bodies.body_ids)}
        self._weight = ApparentWeight(check_period_s)
        self._weight_at_rest: Vector = (0.0, 0.0, 0.0)
        self._still_s = 0.0
        self._at: Pose = client.getBasePositionAndOrientation(machine.body)
        self._relative_poses: list[Pose] = []
        self._around: Box = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._fixed_body: tuple[int, int] | None = None

    def watch(self) -> None:
        """Stow logs at rest; wake them before they are touched or shaken."""
        p = self._p
        at, moving = p.getBasePositionAndOrientation(self._machine.body), p.getBaseVelocity(self._machine.body)
        self._weight.update(moving[0], p.getMatrixFromQuaternion(at[1]))
        stowed = self._log_bodies.stowed
        if not stowed:
            self._rest(at, moving)
        elif self._weight.differs(self._weight_at_rest) or self._approached(self._around, stowed):
            self._wake(at, moving)
        elif _moved(at, self._at):
            self._follow(at)

    def _rest(self, at: Pose, moving: tuple[Vector, Vector]) -> None:
        """Count how long the load in the bunk has been still; stow it after STILL_S."""
        aboard = self._aboard()
        if not aboard or not all(self._lies_still(self._log_bodies.body_ids[i], at[0], *moving) for i in aboard):
            self._still_s = 0.0
            return
        self._still_s += self._check_period_s
        if self._still_s >= STILL_S and not self._approached(self._box(aboard), aboard):
            self._stow(aboard, at, moving)

    def _aboard(self) -> tuple[int, ...]:
        """Find the logs with their middle between the stakes, above the floor."""
        p, b = self._p, self._bunk
        inward = p.invertTransform(*self._machine.pose("base"))
        log_indices = []
        for i, log in enumerate(self._log_bodies.body_ids):
            x, y, z = to_bunk(b, p.multiplyTransforms(*inward, *p.getBasePositionAndOrientation(log))[0])
            if abs(x) < b.length_m / 2 and abs(y) < b.width_m / 2 and z > b.floor_z_m:
                log_indices.append(i)
        return tuple(log_indices)

    def _lies_still(self, log: int, origin: Vector, linear: Vector, angular: Vector) -> bool:
        position_m, (v, w) = self._p.getBasePositionAndOrientation(log)[0], self._p.getBaseVelocity(log)
        with_bunk = _carried(linear, angular, origin, position_m)
        return math.dist(w, angular) < STILL_RAD_S and math.dist(v, with_bunk) < STILL_M_S

    def _approached(self, box: Box, load: Sequence[int]) -> bool:
        """Tell whether the grapple, or a log that is not part of the load, reaches into the box."""
        for body, link in self._p.getOverlappingObjects(*box) or ():
            if (
                (link in self._grapple_links)
                if body == self._machine.body
                else self._log_of.get(body, load[0]) not in load
            ):
                return True
        return False

    def _box(self, load: Sequence[int]) -> Box:
        """Compute the surroundings of the load: its bounding box widened by ``NEAR_M``."""
        lows, highs = zip(*(self._p.getAABB(self._log_bodies.body_ids[i]) for i in load), strict=True)
        low, high = ([f(c) for c in zip(*side, strict=True)] for f, side in ((min, lows), (max, highs)))
        return (low[0] - NEAR_M, low[1] - NEAR_M, low[2] - NEAR_M), (
            high[0] + NEAR_M,
            high[1] + NEAR_M,
            high[2] + NEAR_M,
        )

    def _stow(self, aboard: tuple[int, ...], at: Pose, moving: tuple[Vector, Vector]) -> None:
        p, log_bodies = self._p, self._log_bodies
        inward = p.invertTransform(*at)
        self._relative_poses = [
            p.multiplyTransforms(*inward, *p.getBasePositionAndOrientation(log_bodies.body_ids[i])) for i in aboard
        ]
        self._at, self._weight_at_rest, self._around = at, self._weight.now, self._box(aboard)
        self._fixed_body = self._fix(aboard, at, moving)
        for i in aboard:
            p.setCollisionFilterGroupMask(log_bodies.body_ids[i], -1, COLLIDE_NONE, COLLIDE_NONE)
            p.resetBaseVelocity(log_bodies.body_ids[i], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            p.changeDynamics(log_bodies.body_ids[i], -1, activationState=p.ACTIVATION_STATE_SLEEP)
        log_bodies.stowed = aboard

    def _fix(self, aboard: Sequence[int], at: Pose, moving: tuple[Vector, Vector]) -> tuple[int, int]:
        """Make a body without a shape but with the load's weight, and a constraint that fixes it to the rear frame."""
        p = self._p
        mass, own, inertia = self._mass(aboard)
        position_m, turn = p.multiplyTransforms(*at, *own)
        body: int = p.createMultiBody(mass, -1, basePosition=position_m, baseOrientation=turn, useMaximalCoordinates=1)
        p.changeDynamics(body, -1, mass=mass, localInertiaDiagonal=inertia, linearDamping=0.0, angularDamping=0.0)
        p.resetBaseVelocity(body, _carried(*moving, at[0], position_m), moving[1])
        zero = (0.0, 0.0, 0.0)
        tie: int = p.createConstraint(self._machine.body, -1, body, -1, p.JOINT_FIXED, zero, own[0], zero, own[1])
        p.changeConstraint(tie, maxForce=FIXED_JOINT_N)
        return body, tie

    def _mass(self, aboard: Sequence[int]) -> tuple[float, Pose, list[float]]:
        """Compute mass, centre and principal axes, and principal inertia [kg m^2] of the load, in the root's axes."""
        p, log_bodies = self._p, self._log_bodies
        masses, places = [log_bodies.masses[i] for i in aboard], np.array([at for at, _ in self._relative_poses])
        middle = np.average(places, axis=0, weights=masses)
        inertia = np.zeros((3, 3))
        for i, m, off, (_, turn) in zip(aboard, masses, places - middle, self._relative_poses, strict=True):
            axes = np.array(p.getMatrixFromQuaternion(turn)).reshape(3, 3)
            own = np.diag(p.getDynamicsInfo(log_bodies.body_ids[i], -1)[2])
            inertia += axes @ own @ axes.T + m * (off @ off * np.eye(3) - np.outer(off, off))
        principal, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.linalg.det(axes)  # right-handed
        return sum(masses), (tuple(middle.tolist()), _turn_of(axes)), principal.tolist()

    def _follow(self, at: Pose) -> None:
        """Move the stowed logs with the bunk."""
        p, log_bodies = self._p, self._log_bodies
        for i, relative_pose in zip(log_bodies.stowed, self._relative_poses, strict=True):
            p.resetBasePositionAndOrientation(log_bodies.body_ids[i], *p.multiplyTransforms(*at, *relative_pose))
        self._at, self._around = at, self._box(log_bodies.stowed)

    def _wake(self, at: Pose, moving: tuple[Vector, Vector]) -> None:
        """Return the stowed logs to the physics."""
        p, log_bodies = self._p, self._log_bodies
        self._follow(at)
        for i in log_bodies.stowed:
            log = log_bodies.body_ids[i]
            p.setCollisionFilterGroupMask(log, -1, COLLISION_GROUP, COLLIDE_ALL)
            p.changeDynamics(log, -1, activationState=p.ACTIVATION_STATE_WAKE_UP)
            position_m = p.getBasePositionAndOrientation(log)[0]
            p.resetBaseVelocity(log, _carried(*moving, at[0], position_m), moving[1])
        if self._fixed_body is not None:
            body, tie = self._fixed_body
            p.removeConstraint(tie)  # Bullet does not remove it with the body
            p.removeBody(body)
        log_bodies.stowed, self._relative_poses, self._fixed_body, self._still_s = (), [], None, 0.0


class ApparentWeight:
    """Apparent weight per kilogram in a moving frame: gravity minus acceleration [m/s^2], in the frame's axes.

    ``now`` is its filtered value, ``WEIGHT_FILTER_S`` the time constant; ``check_period_s`` lie between two calls of
    ``update``.
    """

    def __init__(self, check_period_s: float, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        self._check_period_s, self._gravity = check_period_s, gravity_m_s2
        self._velocity: Vector | None = None
        self.now: Vector = (0.0, 0.0, -gravity_m_s2)

    def update(self, velocity: Vector, axes: Sequence[float]) -> None:
        """Take the velocity of the frame [m/s] and its rotation matrix, row by row."""
        last = self._velocity or velocity
        a, b, c = ((last[i] - velocity[i]) / self._check_period_s for i in range(3))
        c -= self._gravity
        share, now = self._check_period_s / WEIGHT_FILTER_S, self.now
        x, y, z = (now[i] + share * (axes[i] * a + axes[3 + i] * b + axes[6 + i] * c - now[i]) for i in range(3))
        self._velocity, self.now = velocity, (x, y, z)

    def differs(self, other: Vector) -> bool:
        """Tell whether it differs from another in direction or size by more than a load at rest tolerates."""
        x, y, z = other
        u, v, w = self.now
        size, was = math.hypot(u, v, w), math.hypot(x, y, z)
        if abs(size - was) > WEIGHT_SHARE * was:
            return True
        return math.hypot(y * w - z * v, z * u - x * w, x * v - y * u) > math.sin(WEIGHT_TILT_RAD) * size * was


def _carried(linear: Vector, angular: Vector, origin: Vector, place: Vector) -> Vector:
    """Compute the velocity of a place of a body that moves as its origin does and turns about it."""
    x, y, z = (p - o for p, o in zip(place, origin, strict=True))
    (u, v, w), (a, b, c) = linear, angular
    return u + b * z - c * y, v + c * x - a * z, w + a * y - b * x


def _moved(a: Pose, b: Pose) -> bool:
    """Tell whether two poses differ by more than stowed logs may lag behind."""
    cosine = sum(x * y for x, y in zip(a[1], b[1], strict=True))  # of half the angle between them
    return math.dist(a[0], b[0]) > FOLLOW_M or 1.0 - cosine * cosine > (FOLLOW_RAD / 2) ** 2


def _turn_of(axes: NDArray[np.float64]) -> Quaternion:
    """Compute the quaternion of a rotation matrix [3, 3]."""
    m = axes.tolist()
    pitch = -math.asin(max(-1.0, min(1.0, m[2][0])))
    return rpy_quaternion(math.atan2(m[2][1], m[2][2]), pitch, math.atan2(m[1][0], m[0][0]))
