"""Masses, steel and flexibility of one machine: the rigid bodies of its crane, and the pose in which it starts."""

from __future__ import annotations

from typing import Final

import msgspec

from sim.truth.variation import VariationSampler


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mass [kg], centre of mass in the link frame [m], principal inertia about it [kg m^2]."""

    mass_kg: float
    com_m: tuple[float, float, float]
    inertia_kg_m2: tuple[float, float, float]

    def sampled(self, draw: VariationSampler) -> Link:
        """Draw the link of an individual: mass and inertia scaled together."""
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
        """Draw the structure of an individual."""
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


# -- Ground truth of one carrier: masses of its halves, arms and wheels, tyres, wheel motors and brakes.
#
# Every nominal figure is an engineering estimate (docs/reference/machines.md section 7: total mass 10 t with the
# crane, tyres 600/50-22.5).

TYRE_VARIATION: Final = 0.2
COM_M: Final = 0.05


class Frame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One half of the carrier: mass [kg], centre of mass in its frame [m], principal inertia about it [kg m^2]."""

    mass_kg: float
    com_m: tuple[float, float, float]
    inertia_kg_m2: tuple[float, float, float]

    def sampled(self, draw: VariationSampler) -> Frame:
        """Draw the half of an individual."""
        k = draw.factor(draw.spread.mass)
        x, y, z = (c + draw.within(COM_M) for c in self.com_m)
        a, b, c = (k * i for i in self.inertia_kg_m2)
        return Frame(k * self.mass_kg, (x, y, z), (a, b, c))


class CarrierTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The carrier's figures that are not in the profile; ``sim.ground.tyre`` defines the tyre's figures.

    ``rear`` has the crane's foot and the bunk, ``front`` the engine; ``arm_mass_kg`` is one swing arm, uniform from
    pivot to hub, ``wheel_mass_kg`` tyre, rim and hub motor.  The tyre's free radius is the profile's (loaded) radius
    plus ``tyre_sink_m``, times ``wheel_radius_scale``.  Forces and stiffnesses are per wheel.
    """

    rear: Frame
    front: Frame
    arm_mass_kg: float
    wheel_mass_kg: float
    wheel_spin_inertia_kg_m2: float
    wheel_radius_scale: float
    tyre_sink_m: float
    tyre_stiffness_n_m: float
    tyre_damping_n_s_m: float
    tread_n_m: float
    tread_n_s_m: float
    relaxation_m: float
    friction: float
    rolling_resistance: float
    drive_torque_nm: float
    drive_gain_nm_s_rad: float
    drive_lag_s: float
    drive_acceleration_m_s2: float
    slip_limit: float
    brake_torque_nm: float
    brake_lag_s: float

    def sampled(self, draw: VariationSampler) -> CarrierTruth:
        """Draw the carrier of an individual: masses and friction by the variation, centres of mass within 5 cm."""
        mass, friction = draw.spread.mass, draw.spread.friction
        wheel = draw.factor(mass)
        return msgspec.structs.replace(
            self,
            rear=self.rear.sampled(draw),
            front=self.front.sampled(draw),
            arm_mass_kg=self.arm_mass_kg * draw.factor(mass),
            wheel_mass_kg=self.wheel_mass_kg * wheel,
            wheel_spin_inertia_kg_m2=self.wheel_spin_inertia_kg_m2 * wheel,
            wheel_radius_scale=self.wheel_radius_scale * draw.factor(0.02),
            tyre_stiffness_n_m=self.tyre_stiffness_n_m * draw.factor(TYRE_VARIATION),
            tyre_damping_n_s_m=self.tyre_damping_n_s_m * draw.factor(TYRE_VARIATION),
            tread_n_m=self.tread_n_m * draw.factor(TYRE_VARIATION),
            relaxation_m=self.relaxation_m * draw.factor(TYRE_VARIATION),
            friction=self.friction * draw.factor(friction),
            rolling_resistance=self.rolling_resistance * draw.factor(friction),
            drive_gain_nm_s_rad=self.drive_gain_nm_s_rad * draw.factor(draw.spread.gain),
            drive_lag_s=self.drive_lag_s * draw.factor(TYRE_VARIATION),
            brake_torque_nm=self.brake_torque_nm * draw.factor(friction),
        )
