"""The articulated carrier: rear half (root of the multibody, floating), front half and four swing arms with wheels.

Frames: ``machine.geometry.carrier``.  The wheels' mass is on the arms; ``sim.ground.tyre`` computes their spin and
their contact with the ground, and ``Carrier.apply`` puts the forces on the arms for one physics step.  Bullet's own
contact serves logs against wheels and frames, and the frames' undersides against the ground.  Joint torques (steering,
arms) come from the hydraulics.  The wheel motors share one pump: equal torque on all wheels, so they turn at their
own speeds in a bend, with anti-spin for a wheel that has lost its grip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from machine.geometry import carrier as geometry
from machine.profile import Carrier as CarrierProfile
from machine.profile import Profile
from sim.bullet.body import JointDef, LinkDef
from sim.bullet.client import GRAVITY_M_S2, BulletClient
from sim.geometry import IDENTITY, Quaternion, Shape, Vector, quaternion_rpy, rpy_quaternion
from sim.ground.terrain import Terrain
from sim.ground.tyre import Tyre, wheel_step
from sim.truth.body import CarrierTruth
from sim.truth.load import Truth

CARRIER_JOINTS: Final = ("articulation", *geometry.ARMS)
CARRIER_LINKS: Final = ("rear", "front", *geometry.ARMS)
STOP_MARGIN_RAD: Final = 0.03  # of the hard stops outside the working range
WHEEL_BOX_COUNT: Final = 4  # boxes that make a wheel
BEAM_M: Final = (0.12, 0.20)  # width and height of a swing arm
SUPPORT_POLYGON: Final = (0, 1, 3, 2)  # wheels clockwise seen from above: fl fr rr rl


@dataclass(frozen=True, slots=True)
class Drive:
    """Requested speed of the front axle [m/s], + forwards; ``brake`` cuts the motors and locks the wheels."""

    speed_m_s: float = 0.0
    brake: bool = False


PARKED: Final = Drive(0.0, True)


def _specified(profile: Profile, truth: Truth) -> tuple[CarrierProfile, CarrierTruth]:
    """Return the carrier's profile and truth; only for a machine with a carrier."""
    assert profile.carrier is not None and truth.carrier is not None
    return profile.carrier, truth.carrier


def _shapes(c: CarrierProfile, link: str) -> tuple[Shape, ...]:
    dark, green, rubber = (0.2, 0.2, 0.22), (0.18, 0.42, 0.22), (0.10, 0.10, 0.11)
    x, y, z = c.crane_base_m
    if link == "rear":
        return (
            Shape(link, (3.95, 0.90, 0.33), (-2.05, 0.0, 0.115), IDENTITY, dark),
            Shape(link, (0.70, 0.90, z - 0.28), (x, y, (z + 0.28) / 2), IDENTITY, dark),
        )
    if link == "front":
        feet = ((p, 1.15 if p[0] > 0.65 else 0.28) for p in (c.antenna_main_m, c.antenna_aux_m))  # on hood or frame
        masts = (((p[0], p[1], (p[2] + foot) / 2), p[2] - foot) for p, foot in feet)
        return (
            Shape(link, (2.75, 0.90, 0.33), (1.475, 0.0, 0.115), IDENTITY, dark),
            Shape(link, (2.10, 1.30, 0.87), (1.70, 0.0, 0.715), IDENTITY, green),
            *(Shape(link, (0.05, 0.05, tall), at, IDENTITY, dark, False) for at, tall in masts),
        )
    ahead, inward = (1 if link[4] == "f" else -1), (-1 if link[5] == "l" else 1)
    beam = (c.arm_length_m + 0.20, *BEAM_M)
    at = (ahead * c.arm_length_m / 2, inward * (c.wheel_width_m / 2 + 0.08), 0.0)
    half = math.pi / (2 * WHEEL_BOX_COUNT)
    facet = (2 * c.wheel_radius_m * math.cos(half), c.wheel_width_m, 2 * c.wheel_radius_m * math.sin(half))
    hub = (ahead * c.arm_length_m, 0.0, 0.0)
    turns = (rpy_quaternion(0.0, 2 * half * i) for i in range(WHEEL_BOX_COUNT))
    return (Shape(link, beam, at, IDENTITY, dark), *(Shape(link, facet, hub, turn, rubber) for turn in turns))


