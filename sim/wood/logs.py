"""Logs as bodies of the physics client, and their state for display and evaluation.

A log is one rigid body of 3 or 5 coaxial cylinders along its bow (docs/reference/plant-model.md section 1: cylinders
roll, hulls have flats), with the mass, centre of mass and inertia of the tapered, bowed wood.  The scene comes to rest
in a physics client of its own before the logs appear in the machine's, so nothing disturbs the crane.  A log at rest
sleeps: it costs no time and stands still until something touches it; with Bullet's friction alone a wedged log would
creep 1 mm/s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from machine.profile import Profile
from sim.bullet.body import Pose
from sim.bullet.client import GRAVITY_M_S2, BulletClient, new_client
from sim.errors import PlantError
from sim.geometry import Quaternion, Vector, rpy_quaternion
from sim.ground.terrain import Terrain
from sim.truth.body import Contact
from sim.truth.load import Truth
from sim.wood.bunk import bunk_boxes, from_bunk
from sim.wood.log_shape import LogSpec, Mass, log_segments, mass_of, quaternion_of
from sim.wood.stacking import footprint_gap

SLEEP_SPEED: Final = 0.02  # [m/s, rad/s]
SETTLE_STEP_S: Final = 0.0025
SETTLE_S: Final = 20.0  # time limit for coming to rest
CHECK_STEPS: Final = 20
STILL_CHECK_COUNT: Final = 8  # 0.4 s
REST_M_S: Final = 0.004
REST_RAD_S: Final = 0.02
# While a scene comes to rest, this damping [1/s, linear and angular, of Bullet's form] stops rolling logs.
SETTLE_DAMPING: Final = (0.3, 0.9)
INSIDE_M: Final = 0.003  # deepest contact at the start that does not count as an overlap
NUDGE_RAD_S: Final = 0.1
NEIGHBOUR_M: Final = 0.05
RISE_POINTS: Final = 11
SPINE_POINTS: Final = 11
CROSS_SHARES: Final = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
FINE_POINTS: Final = 41
FINE_SHARES: Final = tuple((0.5 * i, 0.5 * j) for i in range(-2, 3) for j in range(-2, 3))
FINE_MARGIN_M: Final = 0.02
GROUND_MARGIN_M: Final = 8.0  # of ground beyond the outermost log
BARK: Final = (0.55, 0.35, 0.18, 1.0)


@dataclass(frozen=True, slots=True)
class LogState:
    """One log now, world frame: log frame (position of the pith at half length, orientation x, y, z, w), unit vector
    along it towards the thin end, sizes, speed of its fastest point, both ends of the pith.
    """

    position_m: Vector
    quaternion: Quaternion
    axis: Vector
    length_m: float
    diameter_m: float
    mass_kg: float
    speed_m_s: float
    taper_m_m: float
    sweep_m: float
    ends_m: tuple[Vector, Vector]


def reach_m(scene: Sequence[LogSpec]) -> float:
    """Compute how far the ground must reach from the origin for a scene, in x and y [m]."""
    return GROUND_MARGIN_M + max((abs(at) for log in scene for at in (log.x_m, log.y_m)), default=0.0)


class LogBodies:
    """The logs' rigid bodies.  ``body_ids`` are in scene order, ``masses`` in kg.

    ``terrain`` gets a body in the private client only; ``base`` is the crane's base frame in the world, for the bunk.

    Raises:
        PlantError: logs overlap each other or the machine at the start, or do not come to rest.
    """

    def __init__(
        self,
        client: BulletClient,
        profile: Profile,
        truth: Truth,
        scene: Sequence[LogSpec],
        terrain: Terrain,
        base: Pose,
    ) -> None:
        self._p, self.scene, self._terrain = client, tuple(scene), terrain
        wood = [mass_of(spec) for spec in self.scene]
        self.masses = [m.mass_kg for m in wood]
        poses = _settled(profile, truth.contact, self.scene, terrain, base) if self.scene else []
        self.body_ids = tuple(
            _body(client, spec, m, pose, truth.contact) for spec, m, pose in zip(self.scene, wood, poses, strict=True)
        )
        _check_apart(client, self.body_ids, "at rest")
        for state in (client.ACTIVATION_STATE_ENABLE_SLEEPING, client.ACTIVATION_STATE_SLEEP):
            for body in self.body_ids:
                client.changeDynamics(body, -1, activationState=state, sleepThreshold=SLEEP_SPEED)
        # Body axes -> log frame: the turn about y, and the log's origin relative to the centre of mass.
        self._turn = np.array([m.turn_rad for m in wood])
        self._com = np.array([m.com_m for m in wood]).reshape(-1, 3)
        self.stowed: tuple[int, ...] = ()
        self._seen: list[Any] = [None] * len(self.body_ids)
        self._last: list[Any] = [None] * len(self.body_ids)
        self._size = np.array([(s.length_m, s.diameter_m, s.sweep_m) for s in self.scene]).reshape(-1, 3)

    def wake(self) -> None:
        """Wake all logs that are not stowed; needed before a pose, a speed or a force is set from outside."""
        for i, body in enumerate(self.body_ids):
            if i not in self.stowed:
                self._p.changeDynamics(body, -1, activationState=self._p.ACTIVATION_STATE_WAKE_UP)

    def move(self, which: int, east_m: float, north_m: float) -> None:
        """Move a log, without turning it, to another place; on uneven ground it drops a little."""
        (x, y, z), turn = self._p.getBasePositionAndOrientation(self.body_ids[which])
        at = (x + east_m, y + north_m, z + self._rise_m(which, east_m, north_m))
        self._p.resetBasePositionAndOrientation(self.body_ids[which], at, turn)
        self._p.resetBaseVelocity(self.body_ids[which], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def _rise_m(self, which: int, east_m: float, north_m: float) -> float:
        """Compute how much higher a log must lie at another place so as not to touch the ground there [m]."""
        if self._terrain.level:
            return 0.0
        log = self.states()[which]
        (ax, ay, az), (bx, by, bz) = log.ends_m
        ground = self._terrain.height
        return max(
            ground(ax + s * (bx - ax) + east_m + dx, ay + s * (by - ay) + north_m + dy)
            - (az + s * (bz - az) - 0.5 * log.diameter_m)
            for s in (i / (RISE_POINTS - 1) for i in range(RISE_POINTS))
            for dx, dy in ((0.0, 0.0), (0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1))
        )

    def states(self) -> list[LogState]:
        """Return the logs now, in scene order.  Only those that moved since the last call are computed."""
        p = self._p
        now = [(p.getBasePositionAndOrientation(body), p.getBaseVelocity(body)) for body in self.body_ids]
        moved = [i for i, seen in enumerate(now) if seen != self._seen[i]]
        if moved:
            for i, state in zip(moved, self._states(moved, [now[i] for i in moved]), strict=True):
                self._seen[i], self._last[i] = now[i], state
        return list(self._last)

    def _states(self, which: list[int], now: Sequence[tuple[Pose, tuple[Vector, Vector]]]) -> list[LogState]:
        turned = _times(np.array([q for (_, q), _ in now]), -self._turn[which])
        x, _, z = _axes(turned)
        com, (length, diameter, sweep) = self._com[which], self._size[which].T
        position = np.array([at for (at, _), _ in now]) - com[:, :1] * x - com[:, 2:] * z
        half, back = length[:, None] / 2 * z, position - sweep[:, None] * x
        linear, angular = np.array([velocity for _, velocity in now]).transpose(1, 0, 2)
        roll = np.abs(np.sum(angular * z, axis=1))
        across = np.sqrt(np.maximum(np.sum(angular * angular, axis=1) - roll * roll, 0.0))
        # No point of the log is faster than this.
        speed = (
            np.linalg.norm(linear, axis=1) + (length / 2 + np.abs(com[:, 2])) * across + (diameter / 2 + sweep) * roll
        )
        columns = zip(which, *(c.tolist() for c in (position, turned, z, back - half, back + half, speed)), strict=True)
        return [
            LogState(
                tuple(at),
                tuple(turn),
                tuple(axis),
                self.scene[i].length_m,
                self.scene[i].diameter_m,
                self.masses[i],
                v,
                self.scene[i].taper_m_m,
                self.scene[i].sweep_m,
                (tuple(butt), tuple(top)),
            )
            for i, at, turn, axis, butt, top, v in columns
        ]


def _times(q: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute quaternions [n, 4] followed by turns [n] about their own y."""
    s, c = np.sin(angle / 2), np.cos(angle / 2)
    x, y, z, w = q.T
    return np.stack([c * x - s * z, c * y + s * w, c * z + s * x, c * w - s * y], axis=1)


