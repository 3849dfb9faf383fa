"""The rows of stakes of the load bunk as boxes, in the crane's base frame."""

from __future__ import annotations

from math import cos, sin
from typing import Final

from machine.profile import Bunk, KeepOut

STAKE_THICKNESS_M: Final = 0.08


def stake_walls(bunk: Bunk) -> tuple[KeepOut, KeepOut]:
    """Return the left and the right row of stakes as walls: a log passes over the whole row wherever the stakes are."""
    c, s = cos(bunk.yaw_rad), sin(bunk.yaw_rad)
    x, y = bunk.center_m
    side = bunk.width_m / 2 + STAKE_THICKNESS_M / 2
    middle_z = bunk.floor_z_m + bunk.stake_height_m / 2
    half = (bunk.length_m / 2, STAKE_THICKNESS_M / 2, bunk.stake_height_m / 2)
    return (
        KeepOut((x - side * s, y + side * c, middle_z), half, bunk.yaw_rad),
        KeepOut((x + side * s, y - side * c, middle_z), half, bunk.yaw_rad),
    )