def _arm_link(c: CarrierProfile, t: CarrierTruth, name: str) -> LinkDef:
    """Model arm as beam, wheel as disc.  The wheel's inertia about its axle counts for its spin, not for the arm."""
    length, mass = c.arm_length_m, t.arm_mass_kg + t.wheel_mass_kg
    com = (t.arm_mass_kg / 2 + t.wheel_mass_kg) / mass * length
    about = t.arm_mass_kg * (length**2 / 12 + (com - length / 2) ** 2) + t.wheel_mass_kg * (length - com) ** 2
    across = t.wheel_spin_inertia_kg_m2 / 2 + t.wheel_mass_kg * c.wheel_width_m**2 / 12
    # With a beam of no thickness the largest inertia would equal the sum of the others to the last bit; rounding then
    # makes an impossible body, to which Bullet gives no inertia at all.
    wide, high = (t.arm_mass_kg * side**2 / 12 for side in BEAM_M)
    inertia = (across + wide + high, about + high, across + about + wide)
    ahead = 1.0 if name[4] == "f" else -1.0
    return LinkDef(name, mass, (ahead * com, 0.0, 0.0), inertia, _shapes(c, name))


def carrier_links(profile: Profile, truth: Truth) -> tuple[list[LinkDef], list[JointDef]]:
    """Make CARRIER_LINKS (root first) and CARRIER_JOINTS of the machine's multibody; SI units."""
    c, t = _specified(profile, truth)
    halves = zip(("rear", "front"), (t.rear, t.front), strict=True)
    links = [LinkDef(n, f.mass_kg, f.com_m, f.inertia_kg_m2, _shapes(c, n)) for n, f in halves]
    limit = c.articulation_limit_rad + STOP_MARGIN_RAD
    joints = [JointDef("articulation", "revolute", "rear", "front", lower=-limit, upper=limit)]
    low, high = (geometry.arm_angle_from_height(c, h) for h in (0.0, c.arm_travel_m))
    for name in geometry.ARMS:
        links.append(_arm_link(c, t, name))
        parent, axis = ("front", 1.0) if name[4] == "f" else ("rear", -1.0)
        at = geometry.arm_pivot_m(c, name)
        lower, upper = low - STOP_MARGIN_RAD, high + STOP_MARGIN_RAD
        joints.append(
            JointDef(name, "revolute", parent, name, origin_m=at, axis=(0.0, axis, 0.0), lower=lower, upper=upper)
        )
    return links, joints


