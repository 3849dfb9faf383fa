"""Zero offsets of the encoders and the column's give, from surveyed positions of the hanger pin.

A surveying instrument shows where the pin is; the encoders say where it should be; the lift cylinder's pressures say
what the crane weighs there.  One least-squares fit explains all of it: the zero of slew, lift, tilt and telescope, and

    moment at the lift joint [Nm] = head * (r_head - a1) + pin * (r_pin - a1)
    lean of the column [rad]      = give * (head * r_head + pin * r_pin) - rest

with r_head and r_pin the horizontal distances of stick pin and hanger pin from the slew axis: the weights of boom,
stick and grapple act there, and the same weights bend the column.  A column that leans and a boom whose zero is off
look nearly alike; the moments tell how the lean grows with the reach, and the give [rad/Nm] is what a load will bend.
Without pressures head and pin of the lean are fitted by themselves, and nothing is known of loads.  The column's give
to the side (roll) shows only under a load off the crane's plane: an empty grapple cannot tell it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist, isfinite, nan
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from machine.joints import N_JOINTS, Joint
from machine.geometry.kinematics import Point
from machine.sensing.weighing import empty_moment_nm
from machine.profile import Kinematics, Sag
from machine.geometry.sag import true_pin

OFFSETS: Final = (Joint.SLEW, Joint.LIFT, Joint.TILT, Joint.EXT)
PIN_SIGMA_M: Final = 0.002
"""Of one surveyed position; several readings at one pose are averaged by the caller."""
OFFSET_SIGMA: Final = (0.07, 0.02, 0.02, 0.02)
"""How far off an encoder's zero is on a machine that nobody has surveyed [rad, m] (docs/reference/machines.md sections 1.6 and 14)."""
LEAN_SIGMA: Final = 0.01
"""Of each of the two lean terms [rad/m]: 0.1 m of sag at full reach."""
REST_SIGMA: Final = 0.05
MOMENT_SIGMA_NM: Final = 600.0
"""Of one moment by pressures: a cylinder at rest holds up to its friction either way."""
WEIGHT_SIGMA_N: Final = 2e4
"""Of each of the two terms of the moment: two tons at either pin."""
USUAL_COMPLIANCE_RAD_NM: Final = 1e-6
"""A usual column's give, and how far others are from it."""
USUAL_PARAMETERS: Final = (1.0, 0.01, 6e3, 8e3)
"""Give, rest, head and pin of a usual crane, where the poses of a survey are chosen."""
MIN_POSES: Final = 5


@dataclass(frozen=True, slots=True)
class SurveyReading:
    """One pose: what the encoders say (``Joint`` order, rad and m), where the pin is (base frame, m), and the moment
    that the lift cylinder's pressures show [Nm], NaN without pressure sensors.
    """

    position: tuple[float, ...]
    pin_m: Point
    moment_nm: float = nan


@dataclass(frozen=True, slots=True)
class SurveyFit:
    """What to subtract from the encoders (`OFFSETS` order: rad, rad, rad, m) and the crane's sag.

    ``errors`` are standard errors of the offsets.  ``before_m`` and ``after_m`` are the distances between surveyed and
    computed pin at every pose, without and with the fit; ``moments_nm`` what is left of every moment, none without
    pressures.
    """

    offsets: tuple[float, float, float, float]
    sag: Sag
    errors: tuple[float, float, float, float]
    before_m: tuple[float, ...]
    after_m: tuple[float, ...]
    moments_nm: tuple[float, ...]


def _sag(p: Sequence[float]) -> Sag:
    """The sag of the parameters after the offsets.

    Three are the lean by itself: head, pin, rest.  Four tie it to the moment: give [`USUAL_COMPLIANCE_RAD_NM`], rest, head and pin
    of the moment.
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
    """How far the parameters may be from 0 on a machine that nobody has surveyed."""
    lean = (1.0, REST_SIGMA, WEIGHT_SIGMA_N, WEIGHT_SIGMA_N) if weighed else (LEAN_SIGMA, LEAN_SIGMA, REST_SIGMA)
    return np.array([*OFFSET_SIGMA, *lean])


def _misfit(kin: Kinematics, readings: Sequence[SurveyReading], p: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """What the parameters leave of pins (n, 3) [m] and moments [Nm]."""
    sag, shown = _sag(p[4:]), [_corrected(r.position, p[:4]) for r in readings]
    pins = np.array([r.pin_m for r in readings]) - np.array([true_pin(sag, kin, q) for q in shown])
    moments = [r.moment_nm - empty_moment_nm(sag, kin, q) for r, q in zip(readings, shown, strict=True)]
    return pins, np.array(moments)


def fit_survey(kin: Kinematics, readings: Sequence[SurveyReading], known: Sag | None = None) -> SurveyFit:
    """Offsets and sag from at least `MIN_POSES` readings; ValueError with fewer.

    ``known``: the sag that the profile has so far; only ``before_m`` depends on it.
    """
    if len(readings) < MIN_POSES:
        raise ValueError(f"{len(readings)} surveyed poses are too few; survey {MIN_POSES} or more, far apart")
    weighed = all(isfinite(r.moment_nm) for r in readings)
    spread = _prior_sigma(weighed)
    start = np.zeros(len(spread))
    if weighed:
        start[4], start[6:] = 1.0, 0.2 * WEIGHT_SIGMA_N

    def residuals(p: np.ndarray) -> np.ndarray:
        pins, moments = _misfit(kin, readings, p.tolist())
        parts = [pins.ravel() / PIN_SIGMA_M, (p - start) / spread]
        return np.concatenate([*parts, moments / MOMENT_SIGMA_NM] if weighed else parts)

    found = least_squares(residuals, start, x_scale=spread)
    errors = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    after, moments = _misfit(kin, readings, found.x.tolist())
    before = [dist(r.pin_m, true_pin(known, kin, r.position)) for r in readings]
    a, b, c, d = found.x[:4].tolist()
    return SurveyFit(
        (a, b, c, d),
        _sag(found.x[4:].tolist()),
        (float(errors[0]), float(errors[1]), float(errors[2]), float(errors[3])),
        tuple(before),
        tuple(np.linalg.norm(after, axis=1).tolist()),
        tuple(moments.tolist()) if weighed else (),
    )


def most_informative_poses(kin: Kinematics, candidates: Sequence[Sequence[float]], count: int) -> list[int]:
    """Which of the candidate poses, surveyed together, leave the pin best known at all of them (greedy)."""
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
    wanted = np.einsum("nki,nkj->ij", all_rows[:, :3], all_rows[:, :3])
    information = np.diag(1.0 / spread**2)
    chosen: list[int] = []
    for _ in range(min(count, len(candidates))):
        unknown = [
            np.inf if i in chosen else float(np.trace(np.linalg.solve(information + r.T @ r, wanted)))
            for i, r in enumerate(all_rows)
        ]
        best = int(np.argmin(unknown))
        chosen.append(best)
        information = information + all_rows[best].T @ all_rows[best]
    return chosen
