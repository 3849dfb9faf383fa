"""Pump, oil, cylinders and valves of one machine.

docs/reference/plant-model.md section 2, docs/reference/machines.md section 3.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import msgspec

from sim.truth.variation import VariationSampler

WIDE_DEADBAND: Final = (0.03, 0.30)
WIDE_DELAY_S: Final = (0.020, 0.250)
WIDE_GAIN: Final = (1.0 / 3.0, 3.0)
"""Ranges of the valves that a crane may have at all: share of the stroke, s, times the nominal full speed."""


class Supply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Load-sensing pump, tank and oil.

    ``sharing``: what happens when the functions demand more flow than the pump delivers.  ``pre_compensated``: the pump
    pressure falls and the heaviest load stops first.  ``post_compensated``: all slow down by the same factor.
    ``build_up_s``: time constant of the pump pressure behind the load-sensing line.  ``shock_pa``: port relief valves.
    """

    sharing: Literal["pre_compensated", "post_compensated"]
    pump_flow_m3_s: float
    pressure_margin_pa: float
    relief_pa: float
    shock_pa: float
    tank_pa: float
    build_up_s: float
    bulk_modulus_pa: float
    leakage_m3_s_pa: float

    def sampled(self, draw: VariationSampler) -> Supply:
        """Draw the supply of an individual."""
        return msgspec.structs.replace(
            self,
            pump_flow_m3_s=self.pump_flow_m3_s * draw.factor(draw.spread.pump),
            bulk_modulus_pa=self.bulk_modulus_pa * draw.factor(draw.spread.bulk),
        )


ENDLESS_RAD: Final = 3.0 * math.pi
"""Hoses bear a turn at most: a drive with a longer range has a rotary union, and turns on beyond it."""


class Cylinder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A double-acting cylinder (or motor) and its linkage to the joint.

    Piston areas [m^2]: chamber A pushes in the direction of a positive command, B against it (drives of a whole turn:
    displacement [m^3/rad] with arm 1). ``arm``: dx/dq [m/rad, m/m] over the joint positions ``arm_at``, from hard
    stop to hard stop (the drive's own cushions begin a little before them); it is negative where a positive command
    moves the joint towards smaller q (the grapple: + opens). ``arm_nominal``: the arm at which the valve's full speed
    holds. Friction at the piston [N, m/s, N s/m] in the form of docs/reference/machines.md section 3.
    ``relaxation_1_s``: how fast load oscillations pass the damping orifices. ``least_inertia`` [kg m^2, kg]: half the
    smallest inertia that the joint shows its drive in any pose while the other drives push too; the solver depends on
    it.
    """

    area_a: float
    area_b: float
    dead_volume_m3: float
    arm_at: tuple[float, ...]
    arm: tuple[float, ...]
    arm_nominal: float
    coulomb: float
    stiction: float
    stribeck_speed: float
    viscous: float
    relaxation_1_s: float
    least_inertia: float

    @property
    def endless(self) -> bool:
        """Whether the drive has no stops: ``arm_at`` is where its lever arm is tabulated."""
        return self.arm_at[-1] - self.arm_at[0] > ENDLESS_RAD

    def sampled(self, draw: VariationSampler) -> Cylinder:
        """Draw the cylinder of an individual: its seals have more or less friction, its load is lighter or heavier."""
        dry = draw.factor(draw.spread.friction)
        return msgspec.structs.replace(
            self,
            coulomb=self.coulomb * dry,
            stiction=self.stiction * dry,
            viscous=self.viscous * draw.factor(draw.spread.friction),
            least_inertia=self.least_inertia * (1.0 - draw.spread.mass),
        )


class ValveTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One spool section.

    Dead time, second-order spool, hysteresis (whole width, share of the stroke), dead-band of either side (share of
    the stroke), metering exponent of phi(y) = sign(y)|y|^n, joint speed at full spool, limit of the port pressure on
    either side (load-sensing cut-off; the pump's relief where larger).  ``check_ratio``: opening ratio of a
    pilot-operated check valve that locks chamber B, 0 where there is none.
    """

    delay_s: float
    spool_rad_s: float
    spool_zeta: float
    hysteresis: float
    deadband_plus: float
    deadband_minus: float
    exponent: float
    full_speed_plus: float
    full_speed_minus: float
    limit_plus_pa: float
    limit_minus_pa: float
    check_ratio: float = 0.0

    def sampled(self, draw: VariationSampler) -> ValveTruth:
        """Draw the valve of an individual."""
        s = draw.spread
        return msgspec.structs.replace(
            self,
            delay_s=draw.delay(self.delay_s),
            hysteresis=self.hysteresis * draw.factor(s.hysteresis),
            deadband_plus=self.deadband_plus * draw.factor(s.deadband),
            deadband_minus=self.deadband_minus * draw.factor(s.deadband),
            full_speed_plus=self.full_speed_plus * draw.factor(s.gain),
            full_speed_minus=self.full_speed_minus * draw.factor(s.gain),
        )

    def widely_sampled(self, draw: VariationSampler, nominal: ValveTruth) -> ValveTruth:
        """Draw any sensible valve instead of this one: dead-bands, dead time and full speeds, each drawn for itself,
        the full speeds around the ``nominal`` ones.
        """
        return msgspec.structs.replace(
            self,
            delay_s=draw.log_uniform(*WIDE_DELAY_S),
            deadband_plus=draw.log_uniform(*WIDE_DEADBAND),
            deadband_minus=draw.log_uniform(*WIDE_DEADBAND),
            full_speed_plus=nominal.full_speed_plus * draw.log_uniform(*WIDE_GAIN),
            full_speed_minus=nominal.full_speed_minus * draw.log_uniform(*WIDE_GAIN),
        )


class Function(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One hydraulic function of the machine."""

    cylinder: Cylinder
    valve: ValveTruth

    def sampled(self, draw: VariationSampler) -> Function:
        """Draw the function of an individual."""
        return Function(self.cylinder.sampled(draw), self.valve.sampled(draw))
