"""Sway damping: damps a grapple that still swings after the motion, on a machine with an inertial sensor on it.

A pendulum of length L whose pin moves by x swings by theta'' = -w^2 theta - x''/L, w^2 = g/L, theta positive where it
hangs ahead of its pin.  A pin that moves with x' = gain w L theta gives theta'' = -w^2 theta - gain w theta': ``gain``
is twice the damping ratio.  The valve answers late and the sensor's value is old, so theta is predicted by both delays:
a free pendulum turns in its phase plane (theta, theta'/w) by w t.  (For small w t that is theta + t theta'.)

The pin's displacement is pulled back with `RETURN_1_S`, so it ends where it began; this leads by atan(RETURN_1_S / w),
which the prediction subtracts.  Displacement and velocity are added to the reference of the joint laws, which follow
them and have nothing to correct.  At the end both are exactly zero, and end positioning continues.

Tangential swing is damped by the slew, radial swing by stick and telescope: one moves the pin across the stick, the
other along it, nearly at right angles in every pose, so a level motion is never singular.  The boom, which carries most
and rings most, stays still.

Inputs: lean [rad], rate [rad/s], age [s], joints; output: joint velocities and displacements [unit/s, unit].
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, cos, hypot, sin, sqrt
from typing import Final

from machine.geometry.kinematics import jacobian
from machine.geometry.sag import GRAVITY_M_S2
from machine.joints import N_JOINTS, Joint
from machine.profile import Imu, Profile, joint

RETURN_1_S: Final = 1.5
SENSOR_DELAY_S: Final = 0.02
"""Delay of the sensor's own filter before it sends."""
START_ZONES: Final = 1.5
"""Damping begins at this many dead zones of swing and ends at one."""
FADE_S: Final = 0.2
MAX_DAMPING_S: Final = 3.0
"""Swing is damped for this long after the reference stands; then the joints come to rest, whatever still swings."""
OVER_SHARE: Final = 0.25
"""A displacement below this share of the stop band is over."""
MOVED_JOINTS: Final = (Joint.SLEW, Joint.TILT, Joint.EXT)
SWING: Final = ("LeanRadial", "LeanTangential", "RateRadial", "RateTangential")
"""Signals of the sensor's message, in the order of `Swing`."""
STATUS_USABLE: Final = (0, 1)
"""Usable values of the sensor's status: ok, and warning."""

Swing = tuple[float, float, float, float]
"""Lean radial, lean tangential [rad], rate radial, rate tangential [rad/s]."""


class DirectionalDamper:
    """One direction of the swing: pin velocity from lean and rate."""

    __slots__ = ("_angular", "_dead_zone", "_lead_s", "_limit", "_on", "_per_rad", "_share", "_wanted", "velocity_m_s")

    def __init__(self, imu: Imu, reaction_s: float) -> None:
        """``reaction_s``: delay from command to pin velocity."""
        self._angular = sqrt(GRAVITY_M_S2 / imu.pendulum_m)
        self._per_rad = imu.gain * self._angular * imu.pendulum_m
        self._lead_s = reaction_s + SENSOR_DELAY_S - atan(RETURN_1_S / self._angular) / self._angular
        self._limit, self._dead_zone = imu.pin_speed_m_s, imu.dead_zone_rad
        self.reset()

    def reset(self) -> None:
        """Reset to no damping."""
        self._on = False
        self._share = self._wanted = self.velocity_m_s = 0.0

    def step(self, lean: float, rate: float, age_s: float, elapsed_s: float) -> None:
        """Run one tick in which the swing may be damped; ``velocity_m_s`` is the pin's."""
        w = self._angular
        swing = hypot(lean, rate / w)
        self._on = swing > (self._dead_zone if self._on else START_ZONES * self._dead_zone)
        phase = w * (self._lead_s + age_s)
        pin_velocity_m_s = self._per_rad * (lean * cos(phase) + rate / w * sin(phase))
        self._wanted = min(max(pin_velocity_m_s, -self._limit), self._limit)
        self._fade(self._on, elapsed_s)

    def stop(self, elapsed_s: float) -> None:
        """Run one tick in which it may not, or without a measurement: the last velocity fades."""
        self._on = False
        if self._share:
            self._fade(False, elapsed_s)

    def _fade(self, on: bool, elapsed_s: float) -> None:
        change = elapsed_s / FADE_S
        self._share = min(1.0, self._share + change) if on else max(0.0, self._share - change)
        self.velocity_m_s = self._share * self._wanted


