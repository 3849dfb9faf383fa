"""Zero offsets of the encoders and compliance of the column, from surveyed positions of the hanger pin.

A surveying instrument measures the pin; the encoders give its computed position; the pressures of the lift cylinder
give the moment of the crane's weight.  One least-squares fit determines the zeros of slew, lift, tilt and telescope,
and

    moment at the lift joint [Nm] = head * (r_head - a1) + pin * (r_pin - a1)
    lean of the column [rad]      = give * (head * r_head + pin * r_pin) - rest

with r_head and r_pin the horizontal distances of stick pin and hanger pin from the slew axis: the weights of boom,
stick and grapple act there, and the same weights bend the column.  A leaning column and a boom with a zero offset
look nearly alike; the moments separate them, and the compliance ``give`` [rad/Nm] predicts the lean under a load.
Without pressures, head and pin of the lean are fitted directly, and the effect of loads stays unknown.  The column's
compliance to the side (roll) shows only under a load off the crane's plane: an empty grapple cannot reveal it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist, isfinite, nan
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from machine.geometry.kinematics import Point
from machine.geometry.sag import true_pin
from machine.joints import N_JOINTS, Joint
from machine.profile import Kinematics, Sag
from machine.sensing import empty_moment_nm
from runtime.errors import InputRefused

OFFSETS: Final = (Joint.SLEW, Joint.LIFT, Joint.TILT, Joint.EXT)
PIN_SIGMA_M: Final = 0.002
"""Standard deviation of one surveyed position; the caller averages several readings at one pose."""
OFFSET_SIGMA: Final = (0.07, 0.02, 0.02, 0.02)
"""Zero offsets of an unsurveyed machine [rad, m] (docs/reference/machines.md sections 1.6 and 14)."""
LEAN_SIGMA: Final = 0.01
"""Standard deviation of each of the two lean terms [rad/m]: 0.1 m of sag at full reach."""
REST_SIGMA: Final = 0.05
MOMENT_SIGMA_NM: Final = 600.0
"""Standard deviation of one moment by pressures: a resting cylinder holds up to its friction either way."""
WEIGHT_SIGMA_N: Final = 2e4
"""Standard deviation of each of the two terms of the moment: two tons at either pin."""
USUAL_COMPLIANCE_RAD_NM: Final = 1e-6
"""Compliance of a usual column, and its standard deviation."""
USUAL_PARAMETERS: Final = (1.0, 0.01, 6e3, 8e3)
"""Compliance, rest, head and pin of a usual crane, for choosing the poses of a survey."""
MIN_POSES: Final = 5


@dataclass(frozen=True, slots=True)
class SurveyReading:
    """One pose: the encoders' positions (``Joint`` order, rad and m), the surveyed pin (base frame, m), and the
    moment by the lift cylinder's pressures [Nm], NaN without pressure sensors.
    """

    position: tuple[float, ...]
    pin_m: Point
    moment_nm: float = nan


@dataclass(frozen=True, slots=True)
class SurveyFit:
    """The offsets to subtract from the encoders (`OFFSETS` order: rad, rad, rad, m) and the crane's sag.

    ``errors`` are standard errors of the offsets.  ``before_m`` and ``after_m`` are the distances between surveyed and
    computed pin at every pose, without and with the fit; ``moments_nm`` are the residuals of the moments, empty without
    pressures.
    """

    offsets: tuple[float, float, float, float]
    sag: Sag
    errors: tuple[float, float, float, float]
    before_m: tuple[float, ...]
    after_m: tuple[float, ...]
    moments_nm: tuple[float, ...]


def _sag(p: Sequence[float]) -> Sag:
    """Return the sag of the parameters after the offsets.

    Three parameters are the lean itself: head, pin, rest.  Four tie it to the moment: compliance
    [`USUAL_COMPLIANCE_RAD_NM`], rest, and head and pin of the moment.
    """
    if len(p) == 3:
        return Sag(p[0], p[1], p[2])
    give = p[0] * USUAL_COMPLIANCE_RAD_NM
    return Sag(give * p[2], give * p[3], p[1], give, p[2], p[3])


def _corrected(position: Sequence[float], offsets: Sequence[float]) -> list[float]:
    q = list(position[:N_JOINTS])
    for j, offset in zip(OFFSETS, offsets, strict=True):
        q[j] -= offset
    return q


def _prior_sigma(weighed: bool) -> np.ndarray:
    """Return the standard deviations of the parameters on an unsurveyed machine."""
    lean = (1.0, REST_SIGMA, WEIGHT_SIGMA_N, WEIGHT_SIGMA_N) if weighed else (LEAN_SIGMA, LEAN_SIGMA, REST_SIGMA)
    return np.array([*OFFSET_SIGMA, *lean])


def _misfit(kin: Kinematics, readings: Sequence[SurveyReading], p: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the residuals of the pins (n, 3) [m] and of the moments [Nm]."""
    sag, shown = _sag(p[4:]), [_corrected(r.position, p[:4]) for r in readings]
    pins = np.array([r.pin_m for r in readings]) - np.array([true_pin(sag, kin, q) for q in shown])
    moments = [r.moment_nm - empty_moment_nm(sag, kin, q) for r, q in zip(readings, shown, strict=True)]
    return pins, np.array(moments)


