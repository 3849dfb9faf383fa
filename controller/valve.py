"""Joint velocity to spool command [%], by the profile's valve map.

The command is the exact inverse of the rescaled dead-band of machines.md section 3::

    u = sign(w) (db + (1 - db) |w|)        w: share of the full speed on that side

Within 1 % of it the inverse is linear, so that noise around zero does not slam the spool across the dead-band.
"""

from __future__ import annotations

from typing import Final

from machine.profile import Valve

_LINEAR: Final = 0.01


class ValveMap:
    """One valve function."""

    __slots__ = ("_deadband_minus", "_deadband_plus", "_full_minus", "_full_plus", "_sign")

    def __init__(self, valve: Valve) -> None:
        self._sign = valve.sign
        self._deadband_plus = valve.deadband_plus_pct / 100.0
        self._deadband_minus = valve.deadband_minus_pct / 100.0
        self._full_plus, self._full_minus = valve.full_speed_plus, valve.full_speed_minus

    def spool_pct(self, velocity: float) -> float:
        """Spool command [%] in -100..100 for a joint velocity [rad/s or m/s]; saturates at full speed."""
        if velocity >= 0.0:
            share, deadband, sign = velocity / self._full_plus, self._deadband_plus, self._sign
        else:
            share, deadband, sign = -velocity / self._full_minus, self._deadband_minus, -self._sign
        if share >= 1.0:
            return 100.0 * sign
        edge = deadband + (1.0 - deadband) * max(share, _LINEAR)
        return 100.0 * sign * (edge if share > _LINEAR else edge * share / _LINEAR)

    def limit(self, velocity: float) -> float:
        """The velocity that the valve can give at most on that side."""
        return min(velocity, self._full_plus) if velocity >= 0.0 else max(velocity, -self._full_minus)
