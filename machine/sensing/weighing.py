"""What the lift cylinder carries: the moment from its pressures, that of the empty crane, and the load that is left.

The cylinder's friction is in every pressure: at rest it may hold up to its stiction either way (about 1 kNm, or 20 kg
at 5 m, 40 kg at 3 m), so a load is known within that.  Whatever areas and arms the profile has
wrong scales all moments alike.
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
NEAREST_M: Final = 1.0
"""With the pin nearer to the boom pin nothing can be said of a load: friction is all that the cylinder feels."""


def lever_share(valve: Valve, position: float) -> float:
    """Arm of the cylinder at a joint position, as a share of the nominal one."""
    at, lever = valve.lever_at, valve.lever
    if not at:
        return 1.0
    i = bisect_right(at, position)
    if i == 0 or i == len(at):
        return lever[0 if i == 0 else -1]
    share = (position - at[i - 1]) / (at[i] - at[i - 1])
    return lever[i - 1] + share * (lever[i] - lever[i - 1])


def lift_moment_nm(profile: Profile, lift_rad: float, a_bar: float, b_bar: float) -> float:
    """Moment that the pressures of the lift cylinder's two sides hold, + against the weight; A pushes upward."""
    valve = joint(profile, Joint.LIFT).valve
    load_bar = a_bar - b_bar * valve.flow_minus / valve.flow_plus
    return load_bar * PA_PER_BAR * valve.flow_plus * lever_share(valve, lift_rad)


def empty_moment_nm(sag: Sag, kin: Kinematics, q: Sequence[float]) -> float:
    """Moment of the crane with its empty grapple at the lift joint, as its pressures showed it."""
    head, pin, _ = distances(kin, q)
    return sag.head_nm_m * (head - kin.a1_m) + sag.pin_nm_m * (pin - kin.a1_m)


def hanging_kg(sag: Sag | None, kin: Kinematics, q: Sequence[float], moment_nm: float) -> float:
    """Load in the grapple; NaN where the empty crane's moment is unknown or the pin is too near the boom pin."""
    if sag is None or not sag.pin_nm_m > 0.0:
        return math.nan
    ahead_m = distances(kin, q)[1] - kin.a1_m
    if not ahead_m >= NEAREST_M:
        return math.nan
    return (moment_nm - empty_moment_nm(sag, kin, q)) / (GRAVITY_M_S2 * ahead_m)
