"""The compiled loop of the hydraulics: one physics step of all functions in substeps.

Per substep (docs/reference/plant-model.md section 2, docs/reference/machines.md section 3): spool, load-sensing pump,
flow sharing, friction and predicted joint speed, chamber pressures (implicit in their own edges).  Bullet holds the
returned torque for a whole step, so the joint's motion within it is predicted with an inertia below the real one
(above it, friction would chatter), and before the next step the pressures are corrected by the difference between
predicted and real travel: oil is never gained or lost, and the mean torque of a stiff drive on a light joint stays
damped (omega times step up to about 1.4).

Records: ``sim.hydraulics.layout``.  Chamber A pushes in the direction of a positive command.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim.hydraulics.layout import SOFT_PA, UNIT_PA, Array, Balance, FunctionConstants, FunctionState, Pump, Records

STEADY_S = 0.15  # pressure that lasts longer than this is a load, not an oscillation
VALVE_M3_S_PA = 1.0e-8  # relief and make-up valves of a port: flow per pressure beyond their setting
FLOAT_M3_S_PA = 2.0e-9  # float valve between the swing arms of an axle
STOP_RAD_S = 350.0  # an end stop: frequency of the least inertia on it, half of critically damped
POPPET_S = 0.01  # a check valve's poppet follows its pilot
BISECTION_COUNT = 24


@njit(cache=True)
def orifice(drop: float) -> float:
    """Compute the flow factor of an edge over its pressure drop: 1 near 1 MPa, ~ square root beyond SOFT_PA."""
    return drop / math.sqrt(UNIT_PA * (abs(drop) + SOFT_PA))


@njit(cache=True)
def friction(c: FunctionConstants, speed: float) -> tuple[float, float]:
    """Compute the Stribeck friction of a piston [N] and a stable slope over speed [N s/m].

    docs/reference/machines.md section 3, form of PATU.
    """
    a = abs(speed) / c.stribeck_speed
    t = math.tanh(4.0 * a)
    bump = a * a / 4.0 + 0.75
    force = c.coulomb * t + (c.stiction - c.coulomb) * a / (bump * bump) + c.viscous * abs(speed)
    slope = 4.0 * c.coulomb / c.stribeck_speed * (1.0 - t * t) + c.viscous
    slope += max(0.0, (c.stiction - c.coulomb) / (c.stribeck_speed * bump * bump) * (1.0 - a * a / bump))
    return math.copysign(force, speed), slope


@njit(cache=True)
def move_spool(c: FunctionConstants, s: FunctionState, command: float, h: float) -> None:
    """Advance the second-order spool, play (hysteresis), dead-band and metering; set ``opening`` in -1..1."""
    w = c.spool_rad_s
    s.spool_speed += h * (w * w * (command - s.spool) - 2.0 * c.spool_zeta * w * s.spool_speed)
    s.spool += h * s.spool_speed
    x = max(-1.0, min(1.0, s.spool))
    s.play = max(x - c.half_play, min(x + c.half_play, s.play))
    x = s.play
    if x > c.deadband_plus:
        s.opening = min(1.0, (x - c.deadband_plus) / (1.0 - c.half_play - c.deadband_plus)) ** c.exponent
    elif x < -c.deadband_minus:
        s.opening = -(min(1.0, (-x - c.deadband_minus) / (1.0 - c.half_play - c.deadband_minus)) ** c.exponent)
    else:
        s.opening = 0.0


@njit(cache=True)
def demand(c: FunctionConstants, s: FunctionState, supply: float, margin: float) -> float:
    """Find the flow [m^3/s] a function demands at this pump pressure: its compensator keeps the drop at the margin."""
    if s.opening > 0.0:
        drop = min(min(supply, c.limit_plus) - s.pressure_a, margin)
        return c.in_plus * s.opening * max(0.0, orifice(drop))
    if s.opening < 0.0:
        drop = min(min(supply, c.limit_minus) - s.pressure_b, margin)
        return -c.in_minus * s.opening * max(0.0, orifice(drop))
    return 0.0


@njit(cache=True)
def share_flow(constants: Records, states: Records, pump: Pump, balance: Balance, h: float) -> float:
    """Compute the pump pressure after the load-sensing line, and every function's inflow within the pump's flow."""
    load = 0.0
    for i in range(len(states)):
        s = states[i]
        if s.opening > 0.0:
            load = max(load, min(s.pressure_a, constants[i].limit_plus))
        elif s.opening < 0.0:
            load = max(load, min(s.pressure_b, constants[i].limit_minus))
    target = min(load + pump.margin, pump.relief)
    balance.supply += (target - balance.supply) * min(1.0, h / pump.build_up)
    supply = balance.supply
    total_demand_m3_s = 0.0
    for i in range(len(states)):
        states[i].inflow = demand(constants[i], states[i], supply, pump.margin)
        total_demand_m3_s += states[i].inflow
    balance.limited = 1.0 if total_demand_m3_s > pump.flow else 0.0
    if total_demand_m3_s > pump.flow and pump.post:
        for i in range(len(states)):
            states[i].inflow *= pump.flow / total_demand_m3_s
    elif total_demand_m3_s > pump.flow:
        low, high = 0.0, supply
        for _ in range(BISECTION_COUNT):
            supply = 0.5 * (low + high)
            total_demand_m3_s = 0.0
            for i in range(len(states)):
                total_demand_m3_s += demand(constants[i], states[i], supply, pump.margin)
            if total_demand_m3_s > pump.flow:
                high = supply
            else:
                low = supply
        for i in range(len(states)):
            states[i].inflow = demand(constants[i], states[i], low, pump.margin)
        supply = low
    return supply


@njit(cache=True)
def meter_out(gain: float, pressure: float, pump: Pump) -> tuple[float, float]:
    """Compute the flow out of a chamber through its compensated edge [m^3/s] and the slope over its pressure."""
    drop = pressure - pump.tank
    if drop <= 0.0:
        return 0.0, 0.0
    if drop >= pump.margin:
        return gain * orifice(pump.margin), 0.0
    return gain * orifice(drop), gain / math.sqrt(UNIT_PA * (drop + SOFT_PA))


@njit(cache=True)
def port(pressure: float, pump: Pump) -> tuple[float, float]:
    """Compute the flow into a chamber through its make-up or relief valve and the slope over its pressure."""
    if pressure < pump.tank:
        return VALVE_M3_S_PA * (pump.tank - pressure), VALVE_M3_S_PA
    if pressure > pump.shock:
        return VALVE_M3_S_PA * (pump.shock - pressure), VALVE_M3_S_PA
    return 0.0, 0.0


@njit(cache=True)
def chamber(
    pressure: float,
    stiff: float,
    swept: float,
    inflow: float,
    source: float,
    out: float,
    out_slope: float,
    other: float,
    damp: float,
    hose: float,
    pump: Pump,
    balance: Balance,
    h: float,
) -> float:
    """Compute one chamber's pressure after ``h``; add its energies to ``balance``.

    ``stiff``: h bulk / volume; ``swept``: flow that the piston takes; ``inflow`` comes at pressure ``source``; ``out``
    leaves to the tank; oil leaks to the ``other`` chamber and passes the damping orifice to its ``hose``.
    """
    leak = pump.leakage
    valve, valve_slope = port(pressure, pump)
    sum_flow = inflow - swept - out + valve + leak * (other - pressure) + damp * (hose - pressure)
    slope = out_slope + valve_slope + leak + damp
    after = max(0.0, pressure + stiff * sum_flow / (1.0 + stiff * slope))
    change = after - pressure
    middle = pressure + 0.5 * change
    out += out_slope * change
    valve -= valve_slope * change
    balance.loss += h * (inflow * (source - middle) + out * middle)
    balance.loss += h * (leak * (other - middle) ** 2 * 0.5 + damp * (hose - middle) ** 2)
    if valve > 0.0:
        balance.energy_in += h * valve * pump.tank
        balance.loss += h * valve * (pump.tank - middle)
    else:
        balance.loss -= h * valve * middle
    balance.peak = max(balance.peak, after)
    return after


@njit(cache=True)
def end_stop(c: FunctionConstants, s: FunctionState) -> float:
    """Compute the torque of the drive's own cushioned end stops [Nm, N]; it only pushes."""
    stiffness, damping = c.inertia * STOP_RAD_S**2, c.inertia * STOP_RAD_S
    if s.at < c.low:
        return max(0.0, stiffness * (c.low - s.at) - damping * s.speed)
    if s.at > c.high:
        return min(0.0, stiffness * (c.high - s.at) - damping * s.speed)
    return 0.0


