"""A surveying instrument of the test bench, with realistic noise: it reads the position of the hanger pin and the
direction of the grapple in the crane's base frame.
"""

from __future__ import annotations

import random
from math import pi, radians
from typing import Final

from sim.geometry.shape import Vector, quaternion_rpy
from sim.plant import Plant

POSITION_SIGMA_M: Final = 0.002
"""One sigma per axis: a total station that tracks a prism on a swinging boom."""
YAW_SIGMA_RAD: Final = radians(1.0)
"""One sigma: two points of a hanging grapple that still moves a little."""


class TotalStation:
    """Reads positions; its noise comes from its own seed."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(f"total station {seed}")
        self._yaw_rng = random.Random(f"total station, direction {seed}")

    def read(self, pin_m: Vector) -> Vector:
        """The reading [m] for a pin at ``pin_m``."""
        x, y, z = (axis + self._rng.gauss(0.0, POSITION_SIGMA_M) for axis in pin_m)
        return (x, y, z)

    def read_yaw(self, yaw_rad: float) -> float:
        """The reading [rad] for a grapple that opens along ``yaw_rad``: 0..pi, because its two sides look alike."""
        return (yaw_rad + self._yaw_rng.gauss(0.0, YAW_SIGMA_RAD)) % pi


def grapple_yaw(plant: Plant) -> float:
    """True direction along which the grapple opens, about the vertical, in the crane's base frame [rad]."""
    grapple, base = plant.link_poses()["rotator"][1], plant.base_pose()[1]
    return quaternion_rpy(grapple)[2] - quaternion_rpy(base)[2]
