"""From raw readings to quantities: encoder counts to joint positions, lift pressures to a load, a load to a moment."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import Final

from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.joints import Joint
from machine.profile import Encoder, Kinematics, Profile, Sag, Stability, Valve, joint

# -- Encoder counts to joint position and back (CiA 406 objects 6001h, 6002h, 6004h).
#
# Input is the profile's ``Encoder`` and the position object as sent (u32 rotary, i32 linear); output is rad or m.
# A rotary encoder counts modulo ``total_counts`` (6002h), so its position lies within half a range about
# ``zero_counts`` for every raw value.  Pure and total: every integer has a position; the caller checks
# plausibility.


class EncoderScale:
    """`position_from_counts` of one encoder, with its numbers at hand for every tick."""

    __slots__ = ("_direction", "_half", "_total", "_unit_per_count", "_zero")

    def __init__(self, encoder: Encoder) -> None:
        self._zero, self._direction, self._unit_per_count = (
            encoder.zero_counts,
            encoder.direction,
            encoder.unit_per_count,
        )
        self._total = encoder.total_counts if encoder.kind == "rotary" else 0
        self._half = self._total // 2

    def position(self, counts: int) -> float:
        """Compute the joint position [rad, m for a linear encoder] of a raw position value."""
        delta = counts - self._zero
        if self._total:
            delta = (delta + self._half) % self._total - self._half
        return self._direction * delta * self._unit_per_count


def position_from_counts(encoder: Encoder, counts: int) -> float:
    """Compute the joint position [rad, m for a linear encoder] of a raw position value."""
    return EncoderScale(encoder).position(counts)


def counts_from_position(encoder: Encoder, position: float) -> int:
    """Compute the raw value nearest to a joint position: 0..total_counts-1 for rotary, signed for linear encoders."""
    counts = encoder.zero_counts + round(encoder.direction * position / encoder.unit_per_count)
    return counts % encoder.total_counts if encoder.kind == "rotary" else counts


# -- Weighs the load by the lift cylinder: its moment from the pressures, less that of the empty crane.
#
# The pressures include the cylinder's friction: at rest it may hold up to its stiction in either direction (about 1
# kNm, or 20 kg at 5 m, 40 kg at 3 m), which limits the accuracy.  Errors of areas and lever arms in the profile
# scale all moments alike.

PA_PER_BAR: Final = 1e5
MIN_LEVER_ARM_M: Final = 1.0
"""With the pin closer to the boom pin the load cannot be determined: friction dominates."""


def lever_share(valve: Valve, position: float) -> float:
    """Compute the lever arm of the cylinder at a joint position, as a share of the nominal one."""
    at, lever = valve.lever_at, valve.lever
    if not at:
        return 1.0
    i = bisect_right(at, position)
    if i == 0 or i == len(at):
        return lever[0 if i == 0 else -1]
    share = (position - at[i - 1]) / (at[i] - at[i - 1])
    return lever[i - 1] + share * (lever[i] - lever[i - 1])


def lift_moment_nm(profile: Profile, lift_rad: float, a_bar: float, b_bar: float) -> float:
    """Compute the lift cylinder's moment from its two pressures [Nm], + against the weight; A pushes upward."""
    valve = joint(profile, Joint.LIFT).valve
    load_bar = a_bar - b_bar * valve.flow_minus / valve.flow_plus
    return load_bar * PA_PER_BAR * valve.flow_plus * lever_share(valve, lift_rad)


def empty_moment_nm(sag: Sag, kin: Kinematics, q: Sequence[float]) -> float:
    """Compute the moment of the crane with empty grapple at the lift joint [Nm], calibrated from its pressures."""
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


# -- What the machine bears: the moment of crane and load about the tipping line (`machine.profile.Stability`).


def level_moment_nm(of: Stability, kin: Kinematics, q: Sequence[float], load_kg: float) -> float:
    """Compute the moment of the crane with a load in its grapple about the tipping line, on level ground [Nm]."""
    head_m, pin_m, _ = distances(kin, q)
    return GRAVITY_M_S2 * ((of.pin_kg + load_kg) * (pin_m - of.edge_m) + of.head_kg * (head_m - of.edge_m))


def bearable_load_kg(of: Stability, kin: Kinematics, q: Sequence[float], falls_rad: float = 0.0) -> float:
    """Compute the greatest load that the machine bears with its joints at ``q`` [kg], 0 where it bears none.

    ``falls_rad``: how much the ground falls in the direction of the boom.
    """
    left_nm = of.share * of.stabilising_nm - of.slope_nm_rad * falls_rad - level_moment_nm(of, kin, q, 0.0)
    arm_m = max(distances(kin, q)[1] - of.edge_m, MIN_LEVER_ARM_M)
    return max(left_nm / (GRAVITY_M_S2 * arm_m), 0.0)
