"""Errors of the cameras and of the GNSS receiver."""

from __future__ import annotations

import math

import msgspec

from sim.truth.variation import VariationSampler

Vector = tuple[float, float, float]


class CameraTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One stereo camera: its true mount and its depth errors.

    docs/reference/perception.md section 5, docs/reference/machines.md section 8.

    ``mount_position_m`` and ``mount_rpy_rad`` are the true body frame relative to the profile's, in the profile's body
    frame; an individual is off by at most ``mount_bound_m`` and ``mount_bound_rad``.  Depth errs by
    ``disparity_sigma_px`` of disparity (of the camera's own pixels), correlated over ``correlation_px`` delivered
    pixels (1/e), and by a scale drawn between the two ``scale_bias`` for each run, of either sign.  Where disparity
    jumps by more than ``edge_jump_px`` the nearer surface grows by between the two ``edge_px`` delivered pixels.
    ``hole_share`` of a textured surface and ``plain_hole_share`` of one without texture has no depth.
    """

    mount_position_m: Vector
    mount_rpy_rad: Vector
    mount_bound_m: float
    mount_bound_rad: float
    disparity_sigma_px: float
    correlation_px: float
    scale_bias: tuple[float, float]
    edge_jump_px: float
    edge_px: tuple[float, float]
    hole_share: float
    plain_hole_share: float

    def sampled(self, draw: VariationSampler) -> CameraTruth:
        """Draw the camera of an individual: shifted and turned at random, its matching better or worse by a third."""

        def off(nominal: Vector, bound: float) -> Vector:
            direction = [draw.rng.gauss(0.0, 1.0) for _ in range(3)]
            size = bound * draw.rng.random() / math.hypot(*direction)
            x, y, z = (n + size * w for n, w in zip(nominal, direction, strict=True))
            return (x, y, z)

        return msgspec.structs.replace(
            self,
            mount_position_m=off(self.mount_position_m, self.mount_bound_m),
            mount_rpy_rad=off(self.mount_rpy_rad, self.mount_bound_rad),
            disparity_sigma_px=self.disparity_sigma_px * draw.factor(0.35),
        )


class FixTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fix quality: white and slowly wandering horizontal error [m, root mean square], and the receiver's report:
    dilution of precision and satellites in use.
    """

    noise_m: float
    wander_m: float
    hdop: float
    satellites: int


class GnssTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A dual-antenna RTK receiver (docs/reference/machines.md section 8).

    ``fixes`` are the qualities by name (rtk_fixed, rtk_float, dgnss, single).  ``wander_s`` is the correlation time of
    the wander; heights err ``height_factor`` times as much.  ``phase_noise_m`` per antenna makes the heading noise:
    sqrt(2) phase_noise / baseline.  A solution leaves the receiver between the two ``latency_s`` after its epoch.
    ``main_offset_m`` and ``aux_offset_m`` are the antennas' true positions relative to the profile's (front frame).
    ``datum_m`` is the ellipsoidal height of the site's origin, ``geoid_m`` the geoid above the ellipsoid.
    """

    fixes: dict[str, FixTruth]
    wander_s: float
    height_factor: float
    phase_noise_m: float
    speed_noise_m_s: float
    rate_noise_rad_s: float
    attitude_noise_rad: float
    latency_s: tuple[float, float]
    main_offset_m: Vector
    aux_offset_m: Vector
    datum_m: float
    geoid_m: float

    def sampled(self, draw: VariationSampler) -> GnssTruth:
        """Draw the receiver of an individual: antennas mounted a little beside their nominal places."""
        bound = draw.spread.antenna_m
        main, aux = (tuple(x + draw.within(bound) for x in at) for at in (self.main_offset_m, self.aux_offset_m))
        return msgspec.structs.replace(self, main_offset_m=main, aux_offset_m=aux)


# -- Errors of one encoder.


class EncoderTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of one encoder in the joint's unit: offset, eccentricity (once per turn), noise; latency."""

    offset: float
    eccentricity: float
    phase_rad: float
    noise: float
    latency_s: float

    def sampled(self, draw: VariationSampler) -> EncoderTruth:
        """Draw the encoder of an individual: mounted with its own zero error and eccentricity."""
        return msgspec.structs.replace(
            self,
            offset=self.offset + draw.within(draw.spread.offset),
            eccentricity=self.eccentricity * draw.factor(draw.spread.eccentricity),
            phase_rad=draw.rng.uniform(0.0, 2.0 * math.pi),
        )
