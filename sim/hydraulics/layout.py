"""The arrays the kernel works on: one record of constants and one of state per function, one pair for the pump.

Everything is float64 in SI units; the records' fields are the keys of ``sim.truth`` where they have the same meaning.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sim.truth.hydraulics import Function, Supply
from sim.truth.load import Truth

SOFT_PA: Final = 0.2e6
UNIT_PA: Final = 1.0e6
LEVER_POINTS: Final = 129
CUSHION: Final = 0.02  # the end stops give before the ends of the lever table [rad, m]
OUT_OVER_IN: Final = 1.05  # metering out passes a little more than metering in brings, or back pressure would build up


def _record(names: str, *more: tuple[str, type]) -> np.dtype:
    return np.dtype([(n, np.float64) for n in names.split()] + list(more))


CONSTANTS: Final = _record(
    "area_a area_b dead_volume coulomb stiction stribeck_speed viscous relaxation inertia "
    "spool_rad_s spool_zeta half_play deadband_plus deadband_minus exponent limit_plus limit_minus check_ratio "
    "in_plus in_minus out_plus out_minus lever_low lever_step stroke low high",
    ("delay_steps", np.int64),
)
"""One function.  ``in_*`` and ``out_*``: flow [m^3/s] through the fully open edge per unit of ``kernel.orifice``."""

STATE: Final = _record(
    "spool spool_speed play opening poppet pressure_a pressure_b hose_a hose_b arm travel speed outer "
    "flow_a flow_b inflow at q qd torque driven",
    ("line_at", np.int64),
)
"""One function.  ``travel``, ``at`` and ``speed`` run ahead within a step as predicted; ``q``, ``qd``, ``torque`` and
its part ``driven`` by the oil are those of the last step; ``outer``: acceleration that the world gives the joint
besides its drive; ``flow_*``: through the float valve; ``inflow``: from the pump.
"""

PUMP: Final = _record("post flow margin relief shock tank build_up bulk leakage")
"""Constants of the supply; ``post`` is 1 for a post-compensated valve block."""

BALANCE: Final = _record("supply limited energy_in energy_out loss peak")
"""Pump pressure [Pa], whether flow runs short, energies [J] from pump and tank, to the joints and lost, highest chamber
pressure [Pa].
"""


def pump(supply: Supply) -> np.ndarray:
    """The one PUMP record."""
    s = supply
    post = float(s.sharing == "post_compensated")
    values = (post, s.pump_flow_m3_s, s.pressure_margin_pa, s.relief_pa, s.shock_pa, s.tank_pa, s.build_up_s)
    return np.array([(*values, s.bulk_modulus_pa, s.leakage_m3_s_pa)], PUMP)


def _lever(function: Function) -> tuple[np.ndarray, np.ndarray]:
    """Lever arm dx/dq and piston travel from its lower end, on a uniform grid over the joint's positions."""
    c = function.cylinder
    q = np.linspace(c.arm_at[0], c.arm_at[-1], LEVER_POINTS)
    arm = np.interp(q, c.arm_at, c.arm)
    travel = np.concatenate(([0.0], np.cumsum((arm[1:] + arm[:-1]) / 2 * (q[1] - q[0]))))
    return arm, travel - travel.min()


def functions(truth: Truth, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """CONSTANTS of every function, and their lever tables (function, arm or travel, grid)."""
    margin = truth.supply.pressure_margin_pa
    full = margin / np.sqrt(UNIT_PA * (margin + SOFT_PA))
    records = np.zeros(len(truth.functions), CONSTANTS)
    tables = np.empty((len(records), 2, LEVER_POINTS))
    for r, table, function in zip(records, tables, truth.functions.values(), strict=True):
        c, v = function.cylinder, function.valve
        table[:] = _lever(function)
        nominal = abs(c.arm_nominal) / full
        into_a, into_b = c.area_a * nominal * v.full_speed_plus, c.area_b * nominal * v.full_speed_minus
        values = {
            "area_a": c.area_a,
            "area_b": c.area_b,
            "dead_volume": c.dead_volume_m3,
            "coulomb": c.coulomb,
            "stiction": c.stiction,
            "stribeck_speed": c.stribeck_speed,
            "viscous": c.viscous,
            "relaxation": c.relaxation_1_s,
            "inertia": c.least_inertia,
            "spool_rad_s": v.spool_rad_s,
            "spool_zeta": v.spool_zeta,
            "half_play": v.hysteresis / 2,
            "deadband_plus": v.deadband_plus,
            "deadband_minus": v.deadband_minus,
            "exponent": v.exponent,
            "limit_plus": v.limit_plus_pa,
            "limit_minus": v.limit_minus_pa,
            "check_ratio": v.check_ratio,
            "in_plus": into_a,
            "in_minus": into_b,
            "out_plus": OUT_OVER_IN * into_a * c.area_b / c.area_a,
            "out_minus": OUT_OVER_IN * into_b * c.area_a / c.area_b,
            "lever_low": c.arm_at[0],
            "lever_step": (c.arm_at[-1] - c.arm_at[0]) / (LEVER_POINTS - 1),
            "stroke": table[1].max(),
            "low": c.arm_at[0] + CUSHION,
            "high": c.arm_at[-1] - CUSHION,
            "delay_steps": max(1, round(v.delay_s / step_s)),
        }
        for key in CONSTANTS.names:
            r[key] = values[key]
    return records, tables
