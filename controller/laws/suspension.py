"""Heights of the swing arms: a proportional law per arm (paper B 3.2.4) with dead-band compensation of its valve.

An arm that came near enough is not controlled until it leaves the band.  The arms of a floating axle are left to their
float valve, which connects left and right.  Levelling raises the low side: slow integrators of roll and pitch add to
the wanted heights, as far as the arms' travel allows, and return to zero when levelling ends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from machine.geometry.carrier import ARMS
from machine.profile import Carrier, CarrierValve

N_ARMS: Final = len(ARMS)
NEAR_SHARE: Final = 1.0 / 3.0
"""An arm is brought within this share of the band, and is not controlled within the whole band."""
LEVEL_GAIN_1_S: Final = 0.4
"""Share of the height error of a tilt that is corrected per second."""
MAX_LEVEL_M_S: Final = 0.03
"""Greatest rate of a correction."""
LEVEL_BAND_RAD: Final = 0.005
"""A tilt within this counts as level."""
_LEFT: Final = (1.0, -1.0, 1.0, -1.0)
_FRONT: Final = (1.0, 1.0, -1.0, -1.0)


def spool_pct(valve: CarrierValve, speed: float) -> float:
    """Compute the spool command [%] of a carrier's valve for a speed [unit/s]: its dead-band inverted, 0 for 0."""
    if speed == 0.0:
        return 0.0
    plus = speed > 0.0
    dead = (valve.deadband_plus_pct if plus else valve.deadband_minus_pct) / 100.0
    share = min(1.0, abs(speed) / (valve.full_speed_plus if plus else valve.full_speed_minus))
    return 100.0 * (dead + (1.0 - dead) * share) * (1.0 if plus else -1.0)


class Levelling:
    """``roll_m`` and ``pitch_m``: how far the left arms and the front arms are raised beyond their wanted heights."""

    __slots__ = ("_base_m", "_track_m", "pitch_m", "roll_m")

    def __init__(self, carrier: Carrier) -> None:
        self._track_m = carrier.track_width_m
        self._base_m = carrier.front_axle_m + carrier.rear_axle_m
        self.roll_m = self.pitch_m = 0.0

    def reset(self) -> None:
        """Reset to no correction."""
        self.roll_m = self.pitch_m = 0.0

    def step(self, wanted: bool, roll_rad: float, pitch_rad: float, elapsed_s: float) -> None:
        """Run one tick; roll is + right side down, pitch + nose up, NaN while unknown.

        Raising the left arms by h and lowering the right ones by h rolls by 2 h over the track, to the right.
        """
        if wanted:
            roll_m = _integrate(-0.5 * self._track_m, roll_rad, elapsed_s)
            pitch_m = _integrate(-0.5 * self._base_m, pitch_rad, elapsed_s)
        else:
            roll_m, pitch_m = _return_to_zero(self.roll_m, elapsed_s), _return_to_zero(self.pitch_m, elapsed_s)
        self.roll_m += roll_m
        self.pitch_m += pitch_m


def _integrate(metres_per_rad: float, tilt_rad: float, elapsed_s: float) -> float:
    if not abs(tilt_rad) > LEVEL_BAND_RAD:
        return 0.0
    rate = LEVEL_GAIN_1_S * metres_per_rad * math.sin(tilt_rad)
    return min(max(rate, -MAX_LEVEL_M_S), MAX_LEVEL_M_S) * elapsed_s


def _return_to_zero(correction_m: float, elapsed_s: float) -> float:
    return -math.copysign(min(abs(correction_m), MAX_LEVEL_M_S * elapsed_s), correction_m)


class Suspension:
    """Four arms; ``spools_pct`` are the commands and ``wanted_m`` the wanted heights of this tick."""

    __slots__ = ("_c", "_near_m", "_resting", "levelling", "speeds_m_s", "spools_pct", "wanted_m")

    def __init__(self, carrier: Carrier) -> None:
        self._c = carrier
        self._near_m = NEAR_SHARE * carrier.arm_in_band_m
        self._resting = [True] * N_ARMS
        self.levelling = Levelling(carrier)
        self.wanted_m = [math.nan] * N_ARMS
        self.speeds_m_s = [0.0] * N_ARMS
        self.spools_pct = [0.0] * N_ARMS

    def hold(self) -> None:
        """Keep all arms where they are."""
        for i in range(N_ARMS):
            self.spools_pct[i] = self.speeds_m_s[i] = 0.0
            self.wanted_m[i] = math.nan
            self._resting[i] = True
        self.levelling.reset()

    def step(
        self,
        wanted_m: Sequence[float],
        heights_m: Sequence[float],
        level: bool,
        tilt_rad: tuple[float, float],
        floats: tuple[bool, bool],
        cap: float,
        elapsed_s: float,
    ) -> None:
        """Run one tick with wanted and measured heights (an arm of unknown height, NaN, stays).

        ``level``: whether to level by ``tilt_rad`` (roll, pitch); ``floats``: which axles float now; ``cap`` scales the
        speed limit.
        """
        levelling, travel_m = self.levelling, self._c.arm_travel_m
        levelling.step(level, tilt_rad[0], tilt_rad[1], elapsed_s)
        self._limit_corrections(wanted_m, travel_m)
        for i in range(N_ARMS):
            corrected = wanted_m[i] + _LEFT[i] * levelling.roll_m + _FRONT[i] * levelling.pitch_m
            self.wanted_m[i] = min(max(corrected, 0.0), travel_m)
            self.speeds_m_s[i] = speed = 0.0 if floats[i // 2] else self._speed(i, heights_m[i], cap)
            self.spools_pct[i] = spool_pct(self._c.arm_valve, speed)

    def _limit_corrections(self, wanted_m: Sequence[float], travel_m: float) -> None:
        """Limit the corrections where an arm is at the end of its travel (anti-windup)."""
        levelling = self.levelling
        room = min(min(wanted_m), travel_m - max(wanted_m))
        total = abs(levelling.roll_m) + abs(levelling.pitch_m)
        most = max(room, 0.5 * travel_m)
        if total > most:
            levelling.roll_m *= most / total
            levelling.pitch_m *= most / total

    def _speed(self, i: int, height_m: float, cap: float) -> float:
        error = self.wanted_m[i] - height_m
        if error != error:
            self._resting[i] = True
            return 0.0
        band = self._c.arm_in_band_m if self._resting[i] else self._near_m
        self._resting[i] = abs(error) <= band
        if self._resting[i]:
            return 0.0
        limit = cap * self._c.arm_rate_limit_m_s
        return min(max(self._c.arm_kp_1_s * error, -limit), limit)
