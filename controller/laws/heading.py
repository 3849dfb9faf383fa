"""Steering of the articulated carrier, to a waypoint or to an articulation angle, by the rate of the articulation::

    waypoint        rate = heading_kp_1_s * wrap(bearing - heading)                        (paper B 3.2.1)
    articulation    rate = wanted rate + kp * (wanted angle - angle - in flight)

Angles are counter-clockwise from east, + bends left; the heading is that of the front half.  The first law needs no
measured angle: L s^2 + Kp lr s + Kp v = 0 is damped, because the front half turns while it bends
(docs/reference/machines.md section 7.2; margins by `timberhand bench loop-design`).  The second law is our own and
closes on the encoder: what was commanded beyond the wanted rate within delay and lag of the valve counts as done.
`SteeringLimits` limits the rate for the valve.
"""

from __future__ import annotations

import math
from typing import Final

from controller.laws.joint import DelayCompensation
from machine.profile import Carrier

ANGLE_GAIN: Final = 0.75
"""Gain on the angle's error over 1 / (delay + lag of the valve)."""
ANGLE_BAND_RAD: Final = 0.002
"""A constant wanted angle is not controlled within this band, or the dead-band would keep the law hunting; ..."""
ANGLE_LEAVE_BANDS: Final = 2.0
"""... control resumes outside this many bands."""
END_GAIN_1_S: Final = 3.0
"""Speed limit over the distance to the end of the range: the articulation can stop before it."""
RATE_RISE_S: Final = 0.25
"""The rate goes from zero to its limit within this time."""
MIN_BEARING_M: Final = 0.5
"""Nearer to the waypoint than this the bearing is unsteady, and the last one is kept."""

_EQUATOR_M: Final = 6378137.0
_E2: Final = 6.69437999014e-3
"""Semi-major axis and squared eccentricity of WGS 84."""


def east_north_m(from_lat_deg: float, from_lon_deg: float, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """(east, north) [m] between two positions a few hundred metres apart; error 1 cm over 500 m up to 80 deg
    latitude.
    """
    middle = math.radians(0.5 * (from_lat_deg + lat_deg))
    sine = math.sin(middle)
    root = math.sqrt(1.0 - _E2 * sine * sine)
    north = math.radians(lat_deg - from_lat_deg) * _EQUATOR_M * (1.0 - _E2) / (root * root * root)
    east = math.radians(math.remainder(lon_deg - from_lon_deg, 360.0)) * _EQUATOR_M * math.cos(middle) / root
    return east, north


class WaypointLaw:
    """Paper B's law; `step` returns the articulation rate [rad/s] for the heading error."""

    __slots__ = ("_bearing_rad", "_kp_1_s")

    def __init__(self, carrier: Carrier) -> None:
        self._kp_1_s = carrier.heading_kp_1_s
        self._bearing_rad = math.nan

    def reset(self) -> None:
        """A new drive begins."""
        self._bearing_rad = math.nan

    def step(self, east_m: float, north_m: float, yaw_rad: float) -> float:
        """``east_m`` and ``north_m`` to the waypoint, ``yaw_rad`` of the front half; 0 where they are unknown (NaN)."""
        far = math.hypot(east_m, north_m) > MIN_BEARING_M
        if far or self._bearing_rad != self._bearing_rad:
            self._bearing_rad = math.atan2(north_m, east_m)
        error = math.remainder(self._bearing_rad - yaw_rad, math.tau) if math.isfinite(yaw_rad) else 0.0
        return self._kp_1_s * error if error == error else 0.0


class AngleLaw:
    """Feed-forward and P control of the articulation's angle; `step` returns the rate [rad/s]."""

    __slots__ = ("_flight", "_kp_1_s", "_resting")

    def __init__(self, carrier: Carrier, period_s: float) -> None:
        reaction_s = carrier.steer_valve.delay_s + carrier.articulation_lag_s
        self._kp_1_s = ANGLE_GAIN / reaction_s
        self._flight = DelayCompensation(reaction_s, period_s)
        self._resting = False

    def reset(self) -> None:
        """A new drive begins."""
        self._flight.reset()
        self._resting = False

    def step(self, wanted_rad: float, wanted_rate_rad_s: float, angle_rad: float) -> float:
        """One tick with the wanted angle and rate now and the measured angle; 0 where one is NaN."""
        error = wanted_rad - angle_rad
        if error != error:
            return 0.0
        size = abs(error)
        bands = ANGLE_LEAVE_BANDS if self._resting else 1.0
        self._resting = wanted_rate_rad_s == 0.0 and size < ANGLE_BAND_RAD * bands
        if self._resting:
            return 0.0
        return wanted_rate_rad_s + self._kp_1_s * (error - self._flight.travel)

    def note_command(self, rate_rad_s: float, wanted_rate_rad_s: float, elapsed_s: float) -> None:
        """Note the command of this tick; what exceeds the wanted rate is in flight."""
        self._flight.add((rate_rad_s - wanted_rate_rad_s) * elapsed_s)


class SteeringLimits:
    """``rate_rad_s`` is the valve's command: within rate and acceleration limits, slower near the ends of the range."""

    __slots__ = ("_limit_rad", "_rate_limit", "_slew", "rate_rad_s")

    def __init__(self, carrier: Carrier) -> None:
        self._limit_rad = carrier.articulation_limit_rad
        self._rate_limit = carrier.articulation_rate_limit_rad_s
        self._slew = self._rate_limit / RATE_RISE_S
        self.rate_rad_s = 0.0

    def reset(self) -> None:
        """Reset for a valve at neutral."""
        self.rate_rad_s = 0.0

    def step(self, wanted_rad_s: float, angle_rad: float, elapsed_s: float) -> float:
        """Limit the wanted rate at the measured angle; an unknown angle (NaN) gives a rate that ramps to 0."""
        if angle_rad != angle_rad:
            wanted_rad_s = 0.0
        wanted = min(max(wanted_rad_s, -self._rate_limit), self._rate_limit)
        change = self._slew * elapsed_s
        rate = min(max(wanted, self.rate_rad_s - change), self.rate_rad_s + change)
        if angle_rad == angle_rad:
            rate = min(rate, max(0.0, (self._limit_rad - angle_rad) * END_GAIN_1_S))
            rate = max(rate, min(0.0, (-self._limit_rad - angle_rad) * END_GAIN_1_S))
        self.rate_rad_s = rate
        return rate
