"""Linear models of the carrier's loops: heading to a waypoint, angle of the articulation, height of an arm.

Heading (docs/reference/machines.md section 7.2), linearized about straight ahead: ``psi = (lr s + v) / (L s^2)`` times
the articulation rate, and the bearing to a waypoint ``d`` metres ahead turns by ``v / (d s)`` times the heading, so
that the loop has three integrators near it.  Without valve and receiver it is L s^2 + Kp lr s + Kp v = 0.  The
receiver's heading is ``latency`` old.  Odometry covers the turn since the last sample, so only the age at reception is
missing, held for a sample.  Commands are sent every 20 ms.  The machines are those of the truth's spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import msgspec
import numpy as np

from controller.laws.drive import ANGLE_GAIN
from experiments.loop_design.loop import (
    FREQUENCY_RAD_S,
    TRANSPORT_S,
    Array,
    LawResponse,
    Margins,
    Spool,
    margins,
    open_loop,
)
from experiments.loop_design.study import CaseSet, JointStudy
from machine.profile import Carrier, JointSpec, Law, Profile, Valve

COMMAND_S: Final = 0.02
"""Period of VehCmd, ArmCmd and the measurements of the swing-arm controller."""
SAMPLE_S: Final = 0.1
LATENCIES_S: Final = (0.05, 0.1)
SPEED_SHARES: Final = (0.5, 1.0)
"""Speeds as shares of the cruising speed."""
DISTANCES_M: Final = (math.inf, 6.0, 3.0)
"""Distances to the waypoint: far, at the steering radius, and where the next waypoint is taken at the latest."""
SWING_RAD_S, SWING_ZETA = 25.0, 0.1
"""Assumed oscillation of the machine halves and tyres on the oil of the steering cylinders."""


@dataclass(frozen=True, slots=True)
class CarrierCase:
    """One machine at one operating point."""

    delay_s: float
    gain: float
    speed_m_s: float = 0.0
    distance_m: float = math.inf
    latency_s: float = 0.0

    def __str__(self) -> str:
        parts = [f"delay {1e3 * self.delay_s:.0f} ms, gain x{self.gain:.2f}"]
        if self.speed_m_s:
            far = "far" if math.isinf(self.distance_m) else f"{self.distance_m:.0f} m away"
            parts = [f"{self.speed_m_s:.2f} m/s, waypoint {far}, latency {1e3 * self.latency_s:.0f} ms", *parts]
        return ", ".join(parts)


@dataclass(frozen=True, slots=True)
class Swing:
    """Replaces a joint's mechanics by one mode (`experiments.loop_design.mechanics.Mechanics`)."""

    def response(self, s: Array) -> Array:
        """Compute the angle over metered travel."""
        w = SWING_RAD_S
        return w * w / (s * s + 2.0 * SWING_ZETA * w * s + w * w)

    def oil(self, s: Array) -> Array:
        """Return zero: no sensor measures this pressure."""
        return 0.0 * s


def studies(profile: Profile, work: CaseSet) -> list[JointStudy]:
    """Study all loops of the carrier with the gains of the profile; none for a machine without a carrier."""
    carrier = profile.carrier
    if carrier is None:
        return []
    period_s = 1.0 / profile.rate_hz
    return [_heading(carrier, work), _angle(carrier, work, period_s, 0.6 * period_s), _arm(carrier, work)]


def natural(carrier: Carrier, speed_m_s: float) -> tuple[float, float]:
    """Compute (natural frequency [rad/s], damping ratio) of the heading loop without valve and receiver."""
    base = carrier.front_axle_m + carrier.rear_axle_m
    w = math.sqrt(carrier.heading_kp_1_s * speed_m_s / base)
    return w, 0.5 * carrier.heading_kp_1_s * carrier.rear_axle_m / (base * w)


def _hold(s: Array, period_s: float) -> Array:
    return (1.0 - np.exp(-s * period_s)) / (s * period_s)


def heading_loop(carrier: Carrier, spool: Spool, case: CarrierCase) -> Array:
    """Compute the open-loop response of paper B's law, cut at the commanded articulation rate."""
    s, v = 1j * FREQUENCY_RAD_S, case.speed_m_s
    base = carrier.front_axle_m + carrier.rear_axle_m
    bends = _hold(s, COMMAND_S) * np.exp(-s * TRANSPORT_S) * spool.response(s) * Swing().response(s)
    turns = (carrier.rear_axle_m * s + v) / (base * s * s)
    missing = _hold(s, SAMPLE_S) * (1.0 - np.exp(-s * case.latency_s))
    loop: Array = carrier.heading_kp_1_s * bends * turns * (1.0 - missing) * (1.0 + v / case.distance_m / s)
    return loop


