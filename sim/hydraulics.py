"""Load-sensing hydraulics of slew, lift, tilt and telescope: compressible chambers driving the joints by torque.

plant.md 2: valve with dead time, second-order spool and dead-band; pressure-compensated metering in and out, so a
lowered load runs at valve speed and a neutral valve holds it; shared pump flow; chambers never below zero; friction;
damping orifices that let only oscillating pressure pass.  One ``step`` covers one physics step in substeps.  Units: SI.
"""

from __future__ import annotations

import math
from collections import deque

from sim.crane import ACTIVE
from sim.truth import Cylinder, Supply, Truth, ValveTruth

SOFT_PA = 0.2e6
UNIT_PA = 1.0e6
STEADY_S = 0.15  # what lasts longer than this is a load, not an oscillation


def orifice(drop_pa: float) -> float:
    """Flow factor of an edge over its pressure drop: 1 near 1 MPa, ~ square root beyond SOFT_PA."""
    return drop_pa / math.sqrt(UNIT_PA * (abs(drop_pa) + SOFT_PA))


class ValveSpool:
    """Command in [-1, 1] -> effective opening in [-1, 1] after dead time, spool dynamics and dead-band."""

    def __init__(self, truth: ValveTruth, step_s: float) -> None:
        self._t = truth
        self._line = deque([0.0] * max(1, round(truth.delay_s / step_s)))
        self.position = 0.0
        self._speed = 0.0

    def delayed(self, command: float) -> float:
        """Push one physics step's command in, take the delayed one out."""
        self._line.append(max(-1.0, min(1.0, command)))
        return self._line.popleft()

    def advance(self, command: float, h: float) -> float:
        """Spool dynamics over ``h`` seconds; returns the opening behind the dead-band."""
        t = self._t
        w = t.spool_rad_s
        self._speed += h * (w * w * (command - self.position) - 2.0 * t.spool_zeta * w * self._speed)
        self.position += h * self._speed
        x = max(-1.0, min(1.0, self.position))
        if x > t.deadband_plus:
            return (x - t.deadband_plus) / (1.0 - t.deadband_plus)
        if x < -t.deadband_minus:
            return (x + t.deadband_minus) / (1.0 - t.deadband_minus)
        return 0.0


class Lever:
    """Lever arm dx/dq and piston travel over the joint position, on a uniform grid."""

    def __init__(self, cylinder: Cylinder, points: int = 129) -> None:
        at, arm = cylinder.arm_at, cylinder.arm
        self.low, self._dq = at[0], (at[-1] - at[0]) / (points - 1)
        self._arm, self._travel = [], [0.0]
        j = 0
        for i in range(points):
            q = self.low + i * self._dq
            while j < len(at) - 2 and q > at[j + 1]:
                j += 1
            self._arm.append(arm[j] + (arm[j + 1] - arm[j]) * (q - at[j]) / (at[j + 1] - at[j]))
        for a, b in zip(self._arm, self._arm[1:], strict=False):
            self._travel.append(self._travel[-1] + (a + b) / 2 * self._dq)
        self.stroke = self._travel[-1]
        self._last = points - 2

    def at(self, q: float) -> tuple[float, float]:
        """(arm, travel from the lower end) at joint position q."""
        f = (q - self.low) / self._dq
        i = max(0, min(self._last, int(f)))
        f = max(0.0, min(1.0, f - i))
        a0, x0 = self._arm[i], self._travel[i]
        return a0 + f * (self._arm[i + 1] - a0), x0 + f * (self._travel[i + 1] - x0)


