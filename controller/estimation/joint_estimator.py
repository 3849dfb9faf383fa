"""Joint positions and velocities from quantised encoder counts: a steady-state Kalman filter per joint.

The model is a joint with white acceleration and an encoder with noise and rounding.  The gains are the fixed point of
the Riccati recursion, computed at start from the encoder's noise and resolution and the joint's acceleration limit, so
no gain is per cycle; a tick is two scalar recurrences.  A sample belongs to the moment of SYNC, not to the tick: it is
compared with the estimate extrapolated back to its stamp.  A sample that the joint cannot have reached is refused and
counted; three refusals within 100 ms are a fault (docs/reference/safety.md section 5, case 2), after which the filter
starts again.  The innovations tell whether the encoder has become noisy (`NoiseMonitor`).
"""

from __future__ import annotations

import cmath
import math
from typing import Final, Protocol

from controller.bus_io import MessageState, Signal
from machine.profile import CarrierValve, Encoder, Valve
from machine.sensing import EncoderScale

# -- Noise monitor: has an encoder become noisy, by what its profile says, or by what it was?  (docs/reference/safety.md
# case 4)
#
# Two means of the estimator's innovations.  The mean square of the innovation itself is compared with the noise of the
# profile: a data sheet allows more than a good device shows, and motion is in it, too, so only noise beyond all that is
# found.  The mean square of its second difference is the noise alone, without steady speeds and accelerations, and is
# compared with its own long mean: a device ten times better than its data sheet is found when it becomes ten times
# worse.  A single large sample counts for little, so that a knock at the steel is no noise.


PROFILE_RATIO: Final = 25.0
"""An encoder is noisy when the mean square of the innovation is this many times what its profile explains, ..."""
MEAN_S: Final = 0.25
"""... averaged over this time, ..."""
USUAL_RATIO: Final = 12.0
"""... or when the mean square of the second difference is this many times the usual one.  Ten times the noise is a
hundred times the square, of which `LEAST_SHARE` leaves 36; work without a fault reaches 6, of a telescope whose grapple
takes up a log (the nominal scenes of experiments/faults)."""
LEAST_SHARE: Final = 1.0 / 6.0
"""A device better than this share of its profile's noise sees the steel tremble: noise up to here is always usual."""
USUAL_S: Final = 30.0
"""The usual noise is the mean over this time, and over what there is of it at the start."""
_LEARNING_SHARE: Final = 0.01
"""The first hundred samples only teach what is usual."""
_QUIET_RATIO: Final = 3.0
"""Above this many times the usual nothing is learned, or a fault would teach its own noise before it is found, ..."""
_TAUGHT_RATIO: Final = 9.0
"""... and one sample teaches at most this many times the usual: three standard deviations."""
_CLIP_RATIO: Final = 4.0
"""One sample counts at most as this many times the limit: alone it moves the mean by a twelfth of the limit."""
_SECOND_DIFFERENCE: Final = 6.0
"""Variance of the second difference of white noise, over that of the noise."""
_ROUNDING: Final = 1.0 / 12.0
"""Variance of rounding in squared counts, ..."""
_TOSS_RATIO: Final = 3.0
"""... of which a joint that rests between two counts, as by tossing a coin, shows this many times, ..."""
_ROUNDING_RATIO: Final = 4.0
"""... and this many times, which is more, are allowed."""


