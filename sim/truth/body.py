"""Masses, steel and flexibility of one machine: the rigid bodies of its crane, and the pose in which it starts."""

from __future__ import annotations

import msgspec

from sim.truth.variation import VariationSampler


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mass [kg], centre of mass in the link frame [m], principal inertia about it [kg m^2]."""

    mass_kg: float
    com_m: tuple[float, float, float]
    inertia_kg_m2: tuple[float, float, float]

    def sampled(self, draw: VariationSampler) -> Link:
        """The link of an individual: mass and inertia scaled together."""
        scale = draw.factor(draw.spread.mass)
        x, y, z = (scale * i for i in self.inertia_kg_m2)
        return msgspec.structs.replace(self, mass_kg=scale * self.mass_kg, inertia_kg_m2=(x, y, z))


class Steel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Dimensions of the steel that are not in the profile [m].

    ``bearing_z_m``: slew bearing above the base origin.  ``beams_m``: width and height of boom, stick and telescope;
    ``column_m``: width of the column.  ``telescope_frame_m``: the telescope's link frame at extension 0 in the
    stick's; None: where the telescope's axis passes the stick pin.
    """

    bearing_z_m: float
    beams_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    column_m: float
    telescope_frame_m: tuple[float, float, float] | None = None


class Home(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joint positions in which the crane starts [rad, m]; there its column stands plumb with an empty grapple."""

    slew: float
    lift: float
    tilt: float
    ext: float
    rot: float


class Structure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Damping of the two passive joints above the rotator, the column's flexibility, and the rod that couples the jaws.

    The column bends on two hinges at its foot: 250 kg more at 6 m move the tip of the small crane by about 0.1 m,
    unseen by the encoders (paper A; docs/reference/plant-model.md section 2).  ``flex_damping_s``: damper over spring.
    """

    hanger_damping_nm_s_rad: float
    fork_damping_nm_s_rad: float
    flex_pitch_nm_rad: float
    flex_roll_nm_rad: float
    flex_damping_s: float
    tong_sync_nm_rad: float
    tong_sync_nm_s_rad: float

    def sampled(self, draw: VariationSampler) -> Structure:
        """The structure of an individual."""
        s = draw.spread
        hanging = draw.factor(s.friction)
        return msgspec.structs.replace(
            self,
            hanger_damping_nm_s_rad=hanging * self.hanger_damping_nm_s_rad,
            fork_damping_nm_s_rad=hanging * self.fork_damping_nm_s_rad,
            flex_pitch_nm_rad=draw.factor(s.flexibility) * self.flex_pitch_nm_rad,
            flex_roll_nm_rad=draw.factor(s.flexibility) * self.flex_roll_nm_rad,
            flex_damping_s=draw.factor(s.friction) * self.flex_damping_s,
        )


class Contact(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Friction (product rule of the two bodies) and rolling resistance of the logs."""

    log_friction: float
    ground_friction: float
    tong_friction: float
    bunk_friction: float
    log_rolling_m: float
