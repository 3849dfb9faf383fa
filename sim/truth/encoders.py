"""Errors of one encoder."""

from __future__ import annotations

import math

import msgspec

from sim.truth.variation import VariationSampler


class EncoderTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of one encoder in the joint's unit: offset, eccentricity (once per turn), noise; latency."""

    offset: float
    eccentricity: float
    phase_rad: float
    noise: float
    latency_s: float

    def sampled(self, draw: VariationSampler) -> EncoderTruth:
        """The encoder of an individual: mounted with its own zero error and eccentricity."""
        return msgspec.structs.replace(
            self,
            offset=self.offset + draw.within(draw.spread.offset),
            eccentricity=self.eccentricity * draw.factor(draw.spread.eccentricity),
            phase_rad=draw.rng.uniform(0.0, 2.0 * math.pi),
        )
