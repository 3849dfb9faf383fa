"""A multibody in the physics client: joints and links by name, torques in, positions and poses out.

One body is the whole machine.  Positions are rad (m for prismatic joints), forces Nm (N).  Joint limits come from the
URDF; passive damping, friction and all other dynamics are set here only.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sim.bullet.client import BulletClient
from sim.geometry import Quaternion, Shape, Vector, quaternion_rpy

Pose = tuple[Vector, Quaternion]


class Body:
    """``index``: joint name -> pybullet joint; ``link``: link name -> pybullet link, the root is -1."""

    def __init__(
        self,
        client: BulletClient,
        links: Sequence[LinkDef],
        joints: Sequence[JointDef],
        *,
        fixed: bool,
        collides_with_itself: bool = False,
    ) -> None:
        self._p = p = client
        p.setPhysicsEngineParameter(enableFileCaching=0)
        flags = p.URDF_USE_INERTIA_FROM_FILE | p.URDF_MAINTAIN_LINK_ORDER
        if collides_with_itself:
            flags |= p.URDF_USE_SELF_COLLISION
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "machine.urdf"
            path.write_text(urdf_text("machine", links, joints))
            self.body: int = p.loadURDF(str(path), useFixedBase=fixed, flags=flags)
        self.root = links[0].name
        self.index: dict[str, int] = {}
        self.link: dict[str, int] = {self.root: -1}
        for i in range(p.getNumJoints(self.body)):
            info = p.getJointInfo(self.body, i)
            self.index[info[1].decode()] = self.link[info[12].decode()] = i
        self.names = tuple(j.name for j in joints if j.kind != "fixed")
        self._moving = [self.index[n] for n in self.names]
        self._mass = {link.name: link.mass_kg for link in links}
        self._inward = _inverse(p, p.getDynamicsInfo(self.body, -1)[3:5])
        p.changeDynamics(self.body, -1, linearDamping=0.0, angularDamping=0.0)
        for i in self._moving:
            p.changeDynamics(self.body, i, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
            p.setJointMotorControl2(self.body, i, p.VELOCITY_CONTROL, force=0.0)

    def set_damping(self, joint: str, damping: float) -> None:
        """Set the passive damping of a joint [Nm s/rad]."""
        self._p.changeDynamics(self.body, self.index[joint], jointDamping=damping)

    def set_friction(self, links: Iterable[str], friction: float) -> None:
        """Set the friction factor of links."""
        for name in links:
            self._p.changeDynamics(self.body, self.link[name], lateralFriction=friction)

    def collide_only(self, one: Iterable[str], other: Sequence[str]) -> None:
        """Let only links of ``one`` collide with links of ``other`` inside the body."""
        colliding_pairs = {(a, b) for a in one for b in other}
        names = list(self.link)
        for i, a in enumerate(names):
            for b in names[i + 1 :]:
                collides = (a, b) in colliding_pairs or (b, a) in colliding_pairs
                self._p.setCollisionFilterPair(self.body, self.body, self.link[a], self.link[b], int(collides))

    def place(self, positions: Mapping[str, float]) -> None:
        """Put these joints at rest at a position; the others stay."""
        for joint, value in positions.items():
            self._p.resetJointState(self.body, self.index[joint], value, 0.0)

    def states(self) -> list[tuple[float, float, Vector, float]]:
        """Read position, velocity, reaction (force, torque; joints with a sensor), motor torque; in ``names`` order."""
        states: list[tuple[float, float, Vector, float]] = self._p.getJointStates(self.body, self._moving)
        return states

    def apply(self, indices: list[int], torques: list[float]) -> None:
        """Apply torques on joints for the next physics step."""
        self._p.setJointMotorControlArray(self.body, indices, self._p.TORQUE_CONTROL, forces=torques)

    def hold(self, joints: Iterable[str], force: float) -> None:
        """Hold joints with motors of this strength; 0 releases them."""
        for joint in joints:
            self._p.setJointMotorControl2(
                self.body, self.index[joint], self._p.VELOCITY_CONTROL, targetVelocity=0.0, force=force
            )

    def add_force_sensor(self, joint: str) -> None:
        """Add a force sensor at a joint; ``states`` returns its reading."""
        self._p.enableJointForceTorqueSensor(self.body, self.index[joint], True)

    def pose(self, link: str) -> Pose:
        """Return the URDF frame of a link in the world."""
        i = self.link[link]
        pose: Pose
        if i < 0:
            pose = self._p.multiplyTransforms(*self._p.getBasePositionAndOrientation(self.body), *self._inward)
            return pose
        state = self._p.getLinkState(self.body, i, computeForwardKinematics=1)
        return state[4], state[5]

    def poses(self) -> dict[str, Pose]:
        """Return the URDF frames of all links in the world."""
        names = [n for n in self.link if n != self.root]
        states = self._p.getLinkStates(self.body, [self.link[n] for n in names], computeForwardKinematics=1)
        return {self.root: self.pose(self.root)} | {n: (s[4], s[5]) for n, s in zip(names, states, strict=True)}

    def gravity_moment(self, joint: str, axis: Vector, outboard: Sequence[str], gravity: float) -> float:
        """Compute the moment of the weight of ``outboard`` links about a joint's ``axis`` (child link's frame) [Nm]."""
        p = self._p
        at = p.getLinkState(self.body, self.index[joint], computeForwardKinematics=1)
        m = p.getMatrixFromQuaternion(at[5])
        a = [sum(m[3 * r + c] * axis[c] for c in range(3)) for r in range(3)]
        states = p.getLinkStates(self.body, [self.link[n] for n in outboard], computeForwardKinematics=1)
        total = 0.0
        for name, s in zip(outboard, states, strict=True):
            x, y = s[0][0] - at[4][0], s[0][1] - at[4][1]
            weight = self._mass[name] * gravity
            total += a[0] * -y * weight + a[1] * x * weight  # axis . (r x (0, 0, -weight))
        return total


def fixed_boxes(client: BulletClient, shapes: Sequence[Shape], friction: float) -> int:
    """Create boxes that never move, as one body in the world."""
    links = [LinkDef("boxes", 1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), tuple(shapes))]
    body = Body(client, links, (), fixed=True)
    body.set_friction(["boxes"], friction)
    return body.body


def _inverse(p: BulletClient, pose: Pose) -> Pose:
    inverse: Pose = p.invertTransform(*pose)
    return inverse


def magnitude(v: Sequence[float]) -> float:
    """Compute the length of a vector's first three components."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


