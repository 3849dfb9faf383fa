"""Load in the grapple by the pressures of the lift cylinder, on a machine without a load cell.

The moment held by the cylinder less that of the empty crane (`machine.sensing.weighing`, both from calibration),
divided by the pin's distance.  Only pressures of a lift that rests or moves steadily count; between them the last value
is kept.  The cylinder's friction is an error of some 20 kg at 5 m, and more nearer by.  A swinging load is averaged
over `FILTER_S`.  The estimate is updated 50 times a second, not in every tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from machine.joints import N_JOINTS, Joint
from machine.profile import Profile, joint
from machine.sensing.weighing import hanging_load_kg, lift_moment_nm

FILTER_S: Final = 0.8
STEADY_S: Final = 0.3
STEADY_SHARE: Final = 0.04
"""A lift is steady while its speed differs by less than this share of its speed limit from its mean over `STEADY_S`."""


class LoadEstimator:
    """Filtered load [kg] of one machine; NaN while unknown."""

    __slots__ = ("_kg", "_profile", "_slow", "_steady")

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._steady = STEADY_SHARE * joint(profile, Joint.LIFT).speed_limit
        self._slow = 0.0
        self._kg = math.nan

    def step(
        self, position: Sequence[float], velocity: float, a_bar: float | None, b_bar: float | None, elapsed_s: float
    ) -> float:
        """Load [kg] from joint positions, the lift's velocity [rad/s] and its pressures [bar] (None: unknown)."""
        profile = self._profile
        if profile.sag is None or a_bar is None or b_bar is None or not _carrying_joints_known(position):
            self._slow, self._kg = 0.0, math.nan
            return math.nan
        off = velocity - self._slow
        self._slow += off * min(1.0, elapsed_s / STEADY_S)
        if abs(off) > self._steady:
            return self._kg
        moment_nm = lift_moment_nm(profile, position[Joint.LIFT], a_bar, b_bar)
        kg = hanging_load_kg(profile.sag, profile.kinematics, position, moment_nm)
        if kg == kg:
            before = kg if self._kg != self._kg else self._kg
            self._kg = max(0.0, before + (kg - before) * min(1.0, elapsed_s / FILTER_S))
        return self._kg


def _carrying_joints_known(position: Sequence[float]) -> bool:
    """Whether the joints that carry the load are known; the rotator does not matter."""
    return not any(math.isnan(position[j]) for j in range(N_JOINTS - 1))
