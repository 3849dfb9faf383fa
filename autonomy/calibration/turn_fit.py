"""Dead-band and full speed of a rotator without an encoder, from the turns that known spool programs made.

    turn = full * integral of ((play(spool) - dead-band) / (1 - half of the play - dead-band))^n
                                                                            (docs/reference/machines.md section 3)

A surveyor reads the grapple's direction at rest before and after every program.  Dead time and lag of the spool act
alike at its opening and its closing: they shift a turn and do not change it.  Play and exponent are the profile's, so
the fitted values are those with which its valve map reproduces the turns.  A grapple looks the same after half a
turn; the turns of a side grow from one that is unambiguous, and each resolves the half turns of the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, pi, radians, remainder, sqrt
from typing import Final

import msgspec
import numpy as np
from scipy.optimize import least_squares

from autonomy.calibration.spool_program import Allowed, SpoolProgram, allowed_by, deadband_pct, pulse
from autonomy.calibration.trace import GRID_S, SpoolTestRecord
from autonomy.calibration.valve_fit import apply_backlash
from machine.profile import JointSpec

YAW_SIGMA_RAD: Final = radians(1.0)
"""Standard deviation of one reading of the direction; the caller averages several readings at one rest."""
DEADBAND_SIGMA, FULL_SPEED_SIGMA = 0.12, 0.9
"""Standard deviations of a valve from its profile, share of the stroke and logarithm of the full speed; they matter for
few turns."""
DEADBAND_STARTS: Final = (0.04, 0.1, 0.18, 0.28)
"""A fit begins at each: where a dead-band is above a command, a turn does not tell how far above."""
HOLD_BOUNDS_S: Final = (0.2, 3.0)
"""Bounds of a pulse's hold time."""
MAX_PULSE_S: Final = 4.7
"""Longest pulse: the controller ends a test of a joint without an encoder after five seconds."""
LOWER: Final = 0.9
"""A share of the speed limit whose pulse takes longer is lowered by this, until it does not."""
SIDES: Final = (1, -1)


@dataclass(frozen=True, slots=True)
class Turn:
    """One program as it ran, and the rotator's direction at rest before and after it [rad], modulo pi and without the
    slew; both are means of ``readings`` readings.
    """

    record: SpoolTestRecord
    before_rad: float
    after_rad: float
    readings: int


@dataclass(frozen=True, slots=True)
class SideFit:
    """One side: dead-band [share of full command], full speed [rad/s], their standard errors, and for each of its turns
    the angle and the residual [rad, + is to this side].
    """

    deadband: float
    full_speed: float
    errors: tuple[float, float]
    turns_rad: tuple[float, ...] = ()
    left_rad: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class TurnFit:
    """Both sides of a rotator."""

    plus: SideFit
    minus: SideFit

    @property
    def angle_rad(self) -> float:
        """The present angle, counted from the angle before the first turn."""
        return sum(self.plus.turns_rad) - sum(self.minus.turns_rad)

    def side(self, side: int) -> SideFit:
        """Return the fit of a side (+1, -1)."""
        return self.plus if side > 0 else self.minus


def fit_turns(turns: Sequence[Turn], spec: JointSpec) -> TurnFit:
    """Fit all turns so far; a side without turns keeps the profile's values."""
    plus, minus = (_fit_side([t for t in turns if t.record.side == side], spec, side) for side in SIDES)
    return TurnFit(plus, minus)


def fitted_spec(spec: JointSpec, fit: TurnFit) -> JointSpec:
    """Return the joint with the valve that a fit has found."""
    valve = msgspec.structs.replace(
        spec.valve,
        deadband_plus_pct=100.0 * fit.plus.deadband,
        deadband_minus_pct=100.0 * fit.minus.deadband,
        full_speed_plus=fit.plus.full_speed,
        full_speed_minus=fit.minus.full_speed,
    )
    return msgspec.structs.replace(spec, valve=valve)


