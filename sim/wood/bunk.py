"""The load bunk: floor and stakes as boxes, and its frame.

Bunk frame: origin over the middle of the floor, x along the bunk, y across, z as in the crane's base frame (heights
are the base frame's).  On a fixed machine the bunk stands beside the crane (link ``base``); on a carrier it is part of
the rear frame and moves with it (link ``rear``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from machine.profile import Bunk, Profile
from sim.geometry import Shape, Vector, rpy_quaternion

STAKE_M: Final = 0.08
FRAME_M: Final = 0.12  # floor beams of a bunk that stands on a carrier
# Stakes along the bunk, in bunk lengths: the grapple opens in the wide gap, and two stakes still hold a log.
STAKE_PLACES: Final = (-0.40, -0.14, 0.40)
# The carrier's bunk holds logs of 1.9 m, so its stakes stand nearer to the middle.
CARRIER_STAKE_PLACES: Final = (-0.34, 0.34)
COLOUR: Final = (0.35, 0.37, 0.4)


def bunk_link(profile: Profile) -> str:
    """Return the link that the bunk is part of."""
    return "base" if profile.carrier is None else "rear"


def bunk_boxes(profile: Profile) -> list[tuple[Vector, Vector]]:
    """Return edge lengths and middle in the bunk's frame [m]: the floor first, then the stakes."""
    b = profile.bunk
    low = profile.workspace.ground_z_m if profile.carrier is None else b.floor_z_m - FRAME_M
    boxes: list[tuple[Vector, Vector]] = [
        ((b.length_m, b.width_m, b.floor_z_m - low), (0.0, 0.0, (b.floor_z_m + low) / 2))
    ]
    side, z = b.width_m / 2 + STAKE_M / 2, b.floor_z_m + b.stake_height_m / 2
    stake = (STAKE_M, STAKE_M, b.stake_height_m)
    length_shares = STAKE_PLACES if profile.carrier is None else CARRIER_STAKE_PLACES
    return boxes + [(stake, (length_share * b.length_m, y, z)) for length_share in length_shares for y in (-side, side)]


def bunk_shapes(profile: Profile) -> list[Shape]:
    """Return floor and stakes in the frame of ``bunk_link``."""
    b, c = profile.bunk, profile.carrier
    shapes = []
    for size, middle in bunk_boxes(profile):
        at, yaw = from_bunk(b, middle), b.yaw_rad
        if c is not None:
            cos, sin = math.cos(c.crane_yaw_rad), math.sin(c.crane_yaw_rad)
            x, y, z = c.crane_base_m
            at, yaw = (x + cos * at[0] - sin * at[1], y + sin * at[0] + cos * at[1], z + at[2]), yaw + c.crane_yaw_rad
        shapes.append(Shape(bunk_link(profile), size, at, rpy_quaternion(0.0, 0.0, yaw), COLOUR))
    return shapes


def from_bunk(b: Bunk, point: Sequence[float]) -> Vector:
    """Transform a point of the bunk's frame into the crane's base frame."""
    c, s = math.cos(b.yaw_rad), math.sin(b.yaw_rad)
    return (b.center_m[0] + c * point[0] - s * point[1], b.center_m[1] + s * point[0] + c * point[1], point[2])


def to_bunk(b: Bunk, point: Sequence[float]) -> Vector:
    """Transform a point of the crane's base frame into the bunk's frame."""
    c, s = math.cos(b.yaw_rad), math.sin(b.yaw_rad)
    x, y = point[0] - b.center_m[0], point[1] - b.center_m[1]
    return (c * x + s * y, c * y - s * x, point[2])