@njit(cache=True)
def advance_function(
    c: FunctionConstants,
    s: FunctionState,
    supply: float,
    pump: Pump,
    balance: Balance,
    h: float,
) -> tuple[float, float]:
    """Advance one function over one substep; return the joint torque [Nm, N] of its oil and that of its end stops."""
    a, b = s.pressure_a, s.pressure_b
    force = a * c.area_a - b * c.area_b
    before = s.arm * s.speed
    rub, rub_slope = friction(c, before)
    ratio = s.arm / c.inertia
    stop = end_stop(c, s)
    change = h * (s.outer + ratio * (force - rub) + stop / c.inertia) / (1.0 + h * ratio * s.arm * rub_slope)
    s.speed += change
    speed = s.arm * s.speed
    rub += rub_slope * s.arm * change
    volume_a = c.dead_volume + c.swept_a * s.travel
    volume_b = c.dead_volume + c.swept_b * (c.stroke - s.travel)
    stiff_a, stiff_b = h * pump.bulk / volume_a, h * pump.bulk / volume_b
    if c.check_ratio > 0.0:
        pilot = max(0.0, min(1.0, (c.check_ratio * a - b) / UNIT_PA))
        s.poppet += (pilot - s.poppet) * h / POPPET_S
    in_a = in_b = out_a = out_b = slope_a = slope_b = 0.0
    if s.opening > 0.0:
        in_a = s.inflow
        out_b, slope_b = meter_out(c.out_plus * s.opening * s.poppet, b, pump)
    elif s.opening < 0.0:
        in_b = s.inflow
        out_a, slope_a = meter_out(-c.out_minus * s.opening, a, pump)
    balance.energy_in += h * s.inflow * supply
    damp_a, damp_b = c.relaxation * volume_a / pump.bulk, c.relaxation * volume_b / pump.bulk
    s.pressure_a = chamber(
        a, stiff_a, c.area_a * speed - s.flow_a, in_a, supply, out_a, slope_a, b, damp_a, s.hose_a, pump, balance, h
    )
    s.pressure_b = chamber(
        b, stiff_b, -c.area_b * speed - s.flow_b, in_b, supply, out_b, slope_b, a, damp_b, s.hose_b, pump, balance, h
    )
    s.hose_a += h / STEADY_S * (s.pressure_a - s.hose_a)
    s.hose_b += h / STEADY_S * (s.pressure_b - s.hose_b)
    balance.loss += h * rub * speed
    s.travel += h * speed
    s.at += h * s.speed
    middle = 0.5 * (force + s.pressure_a * c.area_a - s.pressure_b * c.area_b)
    return s.arm * (middle - rub), stop


