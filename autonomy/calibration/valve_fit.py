"""Dead-band, hysteresis, gain and metering curve of one valve function, from its sweeps and staircases.

The model follows the construction of a spool valve (docs/reference/machines.md section 3): the measured spool passes
a play as wide as the hysteresis, a dead-band and a metering curve ``speed = full * opening^n``; a cylinder's lever
makes the joint faster or slower along its travel, and the oil between valve and joint is a spring that rings.  All
tests of both sides are fitted together, on positions, so that no noisy derivative is needed.  Least squares with a
soft loss; no randomness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

from autonomy.calibration.trace import FINE_FACTOR, GRID_S, SpoolTestRecord
from machine.joints import Joint
from machine.profile import JointSpec

EXPONENT, EXPONENT_SIGMA = 1.05, 0.05
"""Metering edges of compensated spools are nearly straight; the data decide within this deviation."""
HYSTERESIS, HYSTERESIS_SIGMA = 0.02, 0.02
LEVER_SIGMA: Final = 0.7
"""Standard deviation of a joint's relative change of speed per rad along a cylinder's lever; a gear and a telescope
have none."""
RESIDUAL_SCALE_S: Final = 0.004
"""Scale of the residuals, as time at the speed limit: residuals far above it are down-weighted."""
DECIMATION: Final = 2
"""The fit uses every second sample."""
_LEVER_JOINTS: Final = (Joint.LIFT, Joint.TILT)
_MAX_EVALUATIONS: Final = 60
PRIOR_WEIGHT: Final = 10.0
"""Weight of the prior against the data: neighbouring residuals are correlated, a hundred of them count as one."""
_PARAMETER_NAMES: Final = (
    "deadband_plus",
    "deadband_minus",
    "hysteresis",
    "exponent",
    "full_plus",
    "full_minus",
    "lever",
    "ring_rad_s",
    "ring_zeta",
    "lag_plus_s",
    "lag_minus_s",
)
_SPEED_NAMES: Final = ("speed_plus", "speed_minus")


@dataclass(frozen=True, slots=True)
class ValveFit:
    """The fitted parameters: shares of full command, speeds at full command and at joint position ``at`` (rad, m).

    ``ringing`` is the oil spring (rad/s, damping ratio), ``lags_s`` the delay of oil and pump between spool and joint,
    plus and minus side; ``residual`` the root mean square of the position residuals [rad, m]; ``modelled`` the fitted
    positions of every test, in order.  ``errors`` are standard errors by parameter name, and as ``speed_plus`` and
    ``speed_minus`` those of the speed limit's own speed, as shares: no test opens a fast valve further, so its full
    speed is a wide extrapolation, and nobody drives it there.
    """

    deadbands: tuple[float, float]
    hysteresis: float
    exponent: float
    full_speeds: tuple[float, float]
    lever: float
    at: float
    ringing: tuple[float, float]
    lags_s: tuple[float, float]
    residual: float
    modelled: tuple[np.ndarray, ...]
    errors: dict[str, float]


def apply_backlash(spool: np.ndarray, half: float) -> np.ndarray:
    """Compute the spool behind a play of twice ``half``; it was neutral before."""
    out, at = [], 0.0
    for x in spool.tolist():
        if x - half > at:
            at = x - half
        elif x + half < at:
            at = x + half
        out.append(at)
    return np.array(out)


class _TestModel:
    """One test, prepared for the model."""

    def __init__(self, test: SpoolTestRecord, reference: float) -> None:
        self.side = test.side
        spool = test.command if test.spool is None else test.spool
        self.spool = test.side * spool[::DECIMATION]
        self.step_s = GRID_S * DECIMATION
        self.position = test.position[::DECIMATION]
        self.along = self.position - reference
        self.start = float(np.mean(self.position[:10]))
        self._played: dict[float, np.ndarray] = {}

    def after_backlash(self, half: float) -> np.ndarray:
        """Return the spool behind its play; cached, because most evaluations of a gradient share it."""
        if half not in self._played:
            if len(self._played) > 3:
                self._played.clear()
            self._played[half] = apply_backlash(self.spool, half)
        return self._played[half]

    def model(self, p: np.ndarray) -> np.ndarray:
        """Compute the positions for the parameters `_PARAMETER_NAMES`."""
        side_index = 0 if self.side > 0 else 1
        deadband, full, lag_s = p[side_index], p[4 + side_index], p[9 + side_index]
        half = 0.5 * p[2]
        opening = np.clip((self.after_backlash(half) - deadband) / (1.0 - half - deadband), 0.0, 1.0)
        speed = self.side * full * (1.0 + p[6] * self.along) * opening ** p[3]
        travel = np.cumsum(speed) * self.step_s
        time = np.arange(len(travel)) * self.step_s
        b, a = _second_order_lag(p[7], p[8], self.step_s)
        result: np.ndarray = self.start + lfilter(b, a, np.interp(time - lag_s, time, travel))
        return result


def _second_order_lag(rad_s: float, zeta: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Design a second-order lag as a digital filter (bilinear)."""
    k = 2.0 / step_s
    normalizer = k * k + 2.0 * zeta * rad_s * k + rad_s * rad_s
    b = np.array([1.0, 2.0, 1.0]) * rad_s * rad_s / normalizer
    a = np.array(
        [1.0, (2.0 * rad_s**2 - 2.0 * k * k) / normalizer, (k * k - 2.0 * zeta * rad_s * k + rad_s**2) / normalizer]
    )
    return b, a


