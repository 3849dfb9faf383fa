"""A carrier that rolls without slip on a level plane: the kinematic world's replacement for the physical carrier.

Its speed follows the vehicle node with limited acceleration, its heading follows the articulation, and its height
the arms.  Frames and names as in `sim.mechanics.carrier`; SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from machine.geometry.carrier import ARMS, heading_rate_rad_s, height_from_arm_angle, pivot_height_m
from machine.profile import Carrier
from sim.geometry.shape import Quaternion, Vector, rpy_quaternion

ACCELERATION_M_S2: Final = 0.8
BRAKE_M_S2: Final = 3.0


class RollingCarrier:
    """``x_m``, ``y_m`` and ``heading_rad`` are of the front axle; ``q`` holds the articulation and the arms."""

    def __init__(self, carrier: Carrier, q: Mapping[str, float], qd: Mapping[str, float]) -> None:
        self._c, self._q, self._qd = carrier, q, qd
        self.x_m, self.y_m, self.heading_rad, self.speed_m_s = carrier.front_axle_m, 0.0, 0.0, 0.0

    def step(self, speed_m_s: float, brake: bool, step_s: float) -> None:
        """One step towards the requested speed of the front axle."""
        change = (BRAKE_M_S2 if brake else ACCELERATION_M_S2) * step_s
        wanted = 0.0 if brake else speed_m_s
        self.speed_m_s += max(-change, min(change, wanted - self.speed_m_s))
        rate = heading_rate_rad_s(self._c, self.speed_m_s, self._q["articulation"], self._qd["articulation"])
        self.heading_rad += rate * step_s
        self.x_m += self.speed_m_s * math.cos(self.heading_rad) * step_s
        self.y_m += self.speed_m_s * math.sin(self.heading_rad) * step_s

    @property
    def wheel_speeds_rad_s(self) -> tuple[float, ...]:
        """Equal for all wheels."""
        return (self.speed_m_s / self._c.wheel_radius_m,) * len(ARMS)

    @property
    def articulation_rad(self) -> float:
        """Angle of the front against the rear, + left."""
        return self._q["articulation"]

    @property
    def arm_heights_m(self) -> tuple[float, ...]:
        """How far each arm raises the frame."""
        return tuple(height_from_arm_angle(self._c, self._q[arm]) for arm in ARMS)

    def front_axle(self) -> Vector:
        """Middle of the front axle, between the hubs."""
        return self.x_m, self.y_m, self._c.wheel_radius_m

    def attitude(self, half: str) -> Vector:
        """Roll, pitch and heading of ``rear`` or ``front``."""
        return 0.0, 0.0, self.heading_rad - (self.articulation_rad if half == "rear" else 0.0)

    def pose(self, half: str) -> tuple[Vector, Quaternion]:
        """Frame of ``rear`` or ``front`` in the world: both lie on the articulation's axis."""
        ahead = self._c.front_axle_m
        up = pivot_height_m(self._c, sum(self.arm_heights_m) / len(ARMS))
        x, y = self.x_m - ahead * math.cos(self.heading_rad), self.y_m - ahead * math.sin(self.heading_rad)
        return (x, y, up), rpy_quaternion(*self.attitude(half))