class Carrier:
    """The carrier in a physics client that already holds the machine's ``body`` and the terrain's.

    ``index`` maps joint names to Bullet's joint indices; the client's fixed time step is set.  Call ``apply`` once
    before every ``stepSimulation``.  Tuples of four are in the order fl, fr, rl, rr.
    """

    def __init__(
        self,
        client: BulletClient,
        body: int,
        index: Mapping[str, int],
        profile: Profile,
        truth: Truth,
        terrain: Terrain,
    ) -> None:
        self._p, self._body, self._terrain = client, body, terrain
        self._step_s: float = client.getPhysicsEngineParameters()["fixedTimeStep"]
        self._c, self._t = _specified(profile, truth)
        self._index = {name: index[name] for name in CARRIER_JOINTS}
        self._arms = [index[name] for name in geometry.ARMS]
        self._com = self._t.rear.com_m
        t, soil = self._t, terrain.soil
        self._tyre = Tyre(
            (self._c.wheel_radius_m + t.tyre_sink_m) * t.wheel_radius_scale,
            self._c.wheel_width_m,
            t.wheel_spin_inertia_kg_m2,
            t.tyre_stiffness_n_m,
            t.tyre_damping_n_s_m,
            t.tread_n_m * soil.stiffness,
            t.tread_n_s_m,
            t.relaxation_m,
            t.friction * soil.friction,
            t.rolling_resistance + soil.rolling,
            t.slip_limit,
        )
        self._hub = np.array([1.0, 1.0, -1.0, -1.0]) * self._c.arm_length_m
        self._speeds, self._turned, self._bristles = np.zeros(4), np.zeros(4), np.zeros((4, 2))
        self._states, self._forces, self._contacts = np.zeros((4, 16)), np.zeros((4, 6)), np.zeros((4, 4))
        self._reference = self._torque = self._brake = 0.0
        for i in (-1, *self._index.values()):
            client.changeDynamics(body, i, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
        for i in self._index.values():
            client.setJointMotorControl2(body, i, client.VELOCITY_CONTROL, force=0.0)
        for i in self._arms:
            client.setCollisionFilterPair(body, terrain.body, i, -1, 0)

    def place(self, x_m: float, y_m: float, heading_rad: float, height_m: float) -> None:
        """Put the carrier at rest on the ground, straight, the articulation axis over (x, y), all arms at ``height_m``.

        The tyres are pressed by the mean load; the crane's joints stay as they are.
        """
        p, c, r = self._p, self._c, self._tyre.radius_m
        cos, sin = math.cos(heading_rad), math.sin(heading_rad)
        hubs = [geometry.hub_m(c, name, height_m) for name in geometry.ARMS]
        ground = [self._terrain.height(x_m + cos * h[0] - sin * h[1], y_m + sin * h[0] + cos * h[1]) for h in hubs]
        fl, fr, rl, rr = ground
        pitch = (fl + fr - rl - rr) / (2 * (hubs[0][0] - hubs[2][0]))
        roll = (fl - fr + rl - rr) / (4 * hubs[0][1])
        turn = rpy_quaternion(math.atan(roll), -math.atan(pitch), heading_rad)
        axes = p.getMatrixFromQuaternion(turn)
        mass = sum(p.getDynamicsInfo(self._body, i)[0] for i in range(-1, p.getNumJoints(self._body)))
        above = r - mass * GRAVITY_M_S2 / (4 * self._t.tyre_stiffness_n_m) - hubs[0][2]
        middle = (hubs[0][0] + hubs[2][0]) / 2
        origin = (x_m, y_m, sum(ground) / 4 - middle * pitch)
        at = [
            o + above * axes[3 * i + 2] + sum(axes[3 * i + j] * self._com[j] for j in range(3))
            for i, o in enumerate(origin)
        ]
        p.resetBasePositionAndOrientation(self._body, at, turn)
        p.resetBaseVelocity(self._body, [0.0] * 3, [0.0] * 3)
        p.resetJointState(self._body, self._index["articulation"], 0.0, 0.0)
        for i in self._arms:
            p.resetJointState(self._body, i, geometry.arm_angle_from_height(c, height_m), 0.0)
        self._speeds[:], self._bristles[:] = 0.0, 0.0
        self._reference = self._torque = self._brake = 0.0

    def apply(self, drive: Drive) -> None:
        """Apply the tyres' forces of the next physics step to the arms and turn the wheels."""
        p, body, h, t = self._p, self._body, self._step_s, self._t
        target_speed_m_s = 0.0 if drive.brake else drive.speed_m_s
        ramp = t.drive_acceleration_m_s2 * h
        self._reference += max(-ramp, min(ramp, target_speed_m_s - self._reference))
        spin = self._reference / self._c.wheel_radius_m
        requested_torque_nm = 0.0
        if not drive.brake:
            requested_torque_nm = t.drive_gain_nm_s_rad * (spin - sum(self._speeds.tolist()) / 4.0)
            requested_torque_nm = max(-t.drive_torque_nm, min(t.drive_torque_nm, requested_torque_nm))
        self._torque += h / (h + t.drive_lag_s) * (requested_torque_nm - self._torque)
        self._brake += h / (h + t.brake_lag_s) * (float(drive.brake) - self._brake)
        if not drive.brake and self._brake < 1e-3:
            self._brake = 0.0
        links = p.getLinkStates(body, self._arms, computeLinkVelocity=1, computeForwardKinematics=1)
        self._states[:] = [(*s[4], *s[5], *s[0], *s[6], *s[7]) for s in links]
        wheel_step(
            self._tyre,
            self._states,
            self._hub,
            self._speeds,
            self._turned,
            self._bristles,
            self._torque,
            spin,
            self._brake * t.brake_torque_nm,
            h,
            *self._terrain.grid,
            self._forces,
            self._contacts,
        )
        for i, s, f in zip(self._arms, links, self._forces.tolist(), strict=True):
            p.applyExternalForce(body, i, f[:3], s[0], p.WORLD_FRAME)
            p.applyExternalTorque(body, i, f[3:], p.WORLD_FRAME)

    def pose(self, link: str) -> tuple[Vector, Quaternion]:
        """Return the frame of one of CARRIER_LINKS in the world."""
        if link == "rear":
            at, turn = self._p.getBasePositionAndOrientation(self._body)
            axes = self._p.getMatrixFromQuaternion(turn)
            x, y, z = (at[i] - sum(axes[3 * i + j] * self._com[j] for j in range(3)) for i in range(3))
            return (x, y, z), turn
        i = self._index["articulation" if link == "front" else link]
        state = self._p.getLinkState(self._body, i, computeForwardKinematics=1)
        return state[4], state[5]

    def front_axle(self) -> Vector:
        """Return the middle of the front axle, between the hubs, in the world [m]."""
        x, y, z = (sum(pair) / 2 for pair in zip(self._hub_at("arm_fl"), self._hub_at("arm_fr"), strict=True))
        return x, y, z

    def _hub_at(self, arm: str) -> Vector:
        at, turn = self.pose(arm)
        hub = self._hub[geometry.ARMS.index(arm)]
        position: Vector = self._p.multiplyTransforms(at, turn, [hub, 0.0, 0.0], IDENTITY)[0]
        return position

    @property
    def speed_m_s(self) -> float:
        """True speed of the front axle along the front's x axis, at the height of the arm pivots [m/s]."""
        s = self._p.getLinkState(
            self._body, self._index["articulation"], computeLinkVelocity=1, computeForwardKinematics=1
        )
        # The speed along x is the same at the frame's origin and at the axle.
        axes, (dx, dy, dz) = self._p.getMatrixFromQuaternion(s[5]), (a - b for a, b in zip(s[4], s[0], strict=True))
        (wx, wy, wz), (vx, vy, vz) = s[7], s[6]
        vx, vy, vz = vx + wy * dz - wz * dy, vy + wz * dx - wx * dz, vz + wx * dy - wy * dx
        speed: float = vx * axes[0] + vy * axes[3] + vz * axes[6]
        return speed

    @property
    def articulation_rad(self) -> float:
        """Angle of the front against the rear, + left [rad]."""
        angle: float = self._p.getJointState(self._body, self._index["articulation"])[0]
        return angle

    def attitude(self, link: str) -> Vector:
        """Return roll (+ left side up), pitch (+ nose down) and heading (0 = east, + left) of a link [rad]."""
        return quaternion_rpy(self.pose(link)[1])

    @property
    def heading_rad(self) -> float:
        """Heading of the front half [rad]."""
        return self.attitude("front")[2]

    @property
    def roll_rad(self) -> float:
        """Roll of the rear half, + left side up [rad]."""
        return self.attitude("rear")[0]

    @property
    def pitch_rad(self) -> float:
        """Pitch of the rear half, + nose down [rad]."""
        return self.attitude("rear")[1]

    @property
    def arm_heights_m(self) -> tuple[float, ...]:
        """How far each arm raises the frame above its lowest position [m]."""
        states = self._p.getJointStates(self._body, self._arms)
        return tuple(geometry.height_from_arm_angle(self._c, s[0]) for s in states)

    @property
    def wheel_loads_n(self) -> tuple[float, ...]:
        """Normal force of the ground on each wheel in the last step [N]."""
        return tuple(self._contacts[:, 3].tolist())

    @property
    def wheel_speeds_rad_s(self) -> tuple[float, ...]:
        """Spin of each wheel, + forwards [rad/s]."""
        return tuple(self._speeds.tolist())

    @property
    def wheel_spin_rad(self) -> tuple[float, ...]:
        """Angle each wheel has turned against its arm, for drawing [rad]."""
        return tuple(self._turned.tolist())

    @property
    def tip_margin_m(self) -> float:
        """Distance [m] of the centre of pressure from the nearest edge of the polygon of the wheels' contacts.

        Positive: inside, the machine stands.  0: all load is on the two wheels of one edge (or none is carried), and
        the machine is tipping over it.  It includes dynamics and the crane's load, as wheel load cells would.
        """
        points = self._contacts.tolist()
        total = sum(point[3] for point in points)
        if total <= 0.0:
            return 0.0
        x, y = (sum(point[k] * point[3] for point in points) / total for k in (0, 1))
        margin = math.inf
        for a, b in zip(SUPPORT_POLYGON, (*SUPPORT_POLYGON[1:], SUPPORT_POLYGON[0]), strict=True):
            ex, ey = points[b][0] - points[a][0], points[b][1] - points[a][1]
            inside = ey * (x - points[a][0]) - ex * (y - points[a][1])
            margin = min(margin, inside / math.hypot(ex, ey))
        return margin