def fit_valve(tests: Sequence[SpoolTestRecord], spec: JointSpec) -> ValveFit:
    """Fit the valve of one joint to its tests (both sides, sweep and staircase each)."""
    joint = tests[0].joint
    at = float(np.mean([np.mean(t.position) for t in tests]))
    stretches = [_TestModel(t, at) for t in tests]
    valve = spec.valve
    start = np.array(
        [
            valve.deadband_plus_pct / 100.0,
            valve.deadband_minus_pct / 100.0,
            HYSTERESIS,
            EXPONENT,
            valve.full_speed_plus,
            valve.full_speed_minus,
            0.0,
            10.0,
            0.4,
            0.03,
            0.03,
        ]
    )
    full = start[4:6]
    low = np.array([0.005, 0.005, 0.0, 0.9, *(0.3 * full), -2.0, 2.0, 0.02, 0.0, 0.0])
    high = np.array([0.45, 0.45, 0.1, 1.6, *(3.0 * full), 2.0, 80.0, 3.0, 0.3, 0.3])
    scale = np.array([0.01, 0.01, 0.01, 0.1, *(0.1 * full), 0.3, 3.0, 0.2, 0.02, 0.02])
    noise = RESIDUAL_SCALE_S * spec.speed_limit
    lever = LEVER_SIGMA if joint in _LEVER_JOINTS else 1e-4

    def residuals(p: np.ndarray) -> np.ndarray:
        prior = [
            (p[2] - HYSTERESIS) / HYSTERESIS_SIGMA,
            (p[3] - EXPONENT) / EXPONENT_SIGMA,
            p[6] / lever,
        ]
        return np.concatenate([*((s.position - s.model(p)) / noise for s in stretches), np.array(prior) * PRIOR_WEIGHT])

    solution = least_squares(
        residuals, start, bounds=(low, high), x_scale=scale, loss="soft_l1", max_nfev=_MAX_EVALUATIONS
    )
    p = solution.x
    modelled = tuple(
        np.interp(t.time_s, t.time_s[::DECIMATION], s.model(p)) for t, s in zip(tests, stretches, strict=True)
    )
    errors = np.concatenate([t.position - m for t, m in zip(tests, modelled, strict=True)])
    return ValveFit(
        deadbands=(float(p[0]), float(p[1])),
        hysteresis=float(p[2]),
        exponent=float(p[3]),
        full_speeds=(float(p[4]), float(p[5])),
        lever=float(p[6]),
        at=at,
        ringing=(float(p[7]), float(p[8])),
        lags_s=(float(p[9]), float(p[10])),
        residual=float(np.sqrt(np.mean(errors**2))),
        modelled=modelled,
        errors=_standard_errors(solution, spec.speed_limit),
    )


def _standard_errors(found: Any, speed_limit: float) -> dict[str, float]:
    """Compute standard errors of the parameters from the curvature of the cost, for correlated residuals, and of the
    speeds.
    """
    names = (*_PARAMETER_NAMES, *_SPEED_NAMES)
    try:
        covariance = np.linalg.inv(found.jac.T @ found.jac)
    except np.linalg.LinAlgError:
        return dict.fromkeys(names, float("inf"))
    covariance *= 2.0 * found.cost / len(found.fun) * PRIOR_WEIGHT**2
    slopes = [_speed_slopes(found.x, first, speed_limit) for first in (0, 1)]
    variances = [*np.diag(covariance), *(slope @ covariance @ slope for slope in slopes)]
    return dict(zip(names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))


def _speed_slopes(p: np.ndarray, first: int, speed_limit: float) -> np.ndarray:
    """Compute the derivatives of the logarithm of a side's speed by the parameters, at the spool of the speed limit."""
    deadband, half, exponent, full = p[first], 0.5 * p[2], p[3], p[4 + first]
    opening = min(1.0, (speed_limit / full) ** (1.0 / exponent))
    rest = 1.0 - half - deadband
    edge = exponent / rest * (1.0 - 1.0 / opening)
    slopes = np.zeros(len(p))
    slopes[first], slopes[2], slopes[3], slopes[4 + first] = edge, 0.5 * edge, np.log(opening), 1.0 / full
    return slopes


