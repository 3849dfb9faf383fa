"""How far one machine may lie from the nominal one, and the bounded draws that make an individual."""

from __future__ import annotations

import random
from typing import Final

import msgspec

SIGMA_SHARE: Final = 0.5
"""A draw is normal with this share of its bound as sigma and cut at the bound: most individuals are near the middle."""


class Variation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bounds about the nominal values (docs/reference/machines.md section 14): relative ones as fractions, others with their unit.

    ``offset`` is the zero error of an encoder [rad, m], ``antenna_m`` how far an antenna stands beside its place;
    delays are drawn anew between their two bounds, most often near the nominal one.
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
    """Bounded random numbers for one part of the truth: each part draws from its own seed, whatever others draw."""

    def __init__(self, spread: Variation, part: str, seed: int) -> None:
        self.spread = spread
        self.rng = random.Random(f"truth {part} {seed}")

    def within(self, bound: float) -> float:
        """A number in -bound..bound, near 0 more often."""
        return bound * max(-1.0, min(1.0, self.rng.gauss(0.0, SIGMA_SHARE)))

    def factor(self, bound: float) -> float:
        """A factor in 1-bound..1+bound."""
        return 1.0 + self.within(bound)

    def delay(self, nominal_s: float) -> float:
        """A dead time [s] between the spread's two bounds; a function without dead time keeps none."""
        s = self.spread
        return self.rng.triangular(s.delay_min_s, s.delay_max_s, nominal_s) if nominal_s else 0.0
