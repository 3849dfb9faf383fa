"""Frequency response of the control loop of one joint: valve, mechanics, sensors, estimator and law, cut at the
command.

The controller is modelled as it runs: sampled, with the gains that its own code computes (`controller.crane.estimator`,
`controller.laws`).  `tests/experiments/test_loop_design.py` excites that code with sines and compares.  The laws are
linear inside their boundary layer; super-twisting is not, so its gain over the amplitude is a range (``amplitude``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from controller.estimation.joint_estimator import acceleration_density, measurement_variance, steady_gains
from controller.laws.feedback import (
    ESTIMATING,
    ESTIMATING_SHARE,
    INTEGRAL_SHARE,
    PLAIN_PERIOD_S,
    PLAIN_SHARE,
    REACHING_SHARE,
)
from controller.laws.joint import PRESSURE_MEAN_S, PRESSURE_SMOOTH_S
from experiments.loop_design.mechanics import Mechanics
from machine.profile import JointSpec

FREQUENCY_RAD_S: Final = np.geomspace(0.05, 80.0, 700)
TRANSPORT_S: Final = 1.0e-3
"""Delay from the decision of the tick until the valve node has the command."""
SENSOR_S: Final = 2.5e-3
"""Age of a position when the encoder samples it."""
PA_PER_BAR: Final = 1.0e5

Array = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True, slots=True)
class Spool:
    """The true valve: dead time, gain relative to the profile, second-order spool."""

    delay_s: float
    gain: float
    rad_s: float
    zeta: float

    def response(self, s: Array) -> Array:
        """Compute the metered speed over commanded speed."""
        w = self.rad_s
        lag = w * w / (s * s + 2.0 * self.zeta * w * s + w * w)
        return self.gain * np.exp(-s * self.delay_s) * lag


class LawResponse:
    """Response of one joint's controller: velocity command over position and load pressure, without their sign."""

    def __init__(self, spec: JointSpec, period_s: float, lead_s: float, amplitude: float = 1.0) -> None:
        """Take ``lead_s``, SYNC's time before the tick, and ``amplitude``, error over the layer, for super-twisting."""
        self._spec, self._period_s, self._lead_s, self._amplitude = spec, period_s, lead_s, amplitude

    def response(self, s: Array) -> tuple[Array, Array]:
        """Compute (command over measured position [1/s], command over load pressure [unit/s per bar]) at the tick."""
        spec, t = self._spec, self._period_s
        law, back = spec.law, np.exp(-s * t)
        position, velocity = self._estimate(s, back)
        feedback, rate = self._feedback(t / (1.0 - back))
        length = max(1, round((spec.valve.delay_s + spec.valve.lag_s) / t))
        flying = t * back * (1.0 - back**length) / (1.0 - back)
        smooth, mean = (_low_pass(t / tau, back) for tau in (PRESSURE_SMOOTH_S, PRESSURE_MEAN_S))
        if law.kind == "pd_plain":
            held = max(1, round(PLAIN_PERIOD_S / t))
            hold = sum(back**k for k in range(held)) / held
            return hold * (feedback * position + rate * velocity), 0.0 * s
        predicted = 1.0 + feedback * flying
        to_load = law.damping_per_bar * smooth * (1.0 - mean)
        return (feedback * position + rate * velocity) / predicted, to_load / predicted

    def _estimate(self, s: Array, back: Array) -> tuple[Array, Array]:
        """Compute the estimated position and velocity over the position at SYNC."""
        spec, t, age = self._spec, self._period_s, self._lead_s
        assert spec.encoder is not None
        alpha, beta = steady_gains(t, acceleration_density(spec), measurement_variance(spec.encoder))
        velocity = beta / (1.0 - back)
        position = (back * t * velocity + alpha + beta * age) / (1.0 - back)
        innovation = np.exp(-s * age) / (1.0 + back * position + back * (t - age) * velocity)
        return position * innovation, velocity * innovation

    def _feedback(self, summed: Array) -> tuple[Array, float]:
        """Compute the gain on the predicted error over frequency [1/s], and on the error rate."""
        law = self._spec.law
        kp = law.kp_1_s
        if law.kind == "pd":
            return kp + 0.0 * summed, law.kd
        if law.kind == "pd_plain":
            return PLAIN_SHARE * kp + 0.0 * summed, law.kd
        integral = INTEGRAL_SHARE * kp * kp * summed
        if law.kind == ESTIMATING:
            kp *= 1.0 - REACHING_SHARE + ESTIMATING_SHARE
        if law.kind == "super_twisting":
            kp *= 1.0 - REACHING_SHARE * (1.0 - math.sqrt(self._amplitude))
        return kp + integral, law.kd


def open_loop(
    s: Array, spec: JointSpec, law: LawResponse, mechanics: Mechanics, spool: Spool, period_s: float
) -> Array:
    """Compute the response of the loop with negative feedback, cut at the velocity command."""
    hold = (1.0 - np.exp(-s * period_s)) / (s * period_s)
    travel = hold * np.exp(-s * TRANSPORT_S) * spool.response(s) / s
    moved = mechanics.response(s)
    carried = mechanics.oil(s) * (1.0 - moved) / (spec.valve.flow_plus * PA_PER_BAR)
    to_position, to_load = law.response(s)
    return travel * (to_position * np.exp(-s * SENSOR_S) * moved + to_load * np.exp(-s * period_s / 2.0) * carried)


def _low_pass(share: float, back: Array) -> Array:
    return share / (1.0 - (1.0 - share) * back)


@dataclass(frozen=True, slots=True)
class Margins:
    """Phase margin [deg], gain margin [dB] and the highest frequency with gain 1 [rad/s]."""

    phase_deg: float
    gain_db: float
    crossover_rad_s: float


def margins(frequency_rad_s: Array, loop: Array, integrators: int = 1) -> Margins:
    """Compute the least margins of a loop that starts with this number of integrators, from its response on a fine
    grid.

    Every crossing of the unit circle and of the negative real axis counts.  An encirclement appears as a negative
    margin.  Where the phase returns over the axis with a gain above 1, the margin is towards less gain.
    """
    log_gain, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    phase -= 2.0 * math.pi * round((phase[0] + integrators * math.pi / 2.0) / (2.0 * math.pi))
    at_one, one_phase = _crossings(frequency_rad_s, log_gain, phase)
    # Distance of the crossings from the nearest odd multiple of 180 deg; a value below the first shows an encirclement.
    nearest = one_phase + math.pi
    nearest = np.where(nearest < 0.0, nearest, np.abs(nearest - 2.0 * math.pi * np.round(nearest / (2.0 * math.pi))))
    least_gain = math.inf
    for turn in range(4):
        axis = phase + (2 * turn + 1) * math.pi
        _, gains = _crossings(frequency_rad_s, axis, log_gain)
        back = np.diff(axis)[np.nonzero(np.signbit(axis[:-1]) != np.signbit(axis[1:]))[0]] > 0.0
        least_gain = min([least_gain, *np.where(back, np.abs(gains), -gains)])
    return Margins(
        float(np.degrees(min(nearest, default=math.inf))),
        float(20.0 * least_gain / math.log(10.0)),
        float(max(at_one, default=0.0)),
    )


def _crossings(x: Array, y: Array, other: Array) -> tuple[Array, Array]:
    """Find the zero crossings of ``y``: ``x`` and ``other`` there, by linear interpolation."""
    i = np.nonzero(np.signbit(y[:-1]) != np.signbit(y[1:]))[0]
    share = y[i] / (y[i] - y[i + 1])
    return x[i] + share * (x[i + 1] - x[i]), other[i] + share * (other[i + 1] - other[i])
