"""Valve compensation: joint velocity to spool command [%], by the profile's valve map.

The command is the exact inverse of dead-band and metering curve of docs/reference/machines.md section 3::

    y = sign(w) (db + (1 - h - db) |w|^(1/n))    w: share of the full speed on that side, here in the joint's range
    u = y + h sign(dy)                           h: half of the spool's hysteresis

The spool stays behind its command by half of its hysteresis, below when it opens and above when it shuts; at 10 to 20 %
of the stroke this is more speed than any other error of the valve.  So the command leads by as much, and changes sides
within a part of the hysteresis, not at every flicker.  With a short lever arm the same flow moves the joint faster, so
the full speed depends on the position.  Within 1 % of it the inverse is linear, so that noise around zero does not slam
the spool across the dead-band.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import Final

from machine.profile import Valve

LINEAR_SHARE: Final = 0.01
LEAD_GAIN: Final = 2.0
"""Once the command has turned by a share 1 / LEAD_GAIN of the hysteresis, it leads on the other side."""


class ValveMap:
    """One valve function.  ``arm`` (lever arm) and the speeds at full command are those of the last `set_position`."""

    __slots__ = (
        "_ahead",
        "_at",
        "_deadband_minus",
        "_deadband_plus",
        "_half",
        "_inverse",
        "_last",
        "_lever",
        "_linear",
        "_nominal_minus",
        "_nominal_plus",
        "_range",
        "_sign",
        "arm",
        "full_minus",
        "full_plus",
    )

    def __init__(self, valve: Valve) -> None:
        self._sign = valve.sign
        self._deadband_plus = valve.deadband_plus_pct / 100.0
        self._deadband_minus = valve.deadband_minus_pct / 100.0
        self._half = valve.hysteresis_pct / 200.0
        self._range = 1.0 - self._half
        self._last = self._ahead = 0.0
        self._inverse = 1.0 / valve.exponent
        self._linear: float = LINEAR_SHARE**self._inverse / LINEAR_SHARE
        self._at, self._lever = valve.lever_at, valve.lever
        self.arm = 1.0
        self.full_plus = self._nominal_plus = valve.full_speed_plus
        self.full_minus = self._nominal_minus = valve.full_speed_minus

    def set_position(self, position: float) -> None:
        """Set the lever arm for a joint position [rad, m]; NaN leaves it."""
        at, lever = self._at, self._lever
        if not at or position != position:
            return
        i = bisect_right(at, position)
        if i == 0 or i == len(at):
            arm = lever[0 if i == 0 else -1]
        else:
            share = (position - at[i - 1]) / (at[i] - at[i - 1])
            arm = lever[i - 1] + share * (lever[i] - lever[i - 1])
        self.arm = arm
        self.full_plus, self.full_minus = self._nominal_plus / arm, self._nominal_minus / arm

    def velocity(self, spool_pct: float) -> float:
        """Compute the joint velocity [rad/s or m/s] of an open valve whose spool is measured at this position [%]."""
        share = spool_pct * self._sign / 100.0
        opening = share if share > 0.0 else -share
        deadband = self._deadband_plus if share > 0.0 else self._deadband_minus
        if opening <= deadband:
            return 0.0
        metered: float = min(1.0, (opening - deadband) / (self._range - deadband)) ** (1.0 / self._inverse)
        return metered * (self.full_plus if share > 0.0 else -self.full_minus)

    def spool_pct(self, velocity: float) -> float:
        """Compute the tick's spool command [%], -100..100, for a joint velocity [rad/s, m/s]; limited to full speed."""
        if velocity == 0.0:
            self._last = self._ahead = 0.0
            return 0.0
        if velocity > 0.0:
            share, deadband, side = velocity / self.full_plus, self._deadband_plus, 1.0
        else:
            share, deadband, side = -velocity / self.full_minus, self._deadband_minus, -1.0
        if share >= 1.0:
            self._last, self._ahead = side, side * self._half
            return 100.0 * side * self._sign
        if share > LINEAR_SHARE:
            metered: float = share**self._inverse
            spool = side * (deadband + (self._range - deadband) * metered)
        else:
            spool = side * share * (deadband / LINEAR_SHARE + (self._range - deadband) * self._linear)
        half, ahead = self._half, self._ahead + LEAD_GAIN * (spool - self._last)
        self._last, self._ahead = spool, (half if ahead > half else -half if ahead < -half else ahead)
        # Inside the dead-band nothing moves: there the lead fades, so that it never turns the sign.
        rim = max(deadband, 2.0 * half)
        inside = abs(spool) / rim if abs(spool) < rim else 1.0
        return 100.0 * self._sign * (spool + self._ahead * inside)