def fit_survey(kin: Kinematics, readings: Sequence[SurveyReading], known: Sag | None = None) -> SurveyFit:
    """Fit offsets and sag to at least `MIN_POSES` readings.

    ``known``: the sag in the present profile; only ``before_m`` depends on it.

    Raises:
        InputRefused: there are too few readings.
    """
    if len(readings) < MIN_POSES:
        raise InputRefused(
            "survey.too-few-poses",
            f"{len(readings)} surveyed poses are too few; survey {MIN_POSES} or more, far apart",
        )
    weighed = all(isfinite(r.moment_nm) for r in readings)
    spread = _prior_sigma(weighed)
    start = np.zeros(len(spread))
    if weighed:
        start[4], start[6:] = 1.0, 0.2 * WEIGHT_SIGMA_N

    def residuals(p: np.ndarray) -> np.ndarray:
        pins, moments = _misfit(kin, readings, p.tolist())
        parts = [pins.ravel() / PIN_SIGMA_M, (p - start) / spread]
        return np.concatenate([*parts, moments / MOMENT_SIGMA_NM] if weighed else parts)

    solution = least_squares(residuals, start, x_scale=spread)
    errors = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    after, moments = _misfit(kin, readings, solution.x.tolist())
    before = [dist(r.pin_m, true_pin(known, kin, r.position)) for r in readings]
    a, b, c, d = solution.x[:4].tolist()
    return SurveyFit(
        (a, b, c, d),
        _sag(solution.x[4:].tolist()),
        (float(errors[0]), float(errors[1]), float(errors[2]), float(errors[3])),
        tuple(before),
        tuple(np.linalg.norm(after, axis=1).tolist()),
        tuple(moments.tolist()) if weighed else (),
    )


def most_informative_poses(kin: Kinematics, candidates: Sequence[Sequence[float]], count: int) -> list[int]:
    """Choose the candidates that, surveyed together, leave the least uncertainty of the pin at all of them (greedy)."""
    usual = [*[0.0] * 4, *USUAL_PARAMETERS]
    spread = _prior_sigma(True)
    rows = []
    for q in candidates:
        reading = [SurveyReading(tuple(q), (0.0, 0.0, 0.0), 0.0)]
        columns = []
        for i, step in enumerate(1e-3 * spread):
            moved = [p + (step if i == n else 0.0) for n, p in enumerate(usual)]
            pins, moments = (
                b - a for a, b in zip(_misfit(kin, reading, usual), _misfit(kin, reading, moved), strict=True)
            )
            columns.append(np.array([*pins[0] / PIN_SIGMA_M, moments[0] / MOMENT_SIGMA_NM]) / step)
        rows.append(np.array(columns).T)
    all_rows = np.array(rows)
    pin_sensitivity = np.einsum("nki,nkj->ij", all_rows[:, :3], all_rows[:, :3])
    information = np.diag(1.0 / spread**2)
    chosen: list[int] = []
    for _ in range(min(count, len(candidates))):
        uncertainties = [
            np.inf if i in chosen else float(np.trace(np.linalg.solve(information + r.T @ r, pin_sensitivity)))
            for i, r in enumerate(all_rows)
        ]
        best = int(np.argmin(uncertainties))
        chosen.append(best)
        information = information + all_rows[best].T @ all_rows[best]
    return chosen