# -- A multibody as URDF text: links, joints, and a newline after every tag (Bullet splits lines over 8191 characters).


@dataclass(frozen=True, slots=True)
class LinkDef:
    """Mass [kg], centre of mass in the link frame [m], principal inertia about it [kg m^2], boxes of this link."""

    name: str
    mass_kg: float
    com_m: Vector
    inertia_kg_m2: Vector
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True, slots=True)
class JointDef:
    """A joint: pose of the child frame in the parent's at 0, axis in the child frame, stops [rad, m]; a continuous one
    has none.
    """

    name: str
    kind: Literal["revolute", "continuous", "prismatic", "fixed"]
    parent: str
    child: str
    origin_m: Vector = (0.0, 0.0, 0.0)
    rpy_rad: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float = 0.0
    upper: float = 0.0


def urdf_text(name: str, links: Sequence[LinkDef], joints: Sequence[JointDef]) -> str:
    """Write the whole robot; the first link is the root, joints follow the order given."""
    out = [f'<robot name="{name}">']
    for link in links:
        out += _link(link)
    for j in joints:
        out += [
            f'<joint name="{j.name}" type="{j.kind}">',
            f'<parent link="{j.parent}"/>',
            f'<child link="{j.child}"/>',
            f'<origin xyz="{_xyz(j.origin_m)}" rpy="{_xyz(j.rpy_rad)}"/>',
        ]
        if j.kind != "fixed":
            out += [
                f'<axis xyz="{_xyz(j.axis)}"/>',
                f'<limit lower="{j.lower:.12g}" upper="{j.upper:.12g}" effort="1e9" velocity="1e9"/>',
            ]
        out.append("</joint>")
    return "\n".join([*out, "</robot>", ""])


def _link(link: LinkDef) -> list[str]:
    i = link.inertia_kg_m2
    out = [
        f'<link name="{link.name}">',
        "<inertial>",
        f'<origin xyz="{_xyz(link.com_m)}"/>',
        f'<mass value="{link.mass_kg:.12g}"/>',
        f'<inertia ixx="{i[0]:.12g}" iyy="{i[1]:.12g}" izz="{i[2]:.12g}" ixy="0" ixz="0" iyz="0"/>',
        "</inertial>",
    ]
    for n, s in enumerate(link.shapes):
        for tag in ("visual", "collision") if s.solid else ("visual",):
            out += [
                f"<{tag}>",
                f'<origin xyz="{_xyz(s.position_m)}" rpy="{_xyz(quaternion_rpy(s.quaternion))}"/>',
                f'<geometry><box size="{_xyz(s.size_m)}"/></geometry>',
            ]
            if tag == "visual":
                out.append(f'<material name="{link.name}_{n}"><color rgba="{_xyz(s.colour)} 1"/></material>')
            out.append(f"</{tag}>")
    return [*out, "</link>"]


def _xyz(v: Vector) -> str:
    return " ".join(f"{x:.12g}" for x in v)
