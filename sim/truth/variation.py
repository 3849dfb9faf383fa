"""Variation between individual machines: how far one may differ from the nominal machine, and its bounded draws."""

from __future__ import annotations

import random
from typing import Final

import msgspec

SIGMA_SHARE: Final = 0.5
"""Sigma of a draw as a share of its bound; draws beyond the bound are cut to it."""


class Variation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bounds about the nominal values: relative ones as fractions, others with their unit.

    docs/reference/machines.md section 14.

    ``offset`` is the zero error of an encoder [rad, m], ``antenna_m`` the distance of an antenna from its nominal
    place; delays are drawn between their two bounds, most often near the nominal one.
    """

    mass: float
    flexibility: float
    friction: float
    deadband: float
    gain: float
    hysteresis: float
    delay_min_s: float
    delay_max_s: float
    pump: float
    bulk: float
    offset: float
    eccentricity: float
    antenna_m: float


class VariationSampler:
    """Bounded random numbers for one part of the truth; each part draws from its own seed."""

    def __init__(self, spread: Variation, part: str, seed: int) -> None:
        self.spread = spread
        self.rng = random.Random(f"truth {part} {seed}")

    def within(self, bound: float) -> float:
        """Draw a number in -bound..bound, more often near 0."""
        return bound * max(-1.0, min(1.0, self.rng.gauss(0.0, SIGMA_SHARE)))

    def factor(self, bound: float) -> float:
        """Draw a factor in 1-bound..1+bound."""
        return 1.0 + self.within(bound)

    def delay(self, nominal_s: float) -> float:
        """Draw a dead time [s] between the two bounds; a function without dead time keeps none."""
        s = self.spread
        return self.rng.triangular(s.delay_min_s, s.delay_max_s, nominal_s) if nominal_s else 0.0

    def log_uniform(self, low: float, high: float) -> float:
        """Draw a number in low..high, both positive; equal ratios are equally likely."""
        return float(low * (high / low) ** self.rng.random())
