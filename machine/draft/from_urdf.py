"""Answers that a URDF gives: the crane's geometry and the ranges of its joints.

The crane of this project is a chain slew, lift, tilt, telescope and a hanger pin in one vertical plane through the slew
axis.  The origins and axes of those joints at their zero positions determine the Denavit-Hartenberg numbers of the
profile.  Lengths below the pin are taken where the file has joints ``fork``, ``rot`` and ``tong_left``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
from defusedxml import DefusedXmlException

from runtime.errors import InputRefused

CHAIN: Final = ("slew", "lift", "tilt", "ext", "hanger")
"""Joints that a crane has; ``hanger`` is the first passive hinge above the grapple."""
RANGES: Final = ("slew", "lift", "tilt", "ext", "rot")
BELOW: Final = ("hanger", "fork", "rot", "tong_left")
ANGLE_RAD: Final = 1e-3
"""Axes that are turned by more do not fit the chain."""
OFF_PLANE_M: Final = 1e-3

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
UNTURNED: Final[Matrix] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class _Placed:
    """A joint at the zero position of all joints: origin [m] and axis in the root's frame, range."""

    origin_m: Vector
    axis: Vector
    lower: float | None
    upper: float | None


def answers_from_urdf(path: Path, names: Mapping[str, str]) -> dict[str, Any]:
    """Read ``kinematics`` and the ranges in ``joints`` as parsed answers; ``names``: the file's joint of each of ours.

    Raises:
        InputRefused: the file cannot be read, a joint is missing, or its joints are no such crane.
    """
    placed = _placed(path)

    def one(joint: str) -> _Placed:
        name = names.get(joint, joint)
        if name not in placed:
            text = f"{path}: there is no joint {name!r}; name the file's joint, as in --urdf-joints {joint}=NAME"
            raise InputRefused("answers.urdf-joint", f"{text}; it has {', '.join(placed)}")
        return placed[name]

    kinematics = _kinematics(path, {joint: one(joint) for joint in CHAIN})
    known = {joint: placed[name] for joint in BELOW if (name := names.get(joint, joint)) in placed}
    if len(known) == len(BELOW):
        kinematics |= _below_pin(known)
    joints = {}
    for joint in RANGES:
        spec = placed.get(names.get(joint, joint))
        if spec is not None and spec.lower is not None and spec.upper is not None:
            joints[joint] = {"lower": spec.lower, "upper": spec.upper}
    return {"kinematics": kinematics, "joints": joints}


def _kinematics(path: Path, chain: Mapping[str, _Placed]) -> dict[str, float]:
    slew, lift, tilt, ext, hanger = (chain[name] for name in CHAIN)
    if _angle(slew.axis, (0.0, 0.0, 1.0)) > ANGLE_RAD:
        raise _unfit(path, "the slew axis does not point straight up")
    if abs(lift.axis[2]) > ANGLE_RAD:
        raise _unfit(path, "the lift axis is not horizontal")
    if _angle(lift.axis, tilt.axis) > ANGLE_RAD:
        raise _unfit(path, "lift and tilt do not turn about the same direction; reverse or correct one axis")
    outward = (-lift.axis[1], lift.axis[0], 0.0)  # up x axis: a positive turn raises what points outward
    if abs(_dot(ext.axis, lift.axis)) > ANGLE_RAD:
        raise _unfit(path, "the telescope does not slide in the plane of the boom")

    def in_plane(joint: _Placed) -> tuple[float, float]:
        from_axis = _minus(joint.origin_m, slew.origin_m)
        return _dot(from_axis, outward), joint.origin_m[2]

    beside = _dot(_minus(hanger.origin_m, slew.origin_m), lift.axis)
    if abs(beside) > OFF_PLANE_M:
        raise _unfit(path, f"the hanger pin is {beside:.3f} m beside the plane through the slew axis")
    (pin_r, pin_z), (stick_r, stick_z), (end_r, end_z) = in_plane(lift), in_plane(tilt), in_plane(hanger)
    theta2 = math.atan2(stick_z - pin_z, stick_r - pin_r)
    pitch = math.atan2(ext.axis[2], _dot(ext.axis, outward))
    along, across = (math.cos(pitch), math.sin(pitch)), (-math.sin(pitch), math.cos(pitch))
    r, z = end_r - stick_r, end_z - stick_z
    return {
        "d1_m": pin_z,
        "a1_m": pin_r,
        "theta1_offset_rad": math.atan2(outward[1], outward[0]),
        "a2_m": math.hypot(stick_r - pin_r, stick_z - pin_z),
        "theta2_offset_rad": theta2,
        "a3_m": r * across[0] + z * across[1],
        "d4_m": r * along[0] + z * along[1],
        "theta3_offset_rad": pitch - theta2 + math.pi / 2.0,
    }


