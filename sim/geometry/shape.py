"""Boxes, vectors and rotations: the plant's bodies consist of boxes, for collision, drawing and the cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Shape:
    """A box: full edge lengths [m] and pose in the frame of ``link``; ``solid`` ones collide, others are only drawn."""

    link: str
    size_m: Vector
    position_m: Vector
    quaternion: Quaternion
    colour: Vector
    solid: bool = True


def rpy_quaternion(roll: float, pitch: float, yaw: float = 0.0) -> Quaternion:
    """Quaternion (x, y, z, w) of rotations about the fixed axes x, then y, then z [rad], as URDF's rpy."""
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def quaternion_rpy(q: Quaternion) -> Vector:
    """Roll, pitch, yaw [rad] of a quaternion (x, y, z, w): the inverse of ``rpy_quaternion``."""
    x, y, z, w = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return (roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
