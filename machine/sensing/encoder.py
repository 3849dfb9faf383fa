"""Encoder counts to joint position and back (CiA 406 objects 6001h, 6002h, 6004h).

Input is the profile's ``Encoder`` and the position object as sent (u32 rotary, i32 linear); output is rad or
m.  A rotary encoder counts modulo ``total_counts`` (6002h), so its position lies within half a range about
``zero_counts`` for every raw value.  Pure and total: every integer has a position; the caller checks plausibility.
"""

from __future__ import annotations

from machine.profile import Encoder


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
        """Joint position [rad, m for a linear encoder] of a raw position value."""
        delta = counts - self._zero
        if self._total:
            delta = (delta + self._half) % self._total - self._half
        return self._direction * delta * self._unit_per_count


def position_from_counts(encoder: Encoder, counts: int) -> float:
    """Joint position [rad, m for a linear encoder] of a raw position value."""
    return EncoderScale(encoder).position(counts)


def counts_from_position(encoder: Encoder, position: float) -> int:
    """The raw value nearest to a joint position: 0..total_counts-1 for a rotary encoder, signed for a linear one."""
    counts = encoder.zero_counts + round(encoder.direction * position / encoder.unit_per_count)
    return counts % encoder.total_counts if encoder.kind == "rotary" else counts