class NoiseMonitor:
    """Monitors one encoder; ``noisy`` is the finding after `update`."""

    __slots__ = (
        "_allowed",
        "_before",
        "_before_that",
        "_gain",
        "_least",
        "_least_share",
        "_limit",
        "_max_innovation",
        "_mean",
        "_most",
        "_punctual",
        "_scatter",
        "_share",
        "_toss",
        "_usual",
        "noisy",
    )

    def __init__(
        self, noise: float, unit_per_count: float, innovation_ratio: float, period_s: float, punctual: bool = True
    ) -> None:
        """``noise`` is the profile's [unit]; the filter makes the variance of the innovation ``innovation_ratio`` times
        that of a sample.  Samples that are not ``punctual``, as a PLC passes them on, scatter by speed times lateness:
        they are compared with the profile alone."""
        rounding = _ROUNDING * unit_per_count**2
        self._max_innovation = PROFILE_RATIO * innovation_ratio * (noise**2 + rounding)
        made = _SECOND_DIFFERENCE * innovation_ratio
        self._least, self._most = made * (LEAST_SHARE * noise) ** 2, made * noise**2
        self._toss, self._allowed = made * _TOSS_RATIO * rounding, made * _ROUNDING_RATIO * rounding
        self._gain, self._least_share = -math.expm1(-period_s / MEAN_S), -math.expm1(-period_s / USUAL_S)
        self._usual, self._share = 0.0, 1.0
        self._punctual = punctual
        self.restart()

    def restart(self) -> None:
        """Start the estimator again; what is usual stays known."""
        self._mean = self._scatter = self._before = self._before_that = 0.0
        self._limit = self._max_innovation
        self.noisy = False

    def update(self, innovation: float) -> None:
        """Use the innovation of one sample [unit]."""
        difference = innovation - 2.0 * self._before + self._before_that
        self._before_that, self._before = self._before, innovation
        square = difference * difference
        usual = min(max(self._usual - self._toss, self._least), self._most)
        self._limit = limit = USUAL_RATIO * usual + self._allowed
        self._mean += self._gain * (innovation * innovation - self._mean)
        self._scatter += self._gain * (min(square, _CLIP_RATIO * limit) - self._scatter)
        learning = self._share > _LEARNING_SHARE
        if learning or self._scatter < _QUIET_RATIO * usual + self._toss:
            taught = square if learning else min(square, _TAUGHT_RATIO * (usual + self._toss))
            self._usual += self._share * (taught - self._usual)
            # Shares 1, 1/2, 1/3 and so on make the plain mean of the first samples.
            self._share = max(self._least_share, self._share / (1.0 + self._share))
        unusual = self._punctual and not learning and self._scatter > limit
        self.noisy = unusual or self._mean > self._max_innovation

    def share(self) -> float:
        """Compute what was measured over what is noise; 1 and more is noisy."""
        scatter = self._scatter / self._limit if self._punctual and self._share <= _LEARNING_SHARE else 0.0
        return max(scatter, self._mean / self._max_innovation)


# -- The estimator


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
    """Compute the variance of one sample [rad^2, m^2]: noise and rounding to whole counts."""
    return encoder.noise**2 + encoder.unit_per_count**2 / 12.0


def acceleration_density(spec: TrackedJoint) -> float:
    """Compute the spectral density of the joint's acceleration [(rad/s^2)^2 s, (m/s^2)^2 s]."""
    return (ACCELERATION_SHARE * spec.acceleration_limit) ** 2 * ACCELERATION_S


def steady_gains(period_s: float, density: float, variance: float) -> tuple[float, float]:
    """Compute the gains of position and velocity [-, 1/s] of the steady-state Kalman filter.

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
        "_alpha",
        "_beta",
        "_gate_speed",
        "_jump_stamps",
        "_measured",
        "_measured_ns",
        "_noise",
        "_period_s",
        "_predicted_ns",
        "_slack",
        "jumped",
        "known",
        "position",
        "refused",
        "velocity",
    )

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
        """Tell how noisy the encoder is, over what is a fault."""
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


DITHER_SHARE: Final = 0.3
"""An encoder whose noise is at least this share of a count does not give the same count for long: of 20 samples in the
middle of a count all agree with a probability of 13 % at this share, and of 1e-8 at one count."""


class SensedJoint:
    """A joint with an encoder on crane0: the newest sample of its message corrects the joint's estimate."""

    __slots__ = ("_counts", "_estimator", "_last", "_scale", "_state", "dithers", "unchanged")

    def __init__(self, state: MessageState, encoder: Encoder, estimator: JointEstimator) -> None:
        self._state, self._counts = state, Signal(state, "Position")
        self._scale, self._estimator = EncoderScale(encoder), estimator
        self._last = -1
        self.dithers = encoder.noise >= DITHER_SHARE * encoder.unit_per_count
        """Whether the same count again and again means that the encoder is frozen."""
        self.unchanged = 0
        """Samples in a row with the same count, after the first."""

    def update(self) -> None:
        """Use a sample of this tick; forget the estimate when the encoder's values are stale.  After `predict`."""
        state = self._state
        if state.fresh:
            counts = self._counts.value()
            self.unchanged = self.unchanged + 1 if counts == self._last else 0
            self._last = counts
            self._estimator.update(self._scale.position(counts), state.stamp_ns)
        elif state.values is None:
            self._estimator.reset()
            self.unchanged = 0