@njit(cache=True)
def look_up(c: FunctionConstants, table: Array, q: float) -> tuple[float, float]:
    """Look up (arm, travel from the lower end) of a lever at joint position ``q``; beyond its ends the arm stays."""
    at = (q - c.lever_low) / c.lever_step
    last = table.shape[1] - 2
    i = max(0, min(last, math.floor(at)))
    share = at - i
    inside = max(0.0, min(1.0, share))
    arm = table[0, i] + inside * (table[0, i + 1] - table[0, i])
    travel = table[1, i] + share * (table[1, i + 1] - table[1, i])
    return arm, travel


@njit(cache=True)
def begin(
    c: FunctionConstants,
    s: FunctionState,
    table: Array,
    q: float,
    qd: float,
    pump: Pump,
    balance: Balance,
    step_s: float,
) -> None:
    """Adopt the joint's real state: correct the pressures by the error of the prediction."""
    balance.energy_out += s.driven * (q - s.q)
    s.arm, travel = look_up(c, table, q)
    missed = travel - s.travel
    s.pressure_a -= pump.bulk * c.area_a * missed / (c.dead_volume + c.swept_a * travel)
    s.pressure_b += pump.bulk * c.area_b * missed / (c.dead_volume + c.swept_b * (c.stroke - travel))
    s.pressure_a, s.pressure_b = max(0.0, s.pressure_a), max(0.0, s.pressure_b)
    s.travel = travel
    s.outer = (qd - s.qd) / step_s - s.torque / c.inertia
    s.speed, s.at, s.q, s.qd = qd, q, q, qd
    s.torque = s.driven = 0.0