def deadband_difference(fit: ValveFit, test: SpoolTestRecord) -> float:
    """Compute the difference between the dead-band of another test of that side and the fit's [share of full]; NaN if
    unclear.

    The test is not one of the fitted ones; all other parameters are taken from the fit.
    """
    stretch = _TestModel(test, fit.at)
    side_index = 0 if test.side > 0 else 1
    p = np.array([*fit.deadbands, fit.hysteresis, fit.exponent, *fit.full_speeds, fit.lever, *fit.ringing, *fit.lags_s])

    def misfit(shift: float) -> float:
        q = p.copy()
        q[side_index] += shift
        return float(np.sum((stretch.position - stretch.model(q)) ** 2))

    best = minimize_scalar(misfit, bounds=(-0.06, 0.06), method="bounded")
    return float(best.x) if abs(best.x) < 0.059 else float("nan")


# -- Dead time and lag of a valve's spool, from the commands on the bus and the spool positions of the valve node.
#
#     spool'' = w^2 (command(t - dead time) - spool) - 2 z w spool'          (docs/reference/machines.md section 3)
#
# ``delay_s`` is the pure dead time from the command's frame to the first motion of the spool; ``lag_s`` = 2 z / w
# is the delay of a moving spool beyond it.  Joints show neither cleanly, because pump and oil are between.
# `response_s` is the delay of the joint itself, from command to encoder, for the report.

MAX_DELAY_S: Final = 0.35
SPOOL_RESOLUTION: Final = 0.0005
"""Valve nodes report spools in steps of 0.05 %."""
_DELAY_GUESSES_S: Final = (0.04, 0.08, 0.12, 0.16, 0.2, 0.24)
MOVED_SHARE: Final = 0.2


@dataclass(frozen=True, slots=True)
class DelayFit:
    """Dead time and lag [s], their values from either side alone (plus, minus), and the residual [share of full]."""

    delay_s: float
    lag_s: float
    sides_s: tuple[float, float]
    residual: float


def fit_delay(tests: Sequence[SpoolTestRecord]) -> DelayFit | None:
    """Fit the staircases of both sides; None where the valve node reports no spools."""
    usable = [t for t in tests if t.spool is not None and float(np.ptp(t.spool)) > 0.02]
    if not usable:
        return None
    both = _fit(usable)
    sides = [_fit(chosen)[0] for side in (1, -1) if (chosen := [t for t in usable if t.side == side])]
    return DelayFit(both[0], both[1], (sides[0], sides[-1]), both[2])


def _fit(tests: Sequence[SpoolTestRecord]) -> tuple[float, float, float]:
    """Fit dead time and lag; return them and the residual."""
    step_s = GRID_S / FINE_FACTOR

    def residuals(p: np.ndarray) -> np.ndarray:
        out = []
        for t in tests:
            assert t.spool is not None
            command = t.fine_command
            time = np.arange(len(command)) * step_s
            delayed = np.interp(time - p[0], time, command, left=command[0])
            out.append(
                (t.spool - lfilter(*_spool_filter(p[1], p[2], step_s), delayed)[FINE_FACTOR - 1 :: FINE_FACTOR])
                / SPOOL_RESOLUTION
            )
        return np.concatenate(out)

    best = min(
        (
            least_squares(
                residuals,
                (start, 40.0, 0.8),
                bounds=((0.0, 10.0, 0.3), (MAX_DELAY_S, 150.0, 1.5)),
                x_scale=(0.01, 10.0, 0.2),
                loss="soft_l1",
                diff_step=1e-3,
                max_nfev=40,
            )
            for start in _DELAY_GUESSES_S
        ),
        key=lambda found: float(found.cost),
    )
    delay, omega, zeta = best.x
    misfit = residuals(best.x) * SPOOL_RESOLUTION
    return float(delay), float(2.0 * zeta / omega), float(np.sqrt(np.mean(misfit**2)))


def _spool_filter(omega: float, zeta: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Design the spool's second-order response as a digital filter (bilinear)."""
    k = 2.0 / step_s
    normalizer = k * k + 2.0 * zeta * omega * k + omega * omega
    b = np.array([1.0, 2.0, 1.0]) * omega * omega / normalizer
    a = np.array(
        [1.0, (2.0 * omega**2 - 2.0 * k * k) / normalizer, (k * k - 2.0 * zeta * omega * k + omega**2) / normalizer]
    )
    return b, a


def response_s(test: SpoolTestRecord, deadband: float) -> float:
    """Measure the time from the command that leaves the dead-band to the joint's first motion in a staircase, s; NaN if
    it never moves.

    The joint counts as moving once it has travelled `MOVED_SHARE` of its travel in the first 0.3 s of steady motion.
    """
    opened = np.flatnonzero(test.side * test.command > deadband)
    if not len(opened):
        return float("nan")
    travel = test.side * (test.position - float(np.mean(test.position[: max(1, opened[0])])))
    settled = min(len(travel) - 1, opened[0] + round(0.6 / GRID_S))
    before = max(opened[0], settled - round(0.3 / GRID_S))
    threshold = MOVED_SHARE * (travel[settled] - travel[before])
    moved = np.flatnonzero(travel[opened[0] :] > threshold)
    return float(moved[0] * GRID_S) if len(moved) else float("nan")
