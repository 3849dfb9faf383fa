"""The laws of driving: speed and brake of the carrier, and its steering by the rate of the articulation.

Speed: the command ramps at the profile's acceleration, and a stop is a ramp as well.  The vehicle node closes the loop
on the wheels; `DriveLaw` only computes its command.  The brake is on while the machine is to stand and stands; it never
brakes a machine that still rolls, except when a stop lasts too long.

Steering, to a waypoint or to an articulation angle::

    waypoint        rate = heading_kp_1_s * wrap(bearing - heading)                        (paper B 3.2.1)
    articulation    rate = reference rate + kp * (reference angle - angle - in flight)

Angles are counter-clockwise from east, + bends left; the heading is that of the front half.  The first law needs no
measured angle: L s^2 + Kp lr s + Kp v = 0 is damped, because the front half turns while it bends
(docs/reference/machines.md section 7.2; margins by `timberhand bench loop-design`).  The second law is our own and
closes on the encoder: what was commanded beyond the reference rate within delay and lag of the valve counts as done.
`SteeringLimits` limits the rate for the valve.
"""

from __future__ import annotations

import math
from typing import Final

from controller.laws.response import DelayCompensation
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
        """Start from a carrier that stands with its brake on."""
        self.speed_m_s = 0.0
        self.brake = True
        self._standing_s = 0.0

    @property
    def stop_s(self) -> float:
        """Time of a stop from the present speed until the brake is on."""
        return 0.0 if self.brake else abs(self.speed_m_s) / STOP_M_S2 + SETTLE_S

    def step(self, reference_m_s: float, measured_m_s: float, cap: float, elapsed_s: float) -> None:
        """Run one tick towards ``reference_m_s``; ``cap`` scales the speed limit; an unknown measured speed is NaN."""
        limit = cap * self._limit
        self._approach(min(max(reference_m_s, -limit), limit), self._acceleration * elapsed_s)
        self._set_brake(reference_m_s == 0.0, measured_m_s, elapsed_s)

    def stop(self, measured_m_s: float, elapsed_s: float) -> None:
        """Run one tick of a stop."""
        self._approach(0.0, STOP_M_S2 * elapsed_s)
        self._set_brake(True, measured_m_s, elapsed_s)

    def _approach(self, reference_m_s: float, change: float) -> None:
        self.speed_m_s = min(max(reference_m_s, self.speed_m_s - change), self.speed_m_s + change)

    def _set_brake(self, stands: bool, measured_m_s: float, elapsed_s: float) -> None:
        if not stands:
            self.brake, self._standing_s = False, 0.0
            return
        if self.speed_m_s == 0.0:
            self._standing_s += elapsed_s
        # On a slope a machine would roll on if the brake waited for the end of the ramp.
        if abs(measured_m_s) < STANDING_M_S or self._standing_s > SETTLE_S:
            self.brake, self.speed_m_s = True, 0.0


ANGLE_GAIN: Final = 0.75
"""Gain on the angle's error over 1 / (delay + lag of the valve)."""
ANGLE_BAND_RAD: Final = 0.002
"""A constant reference angle is not controlled within this band, or the dead-band would keep the law hunting; ..."""
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
    """Compute (east, north) [m] between two positions a few hundred metres apart; error 1 cm over 500 m up to 80 deg
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
        """Begin a new drive."""
        self._bearing_rad = math.nan

    def step(self, east_m: float, north_m: float, yaw_rad: float) -> float:
        """Run a tick: ``east_m``, ``north_m`` to the waypoint, ``yaw_rad`` of the front half; 0 if unknown (NaN)."""
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
        """Begin a new drive."""
        self._flight.reset()
        self._resting = False

    def step(self, reference_rad: float, reference_rate_rad_s: float, angle_rad: float) -> float:
        """Run one tick with the reference angle and rate now and the measured angle; 0 where one is NaN."""
        error = reference_rad - angle_rad
        if error != error:
            return 0.0
        size = abs(error)
        bands = ANGLE_LEAVE_BANDS if self._resting else 1.0
        self._resting = reference_rate_rad_s == 0.0 and size < ANGLE_BAND_RAD * bands
        if self._resting:
            return 0.0
        return reference_rate_rad_s + self._kp_1_s * (error - self._flight.travel)

    def note_command(self, rate_rad_s: float, reference_rate_rad_s: float, elapsed_s: float) -> None:
        """Note the command of this tick; what exceeds the reference rate is in flight."""
        self._flight.add((rate_rad_s - reference_rate_rad_s) * elapsed_s)


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

    def step(self, requested_rad_s: float, angle_rad: float, elapsed_s: float) -> float:
        """Limit the requested rate at the measured angle; an unknown angle (NaN) gives a rate that ramps to 0."""
        if angle_rad != angle_rad:
            requested_rad_s = 0.0
        limited = min(max(requested_rad_s, -self._rate_limit), self._rate_limit)
        change = self._slew * elapsed_s
        rate = min(max(limited, self.rate_rad_s - change), self.rate_rad_s + change)
        if angle_rad == angle_rad:
            rate = min(rate, max(0.0, (self._limit_rad - angle_rad) * END_GAIN_1_S))
            rate = max(rate, min(0.0, (-self._limit_rad - angle_rad) * END_GAIN_1_S))
        self.rate_rad_s = rate
        return rate