def pulse_to(
    spec: JointSpec, fit: TurnFit, side: int, share: float, to_rad: float, allowed: Allowed | None = None
) -> SpoolProgram:
    """Plan the pulse that should end at an angle, counted as ``angle_rad``."""
    known, allowed = fit.side(side), allowed or allowed_by(spec)
    spec = fitted_spec(spec, fit)
    least, most = HOLD_BOUNDS_S
    # A valve that opens slowly would take longer to a great opening and back than a test may: a lesser one serves.
    while pulse(spec, side, share, least, allowed).duration_s > MAX_PULSE_S:
        share *= LOWER

    def turn_rad(hold_s: float) -> float:
        program = pulse(spec, side, share, hold_s, allowed)
        times = np.arange(0.0, program.duration_s, GRID_S)
        spool = np.array([side * program.at(t) / 100.0 for t in times])
        return known.full_speed * _full_speed_seconds(apply_backlash(spool, _half_backlash(spec)), spec, known.deadband)

    shut, held = turn_rad(0.0), turn_rad(1.0)
    target_turn_rad = side * (to_rad - fit.angle_rad)
    most = max(least, min(most, MAX_PULSE_S - pulse(spec, side, share, 0.0, allowed).duration_s))
    hold_s = (target_turn_rad - shut) / (held - shut) if held > shut else most
    return pulse(spec, side, share, min(max(hold_s, least), most), allowed)


def _half_backlash(spec: JointSpec) -> float:
    return spec.valve.hysteresis_pct / 200.0


def _full_speed_seconds(spool: np.ndarray, spec: JointSpec, deadband: float) -> float:
    """Compute the time at full speed for the turn of a spool behind its backlash, on the grid of a record, s."""
    opening = np.clip((spool - deadband) / (1.0 - _half_backlash(spec) - deadband), 0.0, 1.0)
    return float(np.sum(opening**spec.valve.exponent)) * GRID_S


def _fit_side(turns: Sequence[Turn], spec: JointSpec, side: int) -> SideFit:
    deadband = deadband_pct(spec, side) / 100.0
    full = spec.valve.full_speed_plus if side > 0 else spec.valve.full_speed_minus
    fit = SideFit(deadband, full, (DEADBAND_SIGMA, FULL_SPEED_SIGMA * full))
    records = [t.record for t in turns]
    spools = [apply_backlash(side * (r.command if r.spool is None else r.spool), _half_backlash(spec)) for r in records]
    noises = np.array([YAW_SIGMA_RAD * sqrt(2.0 / t.readings) for t in turns])
    seen: list[float] = []
    for turn, spool in zip(turns, spools, strict=True):
        expected = fit.full_speed * _full_speed_seconds(spool, spec, fit.deadband)
        seen.append(expected + remainder(side * (turn.after_rad - turn.before_rad) - expected, pi))
        fit = _solve_side(spools[: len(seen)], seen, noises[: len(seen)], spec, (deadband, full))
    return fit


def _solve_side(
    spools: Sequence[np.ndarray],
    seen: Sequence[float],
    noises: np.ndarray,
    spec: JointSpec,
    known: tuple[float, float],
) -> SideFit:
    deadband, full = known

    def left(p: np.ndarray) -> np.ndarray:
        result: np.ndarray = np.array(seen) - [p[1] * full * _full_speed_seconds(s, spec, p[0]) for s in spools]
        return result

    def residuals(p: np.ndarray) -> np.ndarray:
        before = [(p[0] - deadband) / DEADBAND_SIGMA, log(p[1]) / FULL_SPEED_SIGMA]
        return np.concatenate([left(p) / noises, before])

    fits = [
        least_squares(residuals, (start, 1.0), bounds=((0.0, 0.1), (0.6, 5.0)), x_scale=(0.01, 0.1))
        for start in sorted({deadband, *DEADBAND_STARTS})
    ]
    best_fit = min(fits, key=lambda fit: float(fit.cost))
    error = np.sqrt(np.diag(np.linalg.inv(best_fit.jac.T @ best_fit.jac)))
    p = best_fit.x
    return SideFit(
        float(p[0]), float(p[1]) * full, (float(error[0]), float(error[1]) * full), tuple(seen), tuple(left(p).tolist())
    )