class Actuator:
    """One double-acting cylinder (or slew drive): chambers A (pushes the joint positive) and B."""

    def __init__(self, cylinder: Cylinder, valve: ValveTruth, supply: Supply, step_s: float) -> None:
        self.cylinder, self._supply = cylinder, supply
        self.spool = ValveSpool(valve, step_s)
        self.lever = Lever(cylinder)
        full = orifice(supply.pressure_margin_pa)
        self._gain_plus = cylinder.area_a * cylinder.arm_nominal * valve.full_speed_plus / full
        self._gain_minus = cylinder.area_b * cylinder.arm_nominal * valve.full_speed_minus / full
        # Metering out lets a little more oil pass than metering in brings, or back pressure would build up.
        self._out_plus = 1.05 * self._gain_plus * cylinder.area_b / cylinder.area_a
        self._out_minus = 1.05 * self._gain_minus * cylinder.area_a / cylinder.area_b
        self.pressure_a = self.pressure_b = supply.tank_pa
        self.opening = 0.0
        self._slow_a = self._slow_b = supply.tank_pa

    def hold(self, torque: float, q: float) -> None:
        """Set the pressures that carry ``torque`` [Nm] at joint position ``q`` at rest."""
        c = self.cylinder
        arm, _ = self.lever.at(q)
        pressure = 1.0e6
        self.pressure_b = pressure + max(0.0, -torque / arm / c.area_b)
        self.pressure_a = pressure * c.area_b / c.area_a + max(0.0, torque / arm / c.area_a)
        self._slow_a, self._slow_b = self.pressure_a, self.pressure_b

    def load_pressure(self) -> float:
        """What the load-sensing line reports."""
        return self.pressure_a if self.opening > 0.0 else self.pressure_b if self.opening < 0.0 else 0.0

    def demand(self, supply_pa: float) -> float:
        """Flow [m^3/s] this function would take from the pump now."""
        if self.opening == 0.0:
            return 0.0
        gain = self._gain_plus if self.opening > 0.0 else self._gain_minus
        drop = min(supply_pa - self.load_pressure(), self._supply.pressure_margin_pa)
        return gain * abs(self.opening) * max(0.0, orifice(drop))

    def advance(self, h: float, inflow: float, travel: float, speed: float) -> float:
        """Chamber pressures over ``h`` seconds at piston speed [m/s]; returns the force before friction [N]."""
        c, s = self.cylinder, self._supply
        beta = s.bulk_modulus_pa
        volume_a = c.dead_volume_m3 + c.area_a * travel
        volume_b = c.dead_volume_m3 + c.area_b * (self.lever.stroke - travel)
        a, b, opening = self.pressure_a, self.pressure_b, self.opening
        flow_a = flow_b = slope_a = slope_b = 0.0
        if opening > 0.0:
            flow_a = inflow
            flow_b, slope_b = self._meter_out(self._out_plus * opening, b)
        elif opening < 0.0:
            flow_b = inflow
            flow_a, slope_a = self._meter_out(-self._out_minus * opening, a)
        # Damping orifices: oscillating pressure decays with relaxation_1_s, a steady load stays.
        damp_a = c.relaxation_1_s * volume_a / beta
        damp_b = c.relaxation_1_s * volume_b / beta
        flow_a -= damp_a * (a - self._slow_a)
        flow_b -= damp_b * (b - self._slow_b)
        leak = s.leakage_m3_s_pa
        ka, kb = h * beta / volume_a, h * beta / volume_b
        a += ka * (flow_a - c.area_a * speed - leak * (a - b)) / (1.0 + ka * (slope_a + damp_a + leak))
        b += kb * (flow_b + c.area_b * speed + leak * (a - b)) / (1.0 + kb * (slope_b + damp_b + leak))
        top = 1.25 * s.relief_pa
        self.pressure_a = a = max(0.0, min(top, a))
        self.pressure_b = b = max(0.0, min(top, b))
        self._slow_a += h / STEADY_S * (a - self._slow_a)
        self._slow_b += h / STEADY_S * (b - self._slow_b)
        return a * c.area_a - b * c.area_b

    def _meter_out(self, gain: float, pressure: float) -> tuple[float, float]:
        """Flow out of a chamber through its compensated edge (negative) and its slope over pressure."""
        s = self._supply
        drop = min(pressure - s.tank_pa, s.pressure_margin_pa)
        slope = gain / math.sqrt(UNIT_PA * (abs(drop) + SOFT_PA)) if drop < s.pressure_margin_pa else 0.0
        return -gain * orifice(drop), slope


class Hydraulics:
    """The four cylinder functions on one pump."""

    def __init__(self, truth: Truth, step_s: float, substeps: int = 2) -> None:
        self._supply = truth.supply
        self._h, self._n = step_s / substeps, substeps
        self.actuators = [Actuator(truth.cylinders[n], truth.valves[n], truth.supply, step_s) for n in ACTIVE]
        self.supply_pa = truth.supply.pressure_margin_pa
        self.flow_limited = False
        self.energy_j = 0.0
        self.peak_pa = 0.0

    def step(self, commands: list[float], q: list[float], qd: list[float]) -> list[float]:
        """Mean joint torques over one physics step.

        Commands in [-1, 1], positions and velocities, all in ACTIVE order.
        """
        s, h = self._supply, self._h
        total = [0.0] * len(self.actuators)
        delayed = [a.spool.delayed(u) for a, u in zip(self.actuators, commands, strict=True)]
        motion = []
        for a, x, v in zip(self.actuators, q, qd, strict=True):
            arm, travel = a.lever.at(x)
            c, speed = a.cylinder, arm * v
            motion.append((arm, travel, speed, c.coulomb * math.tanh(speed / c.coulomb_speed) + c.viscous * speed))
        for sub in range(self._n):
            load = 0.0
            for a, u in zip(self.actuators, delayed, strict=True):
                a.opening = a.spool.advance(u, h)
                load = max(load, a.load_pressure())
            self.supply_pa = min(load + s.pressure_margin_pa, s.relief_pa)
            demands = [a.demand(self.supply_pa) for a in self.actuators]
            wanted = sum(demands)
            share = min(1.0, s.pump_flow_m3_s / wanted) if wanted > 0.0 else 1.0
            self.flow_limited = share < 1.0
            self.energy_j += h * self.supply_pa * wanted * share
            for i, a in enumerate(self.actuators):
                arm, travel, speed, friction = motion[i]
                force = a.advance(h, share * demands[i], travel + sub * h * speed, speed) - friction
                total[i] += arm * force / self._n
                self.peak_pa = max(self.peak_pa, a.pressure_a, a.pressure_b)
        return total
