"""The arrays of the kernel: one record of constants and one of state per function, one pair for the pump.

Everything is float64 in SI units; fields have the names of the keys of ``sim.truth`` where they mean the same.
"""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.truth.hydraulics import Function, Supply
from sim.truth.load import Truth

PA_PER_BAR: Final = 1e5
SOFT_PA: Final = 0.2e6
UNIT_PA: Final = 1.0e6
LEVER_POINT_COUNT: Final = 129
CUSHION_LENGTH: Final = 0.02  # the end stops begin before the ends of the lever table [rad, m]
METER_OUT_FACTOR: Final = 1.05  # metering out passes a little more than metering in, or back pressure would build up


Array = NDArray[np.float64]
Records = NDArray[np.void]
"""Numpy records; the classes below name their fields and make their dtypes."""


class FunctionConstants(Protocol):
    """One function.

    ``swept_*``: what a chamber grows by with the travel [m^3/m]; 0 for an endless motor, whose chambers stay as large
    as halfway.  ``in_*`` and ``out_*``: flow [m^3/s] through the fully open edge per unit of ``kernel.orifice``.
    """

    area_a: float
    area_b: float
    swept_a: float
    swept_b: float
    dead_volume: float
    coulomb: float
    stiction: float
    stribeck_speed: float
    viscous: float
    relaxation: float
    inertia: float
    spool_rad_s: float
    spool_zeta: float
    half_play: float
    deadband_plus: float
    deadband_minus: float
    exponent: float
    limit_plus: float
    limit_minus: float
    check_ratio: float
    in_plus: float
    in_minus: float
    out_plus: float
    out_minus: float
    lever_low: float
    lever_step: float
    stroke: float
    low: float
    high: float
    delay_steps: int


class FunctionState(Protocol):
    """One function.

    ``travel``, ``at`` and ``speed`` are predicted within a step; ``q``, ``qd``, ``torque`` and its part ``driven`` by
    the oil are those of the last step; ``outer``: the joint's acceleration that its drive does not cause; ``flow_*``:
    through the float valve; ``inflow``: from the pump.
    """

    spool: float
    spool_speed: float
    play: float
    opening: float
    poppet: float
    pressure_a: float
    pressure_b: float
    hose_a: float
    hose_b: float
    arm: float
    travel: float
    speed: float
    outer: float
    flow_a: float
    flow_b: float
    inflow: float
    at: float
    q: float
    qd: float
    torque: float
    driven: float
    line_at: int


class Pump(Protocol):
    """Constants of the supply; ``post`` is 1 for a post-compensated valve block."""

    post: float
    flow: float
    margin: float
    relief: float
    shock: float
    tank: float
    build_up: float
    bulk: float
    leakage: float


class Balance(Protocol):
    """Pump pressure [Pa], whether flow runs short, energies [J] from pump and tank, to the joints and lost, highest
    chamber pressure [Pa].
    """

    supply: float
    limited: float
    energy_in: float
    energy_out: float
    loss: float
    peak: float


def _dtype(fields: type) -> np.dtype[np.void]:
    """Make the dtype of a record with these fields, in their order."""
    kinds = {"float": np.float64, "int": np.int64}
    return np.dtype([(name, kinds[kind]) for name, kind in fields.__annotations__.items()])


CONSTANTS: Final = _dtype(FunctionConstants)
STATE: Final = _dtype(FunctionState)
PUMP: Final = _dtype(Pump)
BALANCE: Final = _dtype(Balance)


def pump(supply: Supply) -> Records:
    """Make the one PUMP record."""
    s = supply
    post = float(s.sharing == "post_compensated")
    values = (post, s.pump_flow_m3_s, s.pressure_margin_pa, s.relief_pa, s.shock_pa, s.tank_pa, s.build_up_s)
    return np.array([(*values, s.bulk_modulus_pa, s.leakage_m3_s_pa)], PUMP)


def _lever(function: Function) -> tuple[Array, Array]:
    """Compute lever arm dx/dq and piston travel from its lower end, on a uniform grid over the joint's positions."""
    c = function.cylinder
    q = np.linspace(c.arm_at[0], c.arm_at[-1], LEVER_POINT_COUNT)
    arm = np.interp(q, c.arm_at, c.arm)
    travel = np.concatenate(([0.0], np.cumsum((arm[1:] + arm[:-1]) / 2 * (q[1] - q[0]))))
    return arm, travel - travel.min()


def functions(truth: Truth, step_s: float) -> tuple[Records, Array]:
    """Make the CONSTANTS of every function, and their lever tables (function, arm or travel, grid)."""
    margin = truth.supply.pressure_margin_pa
    full = margin / np.sqrt(UNIT_PA * (margin + SOFT_PA))
    records = np.zeros(len(truth.functions), CONSTANTS)
    tables = np.empty((len(records), 2, LEVER_POINT_COUNT))
    for r, table, function in zip(records, tables, truth.functions.values(), strict=True):
        c, v = function.cylinder, function.valve
        table[:] = _lever(function)
        nominal = abs(c.arm_nominal) / full
        into_a, into_b = c.area_a * nominal * v.full_speed_plus, c.area_b * nominal * v.full_speed_minus
        values = {
            "area_a": c.area_a,
            "area_b": c.area_b,
            "swept_a": 0.0 if c.endless else c.area_a,
            "swept_b": 0.0 if c.endless else c.area_b,
            "dead_volume": c.dead_volume_m3 + (0.5 * c.area_a * table[1].max() if c.endless else 0.0),
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
            "out_plus": METER_OUT_FACTOR * into_a * c.area_b / c.area_a,
            "out_minus": METER_OUT_FACTOR * into_b * c.area_a / c.area_b,
            "lever_low": c.arm_at[0],
            "lever_step": (c.arm_at[-1] - c.arm_at[0]) / (LEVER_POINT_COUNT - 1),
            "stroke": table[1].max(),
            "low": -np.inf if c.endless else c.arm_at[0] + CUSHION_LENGTH,
            "high": np.inf if c.endless else c.arm_at[-1] - CUSHION_LENGTH,
            "delay_steps": max(1, round(v.delay_s / step_s)),
        }
        for key in CONSTANTS.names or ():
            r[key] = values[key]
    return records, tables
