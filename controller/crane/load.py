"""The load in the grapple: how heavy it is, whether it comes or goes, and whether the machine bears it.

`LoadEstimator` weighs it by the lift's pressures where no load cell does, `LoadChange` tells monitors of joints when it
pushes or springs the boom, and `LoadMoment` judges load, reach and slope together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from math import cos, sin
from typing import Final

from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.joints import N_JOINTS, Joint
from machine.profile import Profile, Stability, joint
from machine.sensing import (
    MIN_LEVER_ARM_M,
    PA_PER_BAR,
    empty_moment_nm,
    hanging_load_kg,
    level_moment_nm,
    lever_share,
    lift_moment_nm,
)

FILTER_S: Final = 0.8
STEADY_S: Final = 0.3
STEADY_SHARE: Final = 0.04
"""A lift is steady while its speed differs by less than this share of its speed limit from its mean over `STEADY_S`."""


class LoadEstimator:
    """Filtered load [kg] by the pressures of the lift cylinder, on a machine without a load cell; NaN while unknown.

    The moment held by the cylinder less that of the empty crane (`machine.sensing`, both from calibration),
    divided by the pin's distance.  Only pressures of a lift that rests or moves steadily count; between them the last
    value is kept.  The cylinder's friction is an error of some 20 kg at 5 m, and more nearer by.  A swinging load is
    averaged over `FILTER_S`.  The estimate is updated 50 times a second, not in every tick.
    """

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
        unsteady = velocity - self._slow
        self._slow += unsteady * min(1.0, elapsed_s / STEADY_S)
        if abs(unsteady) > self._steady:
            return self._kg
        moment_nm = lift_moment_nm(profile, position[Joint.LIFT], a_bar, b_bar)
        kg = hanging_load_kg(profile.sag, profile.kinematics, position, moment_nm)
        if kg == kg:
            before = kg if self._kg != self._kg else self._kg
            self._kg = max(0.0, before + (kg - before) * min(1.0, elapsed_s / FILTER_S))
        return self._kg


def _carrying_joints_known(position: Sequence[float]) -> bool:
    """Tell whether the joints that carry the load are known; the rotator does not matter."""
    return not any(math.isnan(position[j]) for j in range(N_JOINTS - 1))


# -- Load change: does something take up or let go a weight, so that every joint moves on its oil and steel?
#
# A log that touches the ground, hangs in a heap, catches at a stake or comes to rest in the bunk pushes the boom, and
# springs it when it comes free.  The load cell shows it: the load leaves its mean of the last second.  Measured on a
# sampled forwarder: a carried log of 93 kg caught (0 to 837 kg within half a second), held the slew at an eighth of its
# speed and threw it on at twice the speed of its valve; logs that came to rest took 620 kg off the lift within 3 s and
# sank it by 5 mrad with shut valves.  Monitors that compare a joint with its valve allow for it
# (`controller.joint_watch`, `controller.valve_watch`).

CHANGE_KG: Final = 40.0
"""Least difference from the load's mean that is a change: twice what friction of the lift falsifies, ..."""
CHANGE_SHARE: Final = 0.2
"""... and at least this share of the mean: a log that swings pulls by more than its weight and by less."""
CHANGE_MEAN_S: Final = 1.0
CHANGE_REST_NS: Final = 1_200_000_000
"""A joint comes to rest on its oil within half of its slowest period (2.5 s)."""


class LoadChange:
    """`step` with every estimate of the load, ``period_s`` apart; `recent` tells whether it changed lately."""

    __slots__ = ("_gain", "_mean_kg", "_until_ns")

    def __init__(self, period_s: float) -> None:
        self._gain = period_s / CHANGE_MEAN_S
        self._mean_kg = 0.0
        self._until_ns = 0

    def step(self, load_kg: float, now_ns: int) -> None:
        """Take the estimated load (NaN: not known, which is no change)."""
        if load_kg == load_kg:
            off_kg = load_kg - self._mean_kg
            if abs(off_kg) > max(CHANGE_KG, CHANGE_SHARE * self._mean_kg):
                self._until_ns = now_ns + CHANGE_REST_NS
            self._mean_kg += self._gain * off_kg

    def recent(self, now_ns: int) -> bool:
        """Tell whether the load changed up to `CHANGE_REST_NS` ago."""
        return now_ns < self._until_ns


