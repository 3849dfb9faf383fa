"""Weighs the load by the lift cylinder: its moment from the pressures, less that of the empty crane.

The pressures include the cylinder's friction: at rest it may hold up to its stiction in either direction (about 1 kNm,
or 20 kg at 5 m, 40 kg at 3 m), which limits the accuracy.  Errors of areas and lever arms in the profile scale all
moments alike.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import Final

from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.joints import Joint
from machine.profile import Kinematics, Profile, Sag, Valve, joint

PA_PER_BAR: Final = 1e5
MIN_LEVER_ARM_M: Final = 1.0
"""With the pin closer to the boom pin the load cannot be determined: friction dominates."""


def lever_share(valve: Valve, position: float) -> float:
    """Lever arm of the cylinder at a joint position, as a share of the nominal one."""
    at, lever = valve.lever_at, valve.lever
    if not at:
        return 1.0
    i = bisect_right(at, position)
    if i == 0 or i == len(at):
        return lever[0 if i == 0 else -1]
    share = (position - at[i - 1]) / (at[i] - at[i - 1])
    return lever[i - 1] + share * (lever[i] - lever[i - 1])


def lift_moment_nm(profile: Profile, lift_rad: float, a_bar: float, b_bar: float) -> float:
    """Moment of the lift cylinder from the pressures of its two sides [Nm], + against the weight; A pushes upward."""
    valve = joint(profile, Joint.LIFT).valve
    load_bar = a_bar - b_bar * valve.flow_minus / valve.flow_plus
    return load_bar * PA_PER_BAR * valve.flow_plus * lever_share(valve, lift_rad)


def empty_moment_nm(sag: Sag, kin: Kinematics, q: Sequence[float]) -> float:
    """Moment of the crane with an empty grapple at the lift joint [Nm], as calibrated from its pressures."""
    head, pin, _ = distances(kin, q)
    return sag.head_nm_m * (head - kin.a1_m) + sag.pin_nm_m * (pin - kin.a1_m)


def hanging_load_kg(sag: Sag | None, kin: Kinematics, q: Sequence[float], moment_nm: float) -> float:
    """Load in the grapple [kg]; NaN if the empty crane's moment is unknown or the pin is too close to the boom pin."""
    if sag is None or not sag.pin_nm_m > 0.0:
        return math.nan
    ahead_m = distances(kin, q)[1] - kin.a1_m
    if not ahead_m >= MIN_LEVER_ARM_M:
        return math.nan
    return (moment_nm - empty_moment_nm(sag, kin, q)) / (GRAVITY_M_S2 * ahead_m)
