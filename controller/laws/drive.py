"""Speed and brake of the carrier: the speed command ramps at the profile's acceleration, and a stop is a ramp as well.

The vehicle node closes the loop on the wheels; this law only computes its command.  The brake is on while the machine
is to stand and stands; it never brakes a machine that still rolls, except when a stop lasts too long.
"""

from __future__ import annotations

from typing import Final

from machine.profile import Carrier

STOP_M_S2: Final = 1.0
"""Deceleration of a stop."""
STANDING_M_S: Final = 0.04
"""Below this speed the carrier stands."""
SETTLE_S: Final = 0.8
"""The brake waits at most this long for a machine that was told to stand."""


class DriveLaw:
    """``speed_m_s`` is the speed command, ``brake`` whether the carrier stands with its brake on."""

    __slots__ = ("_acceleration", "_limit", "_standing_s", "brake", "speed_m_s")

    def __init__(self, carrier: Carrier) -> None:
        self._acceleration = carrier.drive_acceleration_m_s2
        self._limit = carrier.speed_limit_m_s
        self.reset()

    def reset(self) -> None:
        """The carrier stands with its brake on."""
        self.speed_m_s = 0.0
        self.brake = True
        self._standing_s = 0.0

    @property
    def stop_s(self) -> float:
        """Time of a stop from the present speed until the brake is on."""
        return 0.0 if self.brake else abs(self.speed_m_s) / STOP_M_S2 + SETTLE_S

    def step(self, wanted_m_s: float, measured_m_s: float, cap: float, elapsed_s: float) -> None:
        """One tick towards ``wanted_m_s``; ``cap`` scales the speed limit; an unknown measured speed is NaN."""
        limit = cap * self._limit
        self._approach(min(max(wanted_m_s, -limit), limit), self._acceleration * elapsed_s)
        self._set_brake(wanted_m_s == 0.0, measured_m_s, elapsed_s)

    def stop(self, measured_m_s: float, elapsed_s: float) -> None:
        """One tick of a stop."""
        self._approach(0.0, STOP_M_S2 * elapsed_s)
        self._set_brake(True, measured_m_s, elapsed_s)

    def _approach(self, wanted_m_s: float, change: float) -> None:
        self.speed_m_s = min(max(wanted_m_s, self.speed_m_s - change), self.speed_m_s + change)

    def _set_brake(self, stands: bool, measured_m_s: float, elapsed_s: float) -> None:
        if not stands:
            self.brake, self._standing_s = False, 0.0
            return
        if self.speed_m_s == 0.0:
            self._standing_s += elapsed_s
        # On a slope a machine would roll on if the brake waited for the end of the ramp.
        if abs(measured_m_s) < STANDING_M_S or self._standing_s > SETTLE_S:
            self.brake, self.speed_m_s = True, 0.0