# -- Load moment: does the machine bear load, reach and slope together?  (docs/reference/safety.md cases 21 and 43)
#
# The moment about the tipping line, at `Stability.edge_m` from the slew axis in the direction of the boom [Nm]::
#
#     g (load (r_pin - edge) + pin (r_pin - edge) + head (r_head - edge)) + slope_nm_rad * slope
#
# against ``share`` of the stabilising moment.  ``pin`` and ``head`` are the weights of the empty crane as they act at
# hanger pin and stick pin, ``slope`` is how much the ground falls in the direction of the boom [rad].  One edge serves
# all directions: it is the nearest one, so along the machine the judgement is on the safe side.
#
# Two judgements make an overload.  The slow one, 50 times a second, takes the load of the load cell or of
# `LoadEstimator`; an unknown load (NaN) counts as none, and then only crane and slope are judged.  The fast one takes
# every pressure frame of the lift: the moment that its oil holds, less that of the empty crane, is the load's, and it
# is judged where it will be after `LEAD_S` at its present rise.  A load that appears at once falls with the crane at
# first and presses on the machine only as fast as it compresses the oil.  In the plant with physics 1500 to 3000 kg
# exceed 36 kNm at 4 m after 220 to 240 ms, and are seen after 180 to 200 ms.  Earlier there is nothing to see: after 50
# ms 3000 kg have raised the lift's pressure by 7 bar, 200 kg by 3.4 bar and 500 kg by 5 bar, and the moment rises by 40
# kNm/s, as it does when a log is lifted or the lift starts (40 kNm/s, and 52 kNm/s on the larger crane).  Ordinary work
# and calibrations come to 0.55 of the limit with their rise counted; `PRESSURE_SHARE` is twice that.

CONFIRMATIONS: Final = 2
"""Judgements in a row that make an overload: a peak of a swinging load lasts less than one period of them, 20 ms."""
RELEASE_SHARE: Final = 0.97
"""The overload is over below this share of the limit."""
LEAD_S: Final = 0.1
"""The moment is judged where it will be when a valve can have answered: dead time 80 ms, half of the spool's lag."""
PRESSURE_SHARE: Final = 1.1
"""By the pressures the limit is exceeded beyond this share of it: piston areas, lever arms and weights in a profile are
good for 5 %, and the cylinder's friction is 1 kNm or 3 %."""
PRESSURE_RISE_NS: Final = 10_000_000
PRESSURE_GAP_NS: Final = 50_000_000
"""The rise is that over three frames, which come every 5 ms; closer or farther apart than this they tell none."""
PRESSURE_HOLD_NS: Final = 500_000_000
"""An overload by the pressures lasts so long at least: the load swings on the oil at 2 Hz or faster."""
TOLERANCE_M: Final = 0.005
"""A trajectory may lead this much outward or up: the knots of a hold differ by rounding."""
AHEAD_S: Final = 0.1
AHEAD_TOLERANCE_M: Final = 0.0005
"""A motion is judged by where it leads to within this time; slower than 5 mm/s counts as rest."""