def arm_loop(carrier: Carrier, spool: Spool) -> Array:
    """Compute the open-loop response of the height of one arm, cut at the commanded speed."""
    s = 1j * FREQUENCY_RAD_S
    measured = _hold(s, COMMAND_S) * np.exp(-s * TRANSPORT_S)
    loop: Array = carrier.arm_kp_1_s * _hold(s, COMMAND_S) * np.exp(-s * TRANSPORT_S) * spool.response(s) / s * measured
    return loop


def angle_spec(carrier: Carrier) -> JointSpec:
    """Describe the articulation and its law as a joint specification."""
    valve, rate = carrier.steer_valve, carrier.articulation_rate_limit_rad_s
    reaction_s = valve.delay_s + carrier.articulation_lag_s
    same = Valve(
        "",
        1,
        valve.deadband_plus_pct,
        valve.deadband_minus_pct,
        valve.full_speed_plus,
        valve.full_speed_minus,
        valve.delay_s,
        carrier.articulation_lag_s,
        1e-3,
        1e-3,
    )
    limit, law = carrier.articulation_limit_rad, _proportional(ANGLE_GAIN / reaction_s)
    lag_s = carrier.articulation_lag_s
    return JointSpec("revolute", -limit, limit, rate, rate / lag_s, carrier.articulation_encoder, same, law)


def _proportional(kp_1_s: float) -> Law:
    return Law("pd", kp_1_s, kd=0.0, layer=0.1, damping_per_bar=0.0, stop_band=0.001, velocity_filter_s=0.03)


def _heading(carrier: Carrier, work: CaseSet) -> JointStudy:
    valve = work.valves["steer"]
    cases = [
        CarrierCase(delay, gain, share * carrier.cruise_speed_m_s, distance, latency)
        for delay, gain, share, distance, latency in product(
            work.delays_s, work.gains, SPEED_SHARES, DISTANCES_M, LATENCIES_S
        )
    ]
    loops = [heading_loop(carrier, replace(valve, delay_s=c.delay_s, gain=c.gain), c) for c in cases]
    case_margins = [
        margins(FREQUENCY_RAD_S, loop, 2 if math.isinf(c.distance_m) else 3)
        for loop, c in zip(loops, cases, strict=True)
    ]
    usual = CarrierCase(valve.delay_s, 1.0, carrier.cruise_speed_m_s, math.inf, LATENCIES_S[-1])
    law = _proportional(carrier.heading_kp_1_s)
    spec = msgspec.structs.replace(angle_spec(carrier), law=law)
    loop = heading_loop(carrier, valve, usual)
    return _made("heading", spec, margins(FREQUENCY_RAD_S, loop, 2), loop, cases, case_margins, loops)


def _angle(carrier: Carrier, work: CaseSet, period_s: float, lead_s: float) -> JointStudy:
    valve, spec, s = work.valves["steer"], angle_spec(carrier), 1j * FREQUENCY_RAD_S
    law = LawResponse(spec, period_s, lead_s)

    def loop(delay_s: float, gain: float) -> Array:
        spool = replace(valve, delay_s=delay_s, gain=gain)
        return open_loop(s, spec, law, Swing(), spool, COMMAND_S)  # type: ignore[arg-type]

    cases = [CarrierCase(delay, gain) for delay, gain in product(work.delays_s, work.gains)]
    loops = [loop(c.delay_s, c.gain) for c in cases]
    usual = loop(valve.delay_s, 1.0)
    case_margins = [margins(FREQUENCY_RAD_S, each) for each in loops]
    return _made("articulation", spec, margins(FREQUENCY_RAD_S, usual), usual, cases, case_margins, loops)


def _arm(carrier: Carrier, work: CaseSet) -> JointStudy:
    valve = work.valves["arm_fl"]
    cases = [CarrierCase(delay, gain) for delay, gain in product(work.delays_s, work.gains)]
    loops = [arm_loop(carrier, replace(valve, delay_s=c.delay_s, gain=c.gain)) for c in cases]
    spec = msgspec.structs.replace(angle_spec(carrier), law=_proportional(carrier.arm_kp_1_s))
    usual = arm_loop(carrier, valve)
    case_margins = [margins(FREQUENCY_RAD_S, each) for each in loops]
    return _made("swing arm", spec, margins(FREQUENCY_RAD_S, usual), usual, cases, case_margins, loops)


def _made(
    name: str,
    spec: JointSpec,
    nominal: Margins,
    nominal_loop: Array,
    cases: Sequence[CarrierCase],
    case_margins: Sequence[Margins],
    loops: Sequence[Array],
) -> JointStudy:
    worst = min(range(len(cases)), key=lambda i: case_margins[i].gain_db)
    return JointStudy(name, spec, nominal, nominal_loop, tuple(cases), tuple(case_margins), loops[worst])