def _axes(q: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Compute the three axes [n, 3] of quaternions [n, 4]."""
    x, y, z, w = q.T
    return (
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1),
        np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1),
    )


def _body(p: BulletClient, spec: LogSpec, mass: Mass, pose: Pose, contact: Contact) -> int:
    """Create a log in a client; ``pose`` is of the body's own frame: centre of mass, principal axes."""
    half, (cx, _, cz) = -mass.turn_rad / 2, mass.com_m
    c, s = math.cos(2 * half), math.sin(2 * half)
    radii, lengths, middles, turns = [], [], [], []
    for a, b, ra, rb in log_segments(spec):
        radii.append((ra + rb) / 2)
        lengths.append(math.dist(a, b))
        x, z = (a[0] + b[0]) / 2 - cx, (a[2] + b[2]) / 2 - cz
        middles.append([c * x + s * z, 0.0, c * z - s * x])
        tilt = math.atan2(b[0] - a[0], b[2] - a[2]) / 2 + half
        turns.append([0.0, math.sin(tilt), 0.0, math.cos(tilt)])
    shape = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_CYLINDER] * len(radii),
        radii=radii,
        lengths=lengths,
        collisionFramePositions=middles,
        collisionFrameOrientations=turns,
    )
    body: int = p.createMultiBody(
        mass.mass_kg, shape, basePosition=pose[0], baseOrientation=pose[1], useMaximalCoordinates=1
    )
    p.changeDynamics(
        body,
        -1,
        mass=mass.mass_kg,  # without it Bullet uses the inertia of a massless body
        localInertiaDiagonal=mass.inertia_kg_m2,
        lateralFriction=contact.log_friction,
        rollingFriction=contact.log_rolling_m,
        spinningFriction=contact.log_rolling_m,
        linearDamping=0.0,
        angularDamping=0.0,
    )
    return body


