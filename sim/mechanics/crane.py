"""The crane as links and joints of a multibody, from the profile's geometry and the truth's masses.

Joint table: docs/reference/machines.md sections 1.1 and 1.2 (palms), 2 (aoro).  From ``turntable`` upwards every link
frame has y along the reach, x to the right, z up; pitch axes are +x, and the Denavit-Hartenberg numbers of the profile
determine the joint origins, so the plant's rigid kinematics equal the profile's exactly.  Above the slew bearing the
column bends on two hinges, ``flex_pitch`` (x) and ``flex_roll`` (y), which no encoder measures
(docs/reference/plant-model.md section 2).  Hanger and fork swing freely.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal

from machine.profile import Kinematics, Profile
from sim.bullet.body import JointDef, LinkDef
from sim.geometry import IDENTITY, Shape, Vector, rpy_quaternion
from sim.mechanics.grapple import PIVOT_Y_M, grapple_shapes, jaw_geometry
from sim.truth.body import Steel, Structure
from sim.truth.load import Truth

FLEX_JOINTS: Final = ("flex_pitch", "flex_roll")
PASSIVE_JOINTS: Final = ("hanger", "fork")
CRANE_JOINTS: Final = ("slew", *FLEX_JOINTS, "lift", "tilt", "ext", *PASSIVE_JOINTS, "rot", "tong_left", "tong_right")
CRANE_LINKS: Final = (
    *("base", "turntable", "flexure", "mast", "boom", "stick", "telescope"),
    *(*PASSIVE_JOINTS, "rotator", "tong_left", "tong_right"),
)
STOP_MARGIN: Final = 0.03  # of the hard stops outside the working range, behind the cylinders' cushions [rad, m]
FLEX_STOP_RAD: Final = 0.15
# Links without an entry in the tables of masses: mass [kg] and principal inertia [kg m^2] of small steel parts.
SMALL_LINKS: Final = {"base": (100.0, 5.0), "turntable": (15.0, 0.5), "flexure": (5.0, 0.1)}


def _telescope(k: Kinematics, steel: Steel) -> tuple[float, Vector, Vector, Vector]:
    """Place the telescope in the stick frame: pitch [rad] and direction of its axis, its frame at 0, the pin at 0.

    Third and fourth row of the DH chain: a3 across and d4 along the telescope's own axis, which theta3's offset turns.
    """
    a = k.theta3_offset_rad + k.theta2_offset_rad - math.pi / 2
    along = (0.0, math.cos(a), math.sin(a))
    across = (0.0, -math.sin(a), math.cos(a))
    frame = steel.telescope_frame_m or (0.0, k.a3_m * across[1], k.a3_m * across[2])
    pin = (0.0, k.a3_m * across[1] + k.d4_m * along[1], k.a3_m * across[2] + k.d4_m * along[2])
    return a, along, frame, pin


def crane_shapes(profile: Profile, steel: Steel) -> list[Shape]:
    """Return all boxes of the crane; ``solid`` ones collide."""
    k = profile.kinematics
    grey, yellow, dark = (0.45, 0.47, 0.5), (0.95, 0.72, 0.1), (0.2, 0.2, 0.22)
    pitch, along, frame, pin = _telescope(k, steel)
    tilted = rpy_quaternion(pitch, 0.0)
    foot = profile.workspace.ground_z_m if profile.carrier is None else 0.0
    pivot = k.d1_m - steel.bearing_z_m
    (boom_x, boom_z), stick, inner = steel.beams_m
    length = 0.88 * k.d4_m  # of the stick's tube and of the telescope in it

    def beside_pin(back_m: float) -> Vector:
        return (0.0, pin[1] - back_m * along[1], pin[2] - back_m * along[2])

    middle = beside_pin(0.62 * k.d4_m)
    tube = beside_pin(0.03 + length / 2)
    wide = 1.8 * steel.column_m
    pedestal = ((wide, wide, steel.bearing_z_m - foot), (0.0, 0.0, (steel.bearing_z_m + foot) / 2))
    return [
        Shape("base", *pedestal, IDENTITY, dark, False),
        Shape(
            "mast", (steel.column_m, steel.column_m, pivot + 0.05), (0, k.a1_m / 2, pivot / 2), IDENTITY, grey, False
        ),
        Shape("boom", (boom_x, k.a2_m, boom_z), (0, k.a2_m / 2, 0), IDENTITY, yellow),
        Shape("stick", (stick[0], length, stick[1]), middle, tilted, yellow),
        Shape("telescope", (inner[0], length, inner[1]), (0, tube[1] - frame[1], tube[2] - frame[2]), tilted, grey),
        *grapple_shapes(profile),
    ]


def crane_links(profile: Profile, truth: Truth) -> tuple[list[LinkDef], list[JointDef]]:
    """Make the links in CRANE_LINKS order, the root ``base`` first, and the joints in CRANE_JOINTS order."""
    shapes = crane_shapes(profile, truth.steel)
    links = []
    for name in CRANE_LINKS:
        own = tuple(s for s in shapes if s.link == name)
        if name in SMALL_LINKS:
            mass, inertia = SMALL_LINKS[name]
            links.append(LinkDef(name, mass, (0.0, 0.0, 0.0), (inertia, inertia, inertia), own))
            continue
        t = truth.links["tong" if name.startswith("tong") else name]
        com = (-t.com_m[0], t.com_m[1], t.com_m[2]) if name == "tong_left" else t.com_m
        links.append(LinkDef(name, t.mass_kg, com, t.inertia_kg_m2, own))
    return links, _joints(profile, truth)


def _joints(profile: Profile, truth: Truth) -> list[JointDef]:
    k, steel = profile.kinematics, truth.steel
    _, along, frame, pin = _telescope(k, steel)
    jaws = jaw_geometry(profile)
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    boom = (0.0, k.a2_m * math.cos(k.theta2_offset_rad), k.a2_m * math.sin(k.theta2_offset_rad))
    pivot = -jaws.pivot_z_m
    table = {
        "slew": ("base", "turntable", (0.0, 0.0, steel.bearing_z_m), z),
        "flex_pitch": ("turntable", "flexure", (0.0, 0.0, 0.0), x),
        "flex_roll": ("flexure", "mast", (0.0, 0.0, 0.0), y),
        "lift": ("mast", "boom", (0.0, k.a1_m, k.d1_m - steel.bearing_z_m), x),
        "tilt": ("boom", "stick", boom, x),
        "ext": ("stick", "telescope", frame, along),
        "hanger": ("telescope", "hanger", (0.0, pin[1] - frame[1], pin[2] - frame[2]), x),
        "fork": ("hanger", "fork", (0.0, 0.0, -k.hanger_to_fork_m), y),
        "rot": ("fork", "rotator", (0.0, 0.0, -k.fork_to_rotator_m), z),
        "tong_left": ("rotator", "tong_left", (-jaws.pivot_x_m, PIVOT_Y_M, pivot), (0.0, -1.0, 0.0)),
        "tong_right": ("rotator", "tong_right", (jaws.pivot_x_m, PIVOT_Y_M, pivot), y),
    }
    stops = {name: (spec.lower - STOP_MARGIN, spec.upper + STOP_MARGIN) for name, spec in profile.joints.items()}
    stops |= dict.fromkeys(FLEX_JOINTS, (-FLEX_STOP_RAD, FLEX_STOP_RAD)) | dict.fromkeys(
        PASSIVE_JOINTS, (-math.pi, math.pi)
    )
    stops |= dict.fromkeys(("tong_left", "tong_right"), (-STOP_MARGIN, jaws.closed_rad + STOP_MARGIN))
    kinds: dict[str, Literal["prismatic", "continuous"]] = {"ext": "prismatic"}
    kinds |= {name: "continuous" for name in profile.joints if truth.functions[name].cylinder.endless}
    return [
        JointDef(
            name,
            kinds.get(name, "revolute"),
            parent,
            child,
            origin,
            # The mast's y is the reach; the base frame is the profile's.
            (0.0, 0.0, k.theta1_offset_rad - math.pi / 2) if name == "slew" else (0.0, 0.0, 0.0),
            axis,
            *stops[name],
        )
        for name, (parent, child, origin, axis) in table.items()
    ]


def rigid_pin(joints: Sequence[JointDef], q: Mapping[str, float]) -> Vector:
    """Compute the hanger pin in the base frame with a straight column, along the joint table."""
    at, (rx, ry, rz) = (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # columns of the rotation
    for joint in joints:
        x, y, z = joint.origin_m
        if joint.kind == "prismatic":
            x, y, z = (o + q[joint.name] * a for o, a in zip((x, y, z), joint.axis, strict=True))
        at = (
            at[0] + x * rx[0] + y * ry[0] + z * rz[0],
            at[1] + x * rx[1] + y * ry[1] + z * rz[1],
            at[2] + x * rx[2] + y * ry[2] + z * rz[2],
        )
        if joint.name == "hanger":
            break
        if joint.name == "slew":
            rx, ry = _turned(rx, ry, joint.rpy_rad[2] + q["slew"])
        elif joint.name in ("lift", "tilt"):
            ry, rz = _turned(ry, rz, q[joint.name])
    return at


def _turned(a: Vector, b: Vector, angle: float) -> tuple[Vector, Vector]:
    """Turn two axes about the third, from ``a`` towards ``b``."""
    c, s = math.cos(angle), math.sin(angle)
    return (
        (c * a[0] + s * b[0], c * a[1] + s * b[1], c * a[2] + s * b[2]),
        (c * b[0] - s * a[0], c * b[1] - s * a[1], c * b[2] - s * a[2]),
    )


# -- The elastic column: two sprung hinges under the mast, which no encoder measures (docs/reference/plant-model.md
# section 2).
#
# The encoders are zeroed, and the crane is levelled, at the home pose with an empty grapple: there the column
# stands plumb.  The springs' rest angles carry that pose's weight, and elsewhere the tip sags against the encoders'
# reading.


class Column:
    """Spring and damper of ``flex_pitch`` and ``flex_roll``; ``home_moments``: moments of the weight at home [Nm]."""

    def __init__(self, structure: Structure, home_moments: Sequence[float]) -> None:
        self._k = (structure.flex_pitch_nm_rad, structure.flex_roll_nm_rad)
        self._damping_s = structure.flex_damping_s
        self._rest = tuple(-moment / k for moment, k in zip(home_moments, self._k, strict=True))

    def torques(self, angles: Sequence[float], rates: Sequence[float], extra_s: float = 0.0) -> list[float]:
        """Compute the torques [Nm] on flex_pitch and flex_roll; ``extra_s`` adds to the ratio of damper to spring."""
        d = self._damping_s + extra_s
        springs = zip(angles, self._rest, rates, self._k, strict=True)
        return [-k * (x - rest + d * v) for x, rest, v, k in springs]

    def balance(self, moments: Sequence[float]) -> list[float]:
        """Compute the angles at which the springs carry these moments [Nm]."""
        return [rest + moment / k for rest, moment, k in zip(self._rest, moments, self._k, strict=True)]
