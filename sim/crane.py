"""The crane's body: URDF text from the profile's geometry and the truth's masses, drawing shapes, joint access.

Frames and joint table: machines.md 1.1 (z up, slew 0 reaches +y, pitch axes +x, tong 0 = open).  The profile's
Denavit-Hartenberg numbers determine the URDF origins, so the plant's kinematics equal the profile's exactly.
Passive hanger and fork carry damping only.  Tongs interleave: two blades left, one right, all with cross plates.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

from machine.profile import Kinematics, Profile
from sim.physics import BulletClient
from sim.truth import Truth

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

ACTIVE = ("slew", "lift", "tilt", "ext")
PASSIVE = ("hanger", "fork")
JOINTS = (*ACTIVE, *PASSIVE, "rot", "tong_left", "tong_right")
LINKS = ("mast", "boom", "stick", "telescope", *PASSIVE, "rotator", "tong_left", "tong_right")
TONG_CLOSED_RAD = 2.234
STOP_MARGIN = 0.03  # the hard stops stand a little outside the working range [rad, m]
TONG_PIVOT_X_M = 0.275
TONG_PIVOT_Y_M = -0.0193
TONG_CHORD_M = 0.648
BOOM_PIVOT_Z_M = 1.09553
# (along, across) the chord from pivot to tip, in chord lengths: a claw, bulging outward.
TONG_POLYLINE = ((0.0, 0.0), (0.06, 0.13), (0.29, 0.205), (0.585, 0.20), (0.85, 0.12), (1.0, 0.0))
PLATE_M = (0.035, 0.035, 0.035, 0.03, 0.014)  # per segment: the tips are sharp, so that they get under a thin log


@dataclass(frozen=True, slots=True)
class Shape:
    """A box for drawing: full edge lengths [m] and pose in the frame of ``link`` (``base`` is the world)."""

    link: str
    size_m: Vector
    position_m: Vector
    quaternion: Quaternion
    colour: tuple[float, float, float]
    solid: bool = True


def rpy_quaternion(roll: float, pitch: float) -> Quaternion:
    """Quaternion (x, y, z, w) of a rotation about x, then about the fixed y [rad]."""
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return (sr * cp, cr * sp, -sr * sp, cr * cp)


def tong_points(side: int) -> list[tuple[float, float]]:
    """Polyline (x, z) [m] of a tong in its link frame at angle 0; side -1 left, +1 right."""
    u, n = (math.sqrt(0.5), -math.sqrt(0.5)), (math.sqrt(0.5), math.sqrt(0.5))
    return [
        (side * TONG_CHORD_M * (a * u[0] + b * n[0]), TONG_CHORD_M * (a * u[1] + b * n[1])) for a, b in TONG_POLYLINE
    ]


def crane_shapes(profile: Profile) -> list[Shape]:
    """All boxes of the crane; ``solid`` ones collide."""
    k = profile.kinematics
    steel, yellow, dark = (0.45, 0.47, 0.5), (0.95, 0.72, 0.1), (0.2, 0.2, 0.22)
    tilt = rpy_quaternion(-0.065829, 0.0)
    unit = (0.0, 0.0, 0.0, 1.0)
    base_top = k.d1_m - BOOM_PIVOT_Z_M
    ground = profile.workspace.ground_z_m
    shapes = [
        Shape("base", (0.5, 0.5, base_top - ground), (0, 0, (base_top + ground) / 2), unit, dark, False),
        Shape("mast", (0.28, 0.28, 1.15), (0, -0.03, 0.55), unit, steel, False),
        Shape("boom", (0.16, k.a2_m, 0.22), (0, k.a2_m / 2, 0), unit, yellow),
        Shape("stick", (0.14, 1.9, 0.16), (0, 0.82, 0.17), tilt, yellow),
        Shape("telescope", (0.10, 1.9, 0.10), (0, 1.05, -0.10), tilt, steel),
        Shape("hanger", (0.08, 0.08, 0.154), (0, 0, -0.077), unit, dark, False),
        Shape("fork", (0.14, 0.14, 0.26), (0, 0, -0.13), unit, dark, False),
        Shape("rotator", (0.62, 0.20, 0.20), (0, 0, -0.15), unit, dark),
    ]
    for side, link in ((-1, "tong_left"), (1, "tong_right")):
        points = tong_points(side)
        for (x0, z0), (x1, z1), thick in zip(points, points[1:], PLATE_M, strict=False):
            length, middle = math.hypot(x1 - x0, z1 - z0), ((x0 + x1) / 2, (z0 + z1) / 2)
            turn = rpy_quaternion(0.0, -math.atan2(z1 - z0, x1 - x0))
            colour = (0.8, 0.2, 0.15)
            if side < 0:
                for y in (-0.14, 0.14):
                    position = (middle[0], y - TONG_PIVOT_Y_M, middle[1])
                    shapes.append(Shape(link, (length + 0.02, 0.08, thick), position, turn, colour))
            width = 0.36 if side < 0 else 0.19
            position = (middle[0], -TONG_PIVOT_Y_M, middle[1])
            shapes.append(Shape(link, (length, width, thick), position, turn, colour))
    return shapes


def _origins(k: Kinematics) -> dict[str, tuple[str, Vector, Vector, str]]:
    """Joint -> (type, origin in the parent frame, axis, child link), from the DH numbers (machines.md 1.2).

    The tilted telescope of machines.md 1.1 is the DH chain's third and fourth row seen from the stick frame:
    a3 across and d4 along the telescope's own axis, which theta3's offset turns.
    """
    a = k.theta3_offset_rad + k.theta2_offset_rad - math.pi / 2
    along = (0.0, math.cos(a), math.sin(a))
    across = (0.0, -math.sin(a), math.cos(a))
    boom = (0.0, k.a2_m * math.cos(k.theta2_offset_rad), k.a2_m * math.sin(k.theta2_offset_rad))
    # The telescope link's frame sits where machines.md puts it; the pin offset closes the DH chain from there.
    frame = (0.0, 0.1256771629, 0.21905106705)
    pin = tuple(k.a3_m * across[i] + k.d4_m * along[i] - frame[i] for i in range(3))
    pivot = -k.rotator_to_tong_pivot_m
    return {
        "slew": ("revolute", (0.0, 0.0, k.d1_m - BOOM_PIVOT_Z_M), (0.0, 0.0, 1.0), "mast"),
        "lift": ("revolute", (0.0, k.a1_m, BOOM_PIVOT_Z_M), (1.0, 0.0, 0.0), "boom"),
        "tilt": ("revolute", boom, (1.0, 0.0, 0.0), "stick"),
        "ext": ("prismatic", frame, along, "telescope"),
        "hanger": ("revolute", (pin[0], pin[1], pin[2]), (1.0, 0.0, 0.0), "hanger"),
        "fork": ("revolute", (0.0, 0.0, -k.hanger_to_fork_m), (0.0, 1.0, 0.0), "fork"),
        "rot": ("revolute", (0.0, 0.0, -k.fork_to_rotator_m), (0.0, 0.0, 1.0), "rotator"),
        "tong_left": ("revolute", (-TONG_PIVOT_X_M, TONG_PIVOT_Y_M, pivot), (0.0, -1.0, 0.0), "tong_left"),
        "tong_right": ("revolute", (TONG_PIVOT_X_M, TONG_PIVOT_Y_M, pivot), (0.0, 1.0, 0.0), "tong_right"),
    }


PARENTS = dict(zip(JOINTS, ("base", *LINKS[:6], "rotator", "rotator"), strict=True))


def _xyz(v: Vector) -> str:
    return " ".join(f"{x:.12g}" for x in v)


def crane_urdf(profile: Profile, truth: Truth) -> str:
    """The whole crane as URDF text; a newline after every tag (Bullet splits lines over 8191 characters)."""
    shapes = crane_shapes(profile)
    out = [
        '<robot name="crane">',
        '<link name="base">',
        '<inertial><mass value="100"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>',
        "</link>",
    ]
    for link in LINKS:
        t = truth.links["tong" if link.startswith("tong") else link]
        com = (-t.com_m[0], *t.com_m[1:]) if link == "tong_left" else t.com_m
        i = t.inertia_kg_m2
        out += [
            f'<link name="{link}">',
            "<inertial>",
            f'<origin xyz="{_xyz(com)}"/>',
            f'<mass value="{t.mass_kg:.12g}"/>',
            f'<inertia ixx="{i[0]:.12g}" iyy="{i[1]:.12g}" izz="{i[2]:.12g}" ixy="0" ixz="0" iyz="0"/>',
            "</inertial>",
        ]
        for s in shapes:
            if s.link != link:
                continue
            x, y, _, w = s.quaternion
            roll, pitch = 2 * math.atan2(x, w), 2 * math.atan2(y, w)
            rgba = f"{_xyz(s.colour)} 1"
            for tag in ("visual", "collision") if s.solid else ("visual",):
                out += [
                    f"<{tag}>",
                    f'<origin xyz="{_xyz(s.position_m)}" rpy="{roll:.12g} {pitch:.12g} 0"/>',
                    f'<geometry><box size="{_xyz(s.size_m)}"/></geometry>',
                    f'<material name="{link}"><color rgba="{rgba}"/></material>' if tag == "visual" else "",
                    f"</{tag}>",
                ]
        out.append("</link>")
    damping = {
        "hanger": truth.structure.hanger_damping_nm_s_rad,
        "fork": truth.structure.fork_damping_nm_s_rad,
    }
    for joint, (kind, origin, axis, child) in _origins(profile.kinematics).items():
        if joint in profile.joints:
            spec = profile.joints[joint]
            lower, upper = spec.lower - STOP_MARGIN, spec.upper + STOP_MARGIN
        else:
            lower, upper = (-math.pi, math.pi) if joint in PASSIVE else (0.0, TONG_CLOSED_RAD)
        out += [
            f'<joint name="{joint}" type="{kind}">',
            f'<parent link="{PARENTS[joint]}"/>',
            f'<child link="{child}"/>',
            f'<origin xyz="{_xyz(origin)}"/>',
            f'<axis xyz="{_xyz(axis)}"/>',
            f'<limit lower="{lower:.12g}" upper="{upper:.12g}" effort="1e9" velocity="1e9"/>',
            f'<dynamics damping="{damping.get(joint, 0.0):.12g}" friction="0"/>',
            "</joint>",
        ]
    return "\n".join([*out, "</robot>", ""])


class Crane:
    """The crane in a physics client: joints by name, torques in, positions out."""

    def __init__(self, client: BulletClient, profile: Profile, truth: Truth) -> None:
        self._p = client
        client.setPhysicsEngineParameter(enableFileCaching=0)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "crane.urdf"
            path.write_text(crane_urdf(profile, truth))
            flags = client.URDF_USE_INERTIA_FROM_FILE | client.URDF_MAINTAIN_LINK_ORDER
            self.body: int = client.loadURDF(str(path), useFixedBase=True, flags=flags)
        self.index = {client.getJointInfo(self.body, i)[1].decode(): i for i in range(client.getNumJoints(self.body))}
        self.link = dict(zip(LINKS, (self.index[j] for j in JOINTS), strict=True))
        self._all = [self.index[j] for j in JOINTS]
        self._torque_driven = [self.index[j] for j in ACTIVE]
        for i in self._all:
            client.changeDynamics(self.body, i, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
            client.setJointMotorControl2(self.body, i, client.VELOCITY_CONTROL, force=0.0)
        for joint in PASSIVE:
            damping = getattr(truth.structure, f"{joint}_damping_nm_s_rad")
            client.changeDynamics(self.body, self.index[joint], jointDamping=damping)
        for i in (self.link["tong_left"], self.link["tong_right"], self.link["rotator"]):
            client.changeDynamics(self.body, i, lateralFriction=truth.contact.tong_friction)
        client.enableJointForceTorqueSensor(self.body, self.index["hanger"], True)

    def place(self, positions: dict[str, float]) -> None:
        """Set joint positions at rest; joints not named become 0, the hanger hangs vertically unless named."""
        hang = -(positions.get("lift", 0.0) + positions.get("tilt", 0.0))
        for joint, i in self.index.items():
            value = positions.get(joint, hang if joint == "hanger" else 0.0)
            self._p.resetJointState(self.body, i, value, 0.0)

    def states(self) -> tuple[list[float], list[float]]:
        """Positions and velocities in the order of JOINTS."""
        states = self._p.getJointStates(self.body, self._all)
        return [s[0] for s in states], [s[1] for s in states]

    def apply_torques(self, torques: list[float]) -> None:
        """Torques [Nm] (ext: force [N]) on slew, lift, tilt, ext for the next physics step."""
        self._p.setJointMotorControlArray(self.body, self._torque_driven, self._p.TORQUE_CONTROL, forces=torques)

    def drive(self, joint: str, speed: float, force: float) -> None:
        """A force-limited speed motor on a joint."""
        self._p.setJointMotorControl2(
            self.body, self.index[joint], self._p.VELOCITY_CONTROL, targetVelocity=speed, force=force
        )

    def motor_torque(self, joint: str) -> float:
        """Torque the motor of ``joint`` applied in the last step [Nm]."""
        return self._p.getJointState(self.body, self.index[joint])[3]

    def hanging_force(self) -> float:
        """Magnitude of the reaction force at the hanger pin [N]."""
        return math.hypot(*self._p.getJointState(self.body, self.index["hanger"])[2][:3])

    def link_poses(self) -> dict[str, tuple[Vector, Quaternion]]:
        """URDF link frames in the base frame."""
        states = self._p.getLinkStates(self.body, [self.link[n] for n in LINKS], computeForwardKinematics=1)
        return {name: (s[4], s[5]) for name, s in zip(LINKS, states, strict=True)}