def _lifts(scene: Sequence[LogSpec], terrain: Terrain) -> list[float]:
    """Find the height of the ground under each log's lowest line; logs that are near each other share the highest."""
    lifts = []
    # Stones and stumps are as narrow as the ground's cells: they must not hide between two points.
    fine = terrain.kind == "drawn"
    shares, count, margin_m = (FINE_SHARES, FINE_POINTS, FINE_MARGIN_M) if fine else (CROSS_SHARES, SPINE_POINTS, 0.0)
    for s in scene:
        points = s.spine(count)
        radii = [s.radius(i / (len(points) - 1) - 0.5) for i in range(len(points))]
        low = [pt[2] - r for pt, r in zip(points, radii, strict=True)]
        least, d = min(low), s.diameter_m / 2
        lifts.append(
            margin_m
            + max(
                terrain.height(s.x_m + pt[0] + d * u, s.y_m + pt[1] + d * v) - (z - least)
                for pt, z in zip(points, low, strict=True)
                for u, v in shares
            )
        )
    near = [
        (i, j)
        for i, a in enumerate(scene)
        for j in range(i)
        if math.hypot(a.x_m - scene[j].x_m, a.y_m - scene[j].y_m) < 4.0 and footprint_gap(a, scene[j]) < NEIGHBOUR_M
    ]
    for _ in scene:
        for i, j in near:
            lifts[i] = lifts[j] = max(lifts[i], lifts[j])
    return lifts