def _below_pin(known: Mapping[str, _Placed]) -> dict[str, float]:
    hanger, fork, rot, tong = (known[name].origin_m for name in BELOW)
    return {
        "hanger_to_fork_m": math.dist(hanger, fork),
        "fork_to_rotator_m": math.dist(fork, rot),
        "rotator_to_tong_pivot_m": abs(_dot(_minus(tong, rot), known["rot"].axis)),
    }


def _unfit(path: Path, what: str) -> InputRefused:
    return InputRefused("answers.urdf-chain", f"{path}: {what}; this project drives cranes that work in one plane")


def _placed(path: Path) -> dict[str, _Placed]:
    """Place all joints of the file by name, in the root's frame."""
    try:
        root: Element = defusedxml.ElementTree.parse(path).getroot()
        joints = {j.attrib["name"]: j for j in root.findall("joint")}
        below = {_link(j, "child"): j for j in joints.values()}
        return {name: _place(joint, below) for name, joint in joints.items()}
    except OSError as error:
        raise InputRefused("answers.urdf-unreadable", f"{path}: cannot be read: {error.strerror}") from None
    except (ParseError, DefusedXmlException, KeyError, ValueError, RecursionError) as error:
        raise InputRefused("answers.urdf-broken", f"{path}: not a URDF file: {error}") from None


def _link(joint: Element, end: str) -> str:
    link_element = joint.find(end)
    if link_element is None:
        raise ValueError(f"joint {joint.attrib['name']} has no {end}")
    return link_element.attrib["link"]


def _frame(joint: Element, below: Mapping[str, Element]) -> tuple[Matrix, Vector]:
    """Compute rotation and origin of a joint's frame in the root's, all joints at zero."""
    above = below.get(_link(joint, "parent"))
    turn, at = (UNTURNED, (0.0, 0.0, 0.0)) if above is None else _frame(above, below)
    origin = joint.find("origin")
    shift = _vector(None if origin is None else origin.get("xyz"), (0.0, 0.0, 0.0))
    own = _rotation(_vector(None if origin is None else origin.get("rpy"), (0.0, 0.0, 0.0)))
    x, y, z = (a + b for a, b in zip(at, _turned(turn, shift), strict=True))
    columns = tuple(_turned(turn, (own[0][c], own[1][c], own[2][c])) for c in range(3))
    rows = tuple((columns[0][r], columns[1][r], columns[2][r]) for r in range(3))
    return (rows[0], rows[1], rows[2]), (x, y, z)


def _place(joint: Element, below: Mapping[str, Element]) -> _Placed:
    turn, at = _frame(joint, below)
    axis, limit = joint.find("axis"), joint.find("limit")
    own = _vector(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0))
    length = math.hypot(*own)
    if not length > 0.0:
        raise ValueError(f"joint {joint.attrib['name']} has an axis of no length")
    unit = (own[0] / length, own[1] / length, own[2] / length)
    given = {} if limit is None else limit.attrib
    ends = [_number(given[key]) if key in given else None for key in ("lower", "upper")]
    return _Placed(at, _turned(turn, unit), *ends)


def _vector(text: str | None, otherwise: Vector) -> Vector:
    if text is None:
        return otherwise
    x, y, z = map(_number, text.split())
    return x, y, z


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not a number")
    return value


def _rotation(rpy: Vector) -> Matrix:
    """Compute the rotation about the fixed axes x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = (tuple(f(a) for a in rpy) for f in (math.cos, math.sin))
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def _turned(m: Matrix, v: Vector) -> Vector:
    return _dot(m[0], v), _dot(m[1], v), _dot(m[2], v)


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _angle(a: Vector, b: Vector) -> float:
    """Compute the angle between unit vectors [rad]."""
    return math.acos(max(-1.0, min(1.0, _dot(a, b))))
