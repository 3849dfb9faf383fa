"""Load change: does something take up or let go a weight, so that every joint moves on its oil and steel?

A log that touches the ground, hangs in a heap, catches at a stake or comes to rest in the bunk pushes the boom, and
springs it when it comes free.  The load cell shows it: the load leaves its mean of the last second.  Measured on a
sampled forwarder: a carried log of 93 kg caught (0 to 837 kg within half a second), held the slew at an eighth of its
speed and threw it on at twice the speed of its valve; logs that came to rest took 620 kg off the lift within 3 s and
sank it by 5 mrad with shut valves.  Monitors that compare a joint with its valve allow for it
(`controller.joint_watch`, `controller.valve_watch`).
"""

from __future__ import annotations

from typing import Final

CHANGE_KG: Final = 40.0
"""Least difference from the load's mean that is a change: twice what friction of the lift falsifies, ..."""
CHANGE_SHARE: Final = 0.2
"""... and at least this share of the mean: a log that swings pulls by more than its weight and by less."""
MEAN_S: Final = 1.0
REST_NS: Final = 1_200_000_000
"""A joint comes to rest on its oil within half of its slowest period (2.5 s)."""


class LoadChange:
    """`step` with every estimate of the load, ``period_s`` apart; `recent` tells whether it changed lately."""

    __slots__ = ("_gain", "_mean_kg", "_until_ns")

    def __init__(self, period_s: float) -> None:
        self._gain = period_s / MEAN_S
        self._mean_kg = 0.0
        self._until_ns = 0

    def step(self, load_kg: float, now_ns: int) -> None:
        """The estimated load (NaN: not known, which is no change)."""
        if load_kg == load_kg:
            off_kg = load_kg - self._mean_kg
            if abs(off_kg) > max(CHANGE_KG, CHANGE_SHARE * self._mean_kg):
                self._until_ns = now_ns + REST_NS
            self._mean_kg += self._gain * off_kg

    def recent(self, now_ns: int) -> bool:
        """Whether the load changed up to `REST_NS` ago."""
        return now_ns < self._until_ns