class SwayDamping:
    """Both directions; ``velocity`` and ``displacement`` per joint are exactly zero unless ``active``."""

    __slots__ = ("_kin", "_over", "_radial", "_stood_s", "_tangential", "active", "displacement", "velocity")

    def __init__(self, profile: Profile, imu: Imu, leads_ns: Sequence[int]) -> None:
        """``leads_ns``: delay of each joint behind its command."""
        self._kin = profile.kinematics
        self._tangential = DirectionalDamper(imu, leads_ns[Joint.SLEW] * 1e-9)
        self._radial = DirectionalDamper(imu, 0.5e-9 * (leads_ns[Joint.TILT] + leads_ns[Joint.EXT]))
        self._over = tuple((j, OVER_SHARE * joint(profile, j).law.stop_band) for j in MOVED_JOINTS)
        self.velocity, self.displacement = [0.0] * N_JOINTS, [0.0] * N_JOINTS
        self.reset()

    def reset(self) -> None:
        """Reset when something else moved the joints."""
        self.active = False
        self._stood_s = 0.0
        self._tangential.reset()
        self._radial.reset()
        self._clear()

    def _clear(self) -> None:
        for j in MOVED_JOINTS:
            self.velocity[j] = self.displacement[j] = 0.0

    def step(self, swing: Swing | None, age_s: float, stands: bool, q: Sequence[float], elapsed_s: float) -> None:
        """Run one tick with the swing measured ``age_s`` ago (None while stale), whether the reference ``stands``, and
        joint positions (NaN while unknown).
        """
        self._stood_s = self._stood_s + elapsed_s if stands else 0.0
        radial, tangential = self._radial, self._tangential
        if swing is not None and stands and self._stood_s <= MAX_DAMPING_S:
            radial.step(swing[0], swing[2], age_s, elapsed_s)
            tangential.step(swing[1], swing[3], age_s, elapsed_s)
        elif self.active:
            radial.stop(elapsed_s)
            tangential.stop(elapsed_s)
        if not self.active and not radial.velocity_m_s and not tangential.velocity_m_s:
            return
        self._move(radial.velocity_m_s, tangential.velocity_m_s, q, elapsed_s)

    def _move(self, radial_m_s: float, tangential_m_s: float, q: Sequence[float], elapsed_s: float) -> None:
        """Turn the pin's velocity into joint velocities, and pull the displacement back."""
        plane = (-self._kin.theta1_offset_rad, *q[1:4])  # turned so that x is the reach
        along, across, up = jacobian(self._kin, plane)
        reach_m = across[Joint.SLEW]
        tilt, ext = (along[Joint.TILT], up[Joint.TILT]), (along[Joint.EXT], up[Joint.EXT])
        det = tilt[0] * ext[1] - tilt[1] * ext[0]  # the stick's length, negative
        if not reach_m > 0.0:  # unknown
            self.reset()
            return
        joint_velocities = (tangential_m_s / reach_m, radial_m_s * ext[1] / det, -radial_m_s * tilt[1] / det)
        self.active = radial_m_s != 0.0 or tangential_m_s != 0.0
        velocity, displacement = self.velocity, self.displacement
        for (j, over), v in zip(self._over, joint_velocities, strict=True):
            velocity[j] = v - RETURN_1_S * displacement[j]
            displacement[j] += velocity[j] * elapsed_s
            if abs(displacement[j]) > over:
                self.active = True
        if not self.active:
            self._clear()
