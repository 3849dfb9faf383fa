"""Joint positions and velocities from quantised encoder counts: a steady-state Kalman filter per joint.

The model is a joint with white acceleration and an encoder with noise and rounding.  The gains are the fixed point of
the Riccati recursion, computed at start from the encoder's noise and resolution and the joint's acceleration limit, so
no gain is per cycle; a tick is two scalar recurrences.  A sample belongs to the moment of SYNC, not to the tick: it is
compared with the estimate extrapolated back to its stamp.  A sample that the joint cannot have reached is refused and
counted; three refusals within 100 ms are a fault (docs/reference/safety.md section 5, case 2), after which the filter
starts again.  The innovations tell whether the encoder has become noisy (`controller.estimation.noise_monitor`).
"""

from __future__ import annotations

import cmath
import math
from typing import Final, Protocol

from controller.estimation.noise_monitor import NoiseMonitor
from machine.profile import CarrierValve, Encoder, Valve

ACCELERATION_SHARE: Final = 1.0 / 3.0
"""Root mean square of the acceleration over the joint's limit, ..."""
ACCELERATION_S: Final = 0.1
"""... which lasts about this long: together the spectral density of the white acceleration."""
_JUMP_WINDOW_NS: Final = 100_000_000
_JUMP_LIMIT_COUNT: Final = 3
_NAN: Final = math.nan


class TrackedJoint(Protocol):
    """A joint for estimator and monitor: encoder, valve, limits [unit/s, unit/s^2]."""

    @property
    def encoder(self) -> Encoder | None: ...
    @property
    def valve(self) -> Valve | CarrierValve: ...
    @property
    def speed_limit(self) -> float: ...
    @property
    def acceleration_limit(self) -> float: ...


def measurement_variance(encoder: Encoder) -> float:
    """Variance of one sample [rad^2, m^2]: noise and rounding to whole counts."""
    return encoder.noise**2 + encoder.unit_per_count**2 / 12.0


def acceleration_density(spec: TrackedJoint) -> float:
    """Spectral density of the joint's acceleration [(rad/s^2)^2 s, (m/s^2)^2 s]."""
    return (ACCELERATION_SHARE * spec.acceleration_limit) ** 2 * ACCELERATION_S


def steady_gains(period_s: float, density: float, variance: float) -> tuple[float, float]:
    """Gains of position and velocity [-, 1/s] of the steady-state Kalman filter.

    Model: position += velocity T per period, driven by a white acceleration of spectral ``density``; a position is
    measured with ``variance`` every period.  The second differences of the measurements are a moving average of order
    two; its factor with zeros inside the unit circle is the filter's innovation form, so the zeros are its poles.
    """
    drive = density * period_s**3 / 6.0
    root = cmath.sqrt(drive * (drive - 24.0 * variance))
    complements = []  # one less each pole
    for w in ((root - drive) / (2.0 * variance), (-root - drive) / (2.0 * variance)):
        spread = cmath.sqrt(w + 0.25 * w * w)
        complements.append(max((-0.5 * w + spread, -0.5 * w - spread), key=lambda c: -abs(1.0 - c)))
    a, b = complements
    return (a + b - a * b).real, (a * b).real / period_s


class JointEstimator:
    """Tracks one joint; ``known`` is False until the first sample, and then position and velocity are NaN."""

    __slots__ = (
        "_alpha", "_beta", "_gate_speed", "_jump_stamps", "_measured", "_measured_ns", "_noise", "_period_s",
        "_predicted_ns", "_slack", "jumped", "known", "position", "refused", "velocity",
    )  # fmt: skip

    def __init__(self, spec: TrackedJoint, period_s: float, punctual: bool = True) -> None:
        """``period_s`` is that of the samples, ``punctual`` whether each was measured when its stamp says."""
        encoder, valve = spec.encoder, spec.valve
        self._alpha, self._beta = 1.0, 0.0
        self._slack = 0.0
        self._noise: NoiseMonitor | None = None
        if encoder is not None:
            variance = measurement_variance(encoder)
            self._alpha, self._beta = steady_gains(period_s, acceleration_density(spec), variance)
            # Variance of the innovation: that of the sample over one less the gain.
            ratio = 1.0 / (1.0 - self._alpha)
            self._noise = NoiseMonitor(encoder.noise, encoder.unit_per_count, ratio, period_s, punctual)
            self._slack = 4.0 * encoder.unit_per_count + 6.0 * encoder.noise
        self._period_s = period_s
        self._gate_speed = 3.0 * max(valve.full_speed_plus, valve.full_speed_minus, spec.speed_limit)
        self.refused = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the value is unknown again."""
        self.known = self.jumped = False
        self.position = self.velocity = self._measured = _NAN
        self._measured_ns = self._predicted_ns = 0
        self._jump_stamps = [-_JUMP_WINDOW_NS] * _JUMP_LIMIT_COUNT

    @property
    def noisy(self) -> bool:
        """Whether the samples scatter much more about the estimate than before, or than the profile explains."""
        return self._noise is not None and self._noise.noisy

    def noise_share(self) -> float:
        """How noisy the encoder is, over what is a fault."""
        return 0.0 if self._noise is None else self._noise.share()

    def predict(self, now_ns: int) -> None:
        """Extrapolate the estimate to ``now_ns``; once per tick, before `update`."""
        if self.known:
            self.position += self.velocity * (now_ns - self._predicted_ns) * 1e-9
        self._predicted_ns = now_ns

    def update(self, measured: float, stamp_ns: int) -> None:
        """Correct the estimate by a position measured at ``stamp_ns``, not after the last `predict`.

        The third refusal within 100 ms sets ``jumped``.
        """
        self.jumped = False
        if not self.known:
            self._start(measured, stamp_ns)
            return
        elapsed_s = (stamp_ns - self._measured_ns) * 1e-9
        if abs(measured - self._measured) > self._gate_speed * max(elapsed_s, 0.0) + self._slack:
            self.refused += 1
            stamps = self._jump_stamps
            stamps[self.refused % _JUMP_LIMIT_COUNT] = stamp_ns
            if stamp_ns - min(stamps) < _JUMP_WINDOW_NS:
                self.jumped = True
                self._start(measured, stamp_ns)
            return
        age_s = (self._predicted_ns - stamp_ns) * 1e-9
        residual = measured - (self.position - self.velocity * age_s)
        correction = self._beta * residual
        if self._noise is not None:
            self._noise.update(residual)
        self.velocity += correction
        self.position += self._alpha * residual + correction * age_s
        self._measured, self._measured_ns = measured, stamp_ns

    def _start(self, measured: float, stamp_ns: int) -> None:
        self.known = True
        self.position = self._measured = measured
        self.velocity = 0.0
        if self._noise is not None:
            self._noise.restart()
        self._measured_ns = stamp_ns
        for i in range(_JUMP_LIMIT_COUNT):
            self._jump_stamps[i] = stamp_ns - _JUMP_WINDOW_NS
