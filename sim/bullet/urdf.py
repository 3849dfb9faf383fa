"""A multibody as URDF text: links, joints, and a newline after every tag (Bullet splits lines over 8191 characters)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sim.geometry.shape import Shape, Vector, quaternion_rpy


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
    """A joint: pose of the child frame in the parent's at 0, axis in the child frame, stops [rad, m]."""

    name: str
    kind: Literal["revolute", "prismatic", "fixed"]
    parent: str
    child: str
    origin_m: Vector = (0.0, 0.0, 0.0)
    rpy_rad: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float = 0.0
    upper: float = 0.0


def urdf_text(name: str, links: Sequence[LinkDef], joints: Sequence[JointDef]) -> str:
    """The whole robot; the first link is the root, joints follow the order given."""
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
