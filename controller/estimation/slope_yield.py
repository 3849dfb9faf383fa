"""How far the slew may yield on its oil because the machine leans, although its valve is shut.

On ground that falls across the boom, gravity turns the slew; the oil holds it like a spring.  A crane of mass m at
reach r that swings on this oil with w has the stiffness m r^2 w^2, and leans against it with m g r sin(lean): it yields
by g sin(lean) / (r w^2), 0.2 rad for each radian far out (7.5 m, a period of 2.5 s), and swings as far again.  So a
slew yields when the lean changes, as a wheel climbs a stump, and on a slope when a log is lifted: 110 kg at 7.5 m on 10
degrees are 1.4 kNm, which turned it by 7 mrad within a second (measured on the plant).  Jaws that close about a log
pull it likewise.  On level ground there is nothing to yield to, and nothing changes.
"""

from __future__ import annotations

from typing import Final

FORGET_S: Final = 2.0
"""The range of the last inclinations shrinks with this time constant."""
LEVEL_RAD: Final = 0.02
"""An inclination, or a change of it, below this is none: noise of the sensor, and tyres that give."""
YIELD_SHARE: Final = 0.4
"""Yield for each radian of lean, with its swing."""
LIMIT_RAD: Final = 0.06


class SlopeYield:
    """`step` once per period; ``rad`` is how far the slew may yield now."""

    __slots__ = ("_forget", "_high", "_low", "rad")

    def __init__(self, period_s: float) -> None:
        self._forget = period_s / FORGET_S
        self._low = [0.0, 0.0]
        self._high = [0.0, 0.0]
        self.rad = 0.0

    def step(self, pressed: bool, roll_rad: float, pitch_rad: float) -> None:
        """Whether jaws or a load press on the boom, or did lately; the inclination of its base (NaN: not known)."""
        turned = self._range(0, roll_rad) + self._range(1, pitch_rad)
        if pressed:
            turned += self._beyond_level(abs(roll_rad)) + self._beyond_level(abs(pitch_rad))
        self.rad = min(YIELD_SHARE * turned, LIMIT_RAD)

    def _beyond_level(self, angle_rad: float) -> float:
        return angle_rad - LEVEL_RAD if angle_rad > LEVEL_RAD else 0.0

    def _range(self, axis: int, angle_rad: float) -> float:
        """How far the machine has leaned to and fro about an axis lately."""
        if angle_rad != angle_rad:
            return 0.0
        low, high, forget = self._low, self._high, self._forget
        low[axis] = min(angle_rad, low[axis] + forget * (angle_rad - low[axis]))
        high[axis] = max(angle_rad, high[axis] + forget * (angle_rad - high[axis]))
        return self._beyond_level(high[axis] - low[axis])