@njit(cache=True)
def cross_connect(
    left: FunctionState,
    right: FunctionState,
    constant: FunctionConstants,
    pump: Pump,
    h: float,
) -> float:
    """Let oil flow between equal chambers of an axle's swing arms by its float valve; return the power lost [W]."""
    stiff_a = stiff_b = 0.0
    for s in (left, right):
        stiff_a += h * pump.bulk / (constant.dead_volume + constant.swept_a * s.travel)
        stiff_b += h * pump.bulk / (constant.dead_volume + constant.swept_b * (constant.stroke - s.travel))
    drop_a, drop_b = left.pressure_a - right.pressure_a, left.pressure_b - right.pressure_b
    flow_a = FLOAT_M3_S_PA * drop_a / (1.0 + FLOAT_M3_S_PA * stiff_a)
    flow_b = FLOAT_M3_S_PA * drop_b / (1.0 + FLOAT_M3_S_PA * stiff_b)
    left.flow_a, right.flow_a = -flow_a, flow_a
    left.flow_b, right.flow_b = -flow_b, flow_b
    return flow_a * drop_a + flow_b * drop_b


@njit(cache=True)
def advance(
    constants: Records,
    states: Records,
    tables: Array,
    lines: Array,
    pumps: Records,
    balances: Records,
    floating: int,
    commands: Array,
    q: Array,
    qd: Array,
    step_s: float,
    substeps: int,
    torques: Array,
) -> float:
    """Advance one physics step.  ``floating``: index of the left arm of the axle whose float valve is open, or -1."""
    pump, balance = pumps[0], balances[0]
    h = step_s / substeps
    delayed = np.empty(len(states))
    for i in range(len(states)):
        c, s = constants[i], states[i]
        delayed[i] = lines[i, s.line_at]
        lines[i, s.line_at] = max(-1.0, min(1.0, commands[i]))
        s.line_at = (s.line_at + 1) % c.delay_steps
        begin(c, s, tables[i], q[i], qd[i], pump, balance, step_s)
        s.flow_a = s.flow_b = 0.0
    for _ in range(substeps):
        for i in range(len(states)):
            move_spool(constants[i], states[i], delayed[i], h)
        supply = share_flow(constants, states, pump, balance, h)
        if floating >= 0:
            lost = cross_connect(states[floating], states[floating + 1], constants[floating], pump, h)
            balance.loss += h * lost
        for i in range(len(states)):
            driven, stop = advance_function(constants[i], states[i], supply, pump, balance, h)
            states[i].driven += driven / substeps
            states[i].torque += (driven + stop) / substeps
    for i in range(len(states)):
        torques[i] = states[i].torque
    return supply
