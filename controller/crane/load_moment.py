"""Does the machine bear load, reach and slope together?  (docs/reference/safety.md cases 21 and 43)

The moment about the tipping line, at `Stability.edge_m` from the slew axis in the direction of the boom [Nm]::

    g (load (r_pin - edge) + pin (r_pin - edge) + head (r_head - edge)) + slope_nm_rad * slope

against ``share`` of the stabilising moment.  ``pin`` and ``head`` are the weights of the empty crane as they act at
hanger pin and stick pin, ``slope`` is how much the ground falls in the direction of the boom [rad].  One edge serves
all directions: it is the nearest one, so along the machine the judgement is on the safe side.  The load is that of the
load cell or of `controller.estimation.load_estimator`; an unknown load (NaN) counts as none, and then only crane and
slope are judged.  50 times a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from typing import Final

from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.joints import N_JOINTS, Joint
from machine.profile import Profile, Stability

CONFIRMATIONS: Final = 2
"""Judgements in a row that make an overload: a peak of a swinging load lasts less than one period of them, 20 ms."""
RELEASE_SHARE: Final = 0.97
"""The overload is over below this share of the limit."""
TOLERANCE_M: Final = 0.005
"""A trajectory may lead this much outward or up: the knots of a hold differ by rounding."""
AHEAD_S: Final = 0.1
AHEAD_TOLERANCE_M: Final = 0.0005
"""A motion is judged by where it leads to within this time; slower than 5 mm/s counts as rest."""


class LoadMoment:
    """The judgement of one machine: ``overloaded`` now; the moment that was judged last, and its limit [Nm]."""

    __slots__ = ("_above", "_ahead", "_kinematics", "_stability", "_yaw_rad", "last_nm", "limit_nm", "overloaded")

    def __init__(self, profile: Profile, stability: Stability) -> None:
        self._kinematics, self._stability = profile.kinematics, stability
        yaw_rad = 0.0 if profile.carrier is None else profile.carrier.crane_yaw_rad
        self._yaw_rad = yaw_rad + profile.kinematics.theta1_offset_rad
        self.limit_nm = stability.share * stability.stabilising_nm
        self.last_nm = 0.0
        self._above = 0
        self._ahead = [0.0] * N_JOINTS
        self.overloaded = False

    def update(self, position: Sequence[float], load_kg: float, roll_rad: float, pitch_rad: float) -> None:
        """Judge joint positions, load and inclination (+ right side down, + nose up; 0 where it is not measured)."""
        moment_nm = self.last_nm = self.moment_nm(position, load_kg, roll_rad, pitch_rad)
        limit_nm = RELEASE_SHARE * self.limit_nm if self.overloaded else self.limit_nm
        # A moment that is not known (NaN) is no overload: the encoders' own checks stop the machine.
        self._above = self._above + 1 if moment_nm > limit_nm else 0
        self.overloaded = self._above >= CONFIRMATIONS or (self.overloaded and self._above > 0)

    def moment_nm(self, position: Sequence[float], load_kg: float, roll_rad: float, pitch_rad: float) -> float:
        """Moment about the tipping line [Nm]; NaN while a joint is unknown."""
        of = self._stability
        head_m, pin_m, _ = distances(self._kinematics, position)
        hanging_kg = of.pin_kg + (load_kg if load_kg > 0.0 else 0.0)
        level_nm = GRAVITY_M_S2 * (hanging_kg * (pin_m - of.edge_m) + of.head_kg * (head_m - of.edge_m))
        if roll_rad != roll_rad or pitch_rad != pitch_rad:
            return level_nm
        direction = position[Joint.SLEW] + self._yaw_rad
        falls_rad = -pitch_rad * cos(direction) - roll_rad * sin(direction)
        return level_nm + of.slope_nm_rad * falls_rad

    def raised_by_motion(self, position: Sequence[float], velocity: Sequence[float]) -> bool:
        """Whether a motion leads outward or up [rad, m; per second]."""
        ahead = self._ahead
        for j in range(N_JOINTS):
            ahead[j] = position[j] + AHEAD_S * velocity[j]
        return self.raised(position, ahead, AHEAD_TOLERANCE_M)

    def refuses(self, start: Sequence[float], end: Sequence[float]) -> bool:
        """Whether the machine is overloaded and a trajectory between two joint positions would add to it."""
        return self.overloaded and self.raised(start, end)

    def raised(self, start: Sequence[float], end: Sequence[float], tolerance_m: float = TOLERANCE_M) -> bool:
        """Whether the pin goes outward between two joint positions, or rises by more than it comes nearer."""
        _, start_m, start_z_m = distances(self._kinematics, start)
        _, end_m, end_z_m = distances(self._kinematics, end)
        out_m = end_m - start_m
        return out_m > tolerance_m or end_z_m - start_z_m > tolerance_m - min(out_m, 0.0)