def _settled(profile: Profile, contact: Contact, scene: Sequence[LogSpec], terrain: Terrain, base: Pose) -> list[Pose]:
    """Return the poses of the bodies after the scene has come to rest on the terrain and in the bunk."""
    p = new_client()
    try:
        p.setGravity(0.0, 0.0, -GRAVITY_M_S2)
        p.setPhysicsEngineParameter(
            fixedTimeStep=SETTLE_STEP_S, numSolverIterations=40, numSubSteps=0, deterministicOverlappingPairs=1
        )
        terrain.add_to(p, contact.ground_friction)
        b = profile.bunk
        along = rpy_quaternion(0.0, 0.0, b.yaw_rad)
        for size, middle in bunk_boxes(profile):
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[x / 2 for x in size])
            at, turn = p.multiplyTransforms(*base, from_bunk(b, middle), along)
            box = p.createMultiBody(0.0, shape, basePosition=at, baseOrientation=turn)
            p.changeDynamics(box, -1, lateralFriction=contact.bunk_friction)
        free = [s for s in scene if not s.in_bunk]
        lifts = iter(_lifts(free, terrain))
        bodies = []
        for s in scene:
            m, turn = mass_of(s), quaternion_of(s)
            n = s.pieces * 4
            low = min(pt[2] - s.radius(i / n - 0.5) for i, pt in enumerate(s.spine(n + 1)))
            at = (s.x_m, s.y_m, s.z_m - low)
            if s.in_bunk:
                at = from_bunk(b, (at[0], at[1], at[2] + b.floor_z_m))
                at, turn = p.multiplyTransforms(*base, at, p.multiplyTransforms((0, 0, 0), along, (0, 0, 0), turn)[1])
            else:
                at = (at[0], at[1], at[2] + next(lifts))
            own = (0.0, math.sin(m.turn_rad / 2), 0.0, math.cos(m.turn_rad / 2))
            bodies.append(_body(p, s, m, p.multiplyTransforms(at, turn, m.com_m, own), contact))
        _check_apart(p, bodies, "at their release")
        _rest(p, bodies)
        return [p.getBasePositionAndOrientation(body) for body in bodies]
    finally:
        p.disconnect()


def _rest(p: BulletClient, bodies: Sequence[int]) -> None:
    """Step until every log stands still: first damped, then undamped, nudged so that none stays on an unstable edge.

    A log that has passed both stages sleeps while others still roll.
    """
    still, free = dict.fromkeys(bodies, 0), dict.fromkeys(bodies, False)
    for body in bodies:
        p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_ENABLE_SLEEPING, sleepThreshold=SLEEP_SPEED)
        p.changeDynamics(body, -1, linearDamping=SETTLE_DAMPING[0], angularDamping=SETTLE_DAMPING[1])
    for _ in range(round(SETTLE_S / SETTLE_STEP_S / CHECK_STEPS)):
        for _ in range(CHECK_STEPS):
            p.stepSimulation()
        for i, body in enumerate(bodies):
            v, w = p.getBaseVelocity(body)
            still[body] = still[body] + 1 if math.hypot(*v) < REST_M_S and math.hypot(*w) < REST_RAD_S else 0
            if still[body] >= STILL_CHECK_COUNT and free[body]:
                p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_SLEEP)
            elif still[body] >= STILL_CHECK_COUNT:
                free[body], still[body] = True, 0
                p.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
                along = p.getMatrixFromQuaternion(p.getBasePositionAndOrientation(body)[1])[2::3]
                p.resetBaseVelocity(body, angularVelocity=[NUDGE_RAD_S * (-1) ** i * x for x in along])
        if all(free.values()) and min(still.values()) >= STILL_CHECK_COUNT:
            return
    worst = min(range(len(bodies)), key=lambda i: (free[bodies[i]], still[bodies[i]]))
    error = PlantError(
        "logs.not-at-rest",
        f"log {worst} still moves {SETTLE_S:.0f} s after its release; place the logs on flatter ground or use fewer",
    )
    error.logs = tuple(i for i, body in enumerate(bodies) if not free[body] or still[body] < STILL_CHECK_COUNT)
    raise error


def _check_apart(p: BulletClient, bodies: Sequence[int], when: str) -> None:
    """Check that the logs are apart from each other and from other bodies.

    Raises:
        PlantError: a log is inside another body.
    """
    p.performCollisionDetection()
    number = {body: i for i, body in enumerate(bodies)}
    for i, body in enumerate(bodies):
        for contact in p.getContactPoints(body):
            if contact[8] < -INSIDE_M:
                j = number.get(contact[2])
                other = "the machine, the bunk or the ground" if j is None else f"log {j}"
                raise PlantError("logs.overlap", f"log {i} is {-contact[8]:.3f} m inside {other} {when}; move it away")