class LoadMoment:
    """The judgement of one machine: ``overloaded`` now; the moment that was judged last, and its limit [Nm]."""

    __slots__ = (
        "_above",
        "_ahead",
        "_empty_bar_nm",
        "_frames_above",
        "_heavy",
        "_kinematics",
        "_lift_valve",
        "_nm_1",
        "_nm_2",
        "_nm_3",
        "_ns_1",
        "_ns_2",
        "_ns_3",
        "_per_bar_nm",
        "_pressed",
        "_pressed_ns",
        "_sag",
        "_stability",
        "_yaw_rad",
        "last_nm",
        "limit_nm",
        "overloaded",
    )

    def __init__(self, profile: Profile, stability: Stability) -> None:
        self._kinematics, self._stability = profile.kinematics, stability
        yaw_rad = 0.0 if profile.carrier is None else profile.carrier.crane_yaw_rad
        self._yaw_rad = yaw_rad + profile.kinematics.theta1_offset_rad
        self.limit_nm = stability.share * stability.stabilising_nm
        self.last_nm = 0.0
        self._sag, self._lift_valve = profile.sag, joint(profile, Joint.LIFT).valve
        self._above = self._frames_above = self._pressed_ns = 0
        self._heavy = self._pressed = False
        self._empty_bar_nm = self._per_bar_nm = math.nan
        self._nm_1 = self._nm_2 = self._nm_3 = math.nan
        self._ns_1 = self._ns_2 = self._ns_3 = 0
        self._ahead = [0.0] * N_JOINTS
        self.overloaded = False

    def update(self, position: Sequence[float], load_kg: float, roll_rad: float, pitch_rad: float) -> None:
        """Judge joint positions, load and inclination (+ right side down, + nose up; 0 where it is not measured)."""
        moment_nm = self.moment_nm(position, load_kg, roll_rad, pitch_rad)
        limit_nm = RELEASE_SHARE * self.limit_nm if self._heavy else self.limit_nm
        # A moment that is not known (NaN) is no overload: the encoders' own checks stop the machine.
        self._above = self._above + 1 if moment_nm > limit_nm else 0
        self._heavy = self._above >= CONFIRMATIONS or (self._heavy and self._above > 0)
        self.overloaded = self._heavy or self._pressed
        if self._heavy or not self._pressed:
            self.last_nm = moment_nm
        self._prepare(position, roll_rad, pitch_rad)

    def _prepare(self, position: Sequence[float], roll_rad: float, pitch_rad: float) -> None:
        """Compute what judging the pressures needs of the geometry until the next call; it changes 5 mm meanwhile."""
        kin, of = self._kinematics, self._stability
        head_m, pin_m, _ = distances(kin, position)
        ahead_m = pin_m - kin.a1_m
        if not ahead_m >= MIN_LEVER_ARM_M:
            self._per_bar_nm = math.nan  # with the pin so near friction dominates
            return
        if self._sag is not None and self._sag.pin_nm_m > 0.0:
            empty_nm = empty_moment_nm(self._sag, kin, position)
        else:
            empty_nm = GRAVITY_M_S2 * (of.pin_kg * ahead_m + of.head_kg * (head_m - kin.a1_m))
        share = (pin_m - of.edge_m) / ahead_m
        lift = self._lift_valve
        self._per_bar_nm = share * PA_PER_BAR * lift.flow_plus * lever_share(lift, position[Joint.LIFT])
        self._empty_bar_nm = self.moment_nm(position, 0.0, roll_rad, pitch_rad) - share * empty_nm

    def update_pressure(self, load_bar: float, stamp_ns: int) -> None:
        """Judge a new pressure frame: the pressure in the lift's pushing chamber that alone would hold the load."""
        now_nm = self._empty_bar_nm + self._per_bar_nm * load_bar
        lead_nm, past_ns = now_nm, stamp_ns - self._ns_3
        if PRESSURE_RISE_NS <= past_ns <= PRESSURE_GAP_NS and now_nm > self._nm_3:
            lead_nm += LEAD_S * (now_nm - self._nm_3) / (1e-9 * past_ns)
        self._nm_3, self._nm_2, self._nm_1 = self._nm_2, self._nm_1, now_nm
        self._ns_3, self._ns_2, self._ns_1 = self._ns_2, self._ns_1, stamp_ns
        self._frames_above = self._frames_above + 1 if lead_nm > PRESSURE_SHARE * self.limit_nm else 0
        if self._frames_above >= CONFIRMATIONS:
            self._pressed, self._pressed_ns, self.last_nm = True, stamp_ns, lead_nm
        elif self._pressed and stamp_ns - self._pressed_ns > PRESSURE_HOLD_NS:
            self._pressed = now_nm > RELEASE_SHARE * self.limit_nm
        self.overloaded = self._heavy or self._pressed

    def moment_nm(self, position: Sequence[float], load_kg: float, roll_rad: float, pitch_rad: float) -> float:
        """Compute the moment about the tipping line [Nm]; NaN while a joint is unknown."""
        level_nm = level_moment_nm(self._stability, self._kinematics, position, load_kg if load_kg > 0.0 else 0.0)
        if roll_rad != roll_rad or pitch_rad != pitch_rad:
            return level_nm
        direction = position[Joint.SLEW] + self._yaw_rad
        falls_rad = -pitch_rad * cos(direction) - roll_rad * sin(direction)
        return level_nm + self._stability.slope_nm_rad * falls_rad

    def raised_by_motion(self, position: Sequence[float], velocity: Sequence[float]) -> bool:
        """Tell whether a motion leads outward or up [rad, m; per second]."""
        ahead = self._ahead
        for j in range(N_JOINTS):
            ahead[j] = position[j] + AHEAD_S * velocity[j]
        return self.raised(position, ahead, AHEAD_TOLERANCE_M)

    def raised(self, start: Sequence[float], end: Sequence[float], tolerance_m: float = TOLERANCE_M) -> bool:
        """Tell whether the pin goes outward between two joint positions, or rises by more than it comes nearer."""
        _, start_m, start_z_m = distances(self._kinematics, start)
        _, end_m, end_z_m = distances(self._kinematics, end)
        out_m = end_m - start_m
        return out_m > tolerance_m or end_z_m - start_z_m > tolerance_m - min(out_m, 0.0)
