"""Swing-free time law of a path: as fast as speeds, accelerations and the pump allow, with little residual swing.

The progress along the path is a cubic B-spline over the share of the time, at rest up to the acceleration at both
ends. Its coefficients and its duration come from sequential linear programming: limits and swing are linearized about
the last solution, within a shrinking trust region.  Without regard to swing the result is within a few percent of the
shortest time for the path.

Swing: a pendulum of frequency w and damping ratio z below a pin of velocity v(t) keeps, after a motion from rest to
rest of duration T, the angle |integral v(t) e^((z + i) w (t - T)) dt| w^2 / g (docs/reference/machines.md section
5).  It is bounded in both horizontal directions for all of `PENDULUM_S` and `DAMPING`, as no sensor measures the
period and a load changes it.  No clock, no randomness: equal paths have equal laws.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import BSpline, CubicSpline
from scipy.optimize import linprog

from autonomy.motion.arm_kinematics import Arm
from machine.joints import N_JOINTS

PENDULUM_S: Final = (1.5, 1.65, 1.8, 1.95, 2.1)
"""Periods of the empty and the loaded grapple (docs/reference/machines.md section 5), with some spread."""
DAMPING: Final = (0.0, 0.15)
"""Damping ratios of free links and of links with friction or a brake (docs/reference/machines.md section 5).
Undamped is not the worst case: where an earlier swing has decayed, it cannot cancel a later one.
"""
SWING_RAD: Final = 0.038
"""Bound of the residual swing of a motion."""
MIN_DURATION_S: Final = 0.6
GRAVITY_M_S2: Final = 9.81
_PIECE_COUNT: Final = 56
"""Pieces of the spline: the acceleration rises and falls within one, a few percent of the time."""
_SAMPLE_COUNT: Final = 3 * _PIECE_COUNT
"""Places at which the limits are checked, without the first."""
_ROUND_COUNT: Final = 14
_DURATION_TRUST: Final = 0.3
"""Share by which the duration may change in the first round, ..."""
_COEFFICIENT_TRUST: Final = 0.25
"""... the share of that by which every coefficient may change, ..."""
_TRUST_SHRINK: Final = 0.75
"""... and the factor on both in every further round."""
_CONVERGED_SHARE: Final = 1e-3
"""The search has converged when the duration changes by less than this share."""
_SWING_PENALTY: Final = 2.0
"""Cost of swing at twice its bound, in durations."""
_SWING_TOLERANCE: Final = 1.05
"""The swing may exceed its bound by this factor: the linearization is not exact."""
_SLOWDOWN: Final = 1.03
_TOLERANCE: Final = 1e-9

PENDULUM_RAD_S: Final = np.tile(2.0 * np.pi / np.array(PENDULUM_S), len(DAMPING))
PENDULUM_POLES: Final = PENDULUM_RAD_S * (1j + np.repeat(DAMPING, len(PENDULUM_S)))
_OCTAGON: Final = np.exp(0.25j * np.pi * np.arange(8))
_DIRECTION_RAD: Final = SWING_RAD * float(np.cos(np.pi / 8.0) * np.sqrt(0.5))
"""Bound on an octagon's side in either direction that keeps the combined swing within a circle."""

_TAU: Final = np.linspace(0.0, 1.0, _SAMPLE_COUNT + 1)
_KNOTS: Final = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, _PIECE_COUNT + 1), np.ones(3)])
_COEFFICIENT_COUNT: Final = _PIECE_COUNT + 3
_FREE: Final = slice(3, _COEFFICIENT_COUNT - 3)
"""Three coefficients at either end are fixed: rest up to the acceleration."""
_BASIS: Final = BSpline(_KNOTS, np.eye(_COEFFICIENT_COUNT), 3)
_B0, _B1, _B2 = (_BASIS(_TAU, nu) for nu in range(3))
_DIFFERENCE: Final = np.diff(np.eye(_COEFFICIENT_COUNT), axis=0)


class PathGeometry:
    """A path through poses (n, 5), evenly sampled over its progress, as a smooth curve of joints and pin."""

    def __init__(self, arm: Arm, poses: np.ndarray) -> None:
        q = arm.joints(poses)
        turn = poses[:, 0] - poses[-1, 0]
        pin = poses[:, 1:2] * np.column_stack([np.cos(turn), np.sin(turn)])
        self._share = np.linspace(0.0, 1.0, len(poses))
        self.moving = np.flatnonzero(np.ptp(q, axis=0) > _TOLERANCE)
        self.acceleration = arm.acceleration[self.moving]
        # No law leaves more swing than the path's length over that of the shortest pendulum.
        length_m = float(np.sum(np.linalg.norm(np.diff(pin, axis=0), axis=1)))
        self.sideways = length_m * float(np.max(PENDULUM_RAD_S)) ** 2 / GRAVITY_M_S2 > SWING_RAD
        self.curve = CubicSpline(self._share, np.hstack([q, pin]))
        slope = self.curve(self._share, 1)[:, :N_JOINTS]
        self._cost = np.maximum(np.max(np.abs(slope) / arm.speed, axis=1), arm.pump_load(q, slope))
        self._cost_slope = np.diff(self._cost) * (len(poses) - 1)

    def cost(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the seconds per unit of progress that speeds and pump require, and its derivative by the progress."""
        piece = np.minimum((at * len(self._cost_slope)).astype(int), len(self._cost_slope) - 1)
        return np.interp(at, self._share, self._cost), self._cost_slope[piece]


@dataclass(frozen=True, slots=True)
class SplineTimeLaw:
    """Progress along a path over time, as a B-spline."""

    duration_s: float
    coefficients: np.ndarray

    def progress(self, time_s: np.ndarray) -> np.ndarray:
        """Compute the progress (0 to 1) at times; 0 before and 1 after the motion."""
        share = np.clip(time_s / self.duration_s, 0.0, 1.0)
        result: np.ndarray = np.clip(BSpline(_KNOTS, self.coefficients, 3)(share), 0.0, 1.0)
        return result

    def slowed(self, duration_s: float) -> SplineTimeLaw:
        """Return the same law, evenly slowed."""
        return SplineTimeLaw(duration_s, self.coefficients)


class _LinearizedLaw:
    """Limits and swing of one law, and their derivatives by its coefficients c and its duration T."""

    def __init__(self, path: PathGeometry, c: np.ndarray) -> None:
        s, self.v, self._a = np.clip(_B0 @ c, 0.0, 1.0), _B1 @ c, _B2 @ c
        slopes = [path.curve(s, nu) for nu in range(1, 4)]
        self._joints = [d[:, path.moving] for d in slopes]
        self._pin = [d[:, N_JOINTS:].T[:, None] for d in slopes[:2]]
        self._most = path.acceleration
        self._cost, self._cost_slope = path.cost(s)
        d1, d2, _ = self._joints
        self._push = d1 * self._a[:, None] + d2 * self.v[:, None] ** 2
        self.shortest_s = max(
            MIN_DURATION_S,
            float(np.max(self._cost * self.v)),
            float(np.sqrt(np.max(np.abs(self._push) / self._most))),
        )

    def limits(self, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute rows and bounds (rows @ [dc, dT] <= bounds) of speeds, pump, accelerations, as shares of limits."""
        v, a, ones = self.v[:, None], self._a[:, None], np.ones((_SAMPLE_COUNT + 1, 1))
        rows = [np.hstack([self._cost[:, None] * _B1 + self._cost_slope[:, None] * v * _B0, -ones]) / duration_s]
        bounds = [1.0 - self._cost * self.v / duration_s]
        for j, most in enumerate(self._most):
            d1, d2, d3 = (d[:, [j]] for d in self._joints)
            whole = most * duration_s**2
            change = (d1 * _B2 + (d2 * a + d3 * v**2) * _B0 + 2.0 * d2 * v * _B1) / whole
            for side in (1.0, -1.0):
                rows.append(np.hstack([side * change, -2.0 / duration_s * ones]))
                bounds.append(1.0 - side * self._push[:, j] / whole)
        return np.vstack(rows), np.concatenate(bounds)

    def swing(self, duration_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute complex swing [rad] in both directions for every pendulum (2, n), and its derivatives by c and T."""
        before = _TAU - 1.0
        wave = (
            np.exp(duration_s * np.outer(PENDULUM_POLES, before))
            * (PENDULUM_RAD_S**2 / GRAVITY_M_S2 / _SAMPLE_COUNT)[:, None]
        )
        pin, bend = self._pin
        by_c = (wave * pin) @ _B1 + (wave * bend * self.v) @ _B0
        return (wave * pin) @ self.v, by_c, (wave * pin * PENDULUM_POLES[:, None] * before) @ self.v


def swing_free_law(path: PathGeometry, shaped: bool = True) -> SplineTimeLaw:
    """Find a fast law of a path; ``shaped``: it leaves at most `SWING_RAD` of swing."""
    shaped = shaped and path.sideways
    rise = np.clip((np.arange(_COEFFICIENT_COUNT) - 2) / (_COEFFICIENT_COUNT - 5), 0.0, 1.0)
    c = rise**3 * (10.0 - 15.0 * rise + 6.0 * rise**2)
    state = _LinearizedLaw(path, c)
    duration_s, trust, candidate_laws = state.shortest_s, _DURATION_TRUST, []
    for _ in range(_ROUND_COUNT):
        step = _solve_step(state, c, duration_s, trust, shaped)
        if step is None:
            break
        c = c.copy()
        c[_FREE] += step[:-2]
        state = _LinearizedLaw(path, c)
        before_s, duration_s = duration_s, max(duration_s + float(step[-2]), state.shortest_s)
        trust *= _TRUST_SHRINK
        over = _residual_swing_rad(state, duration_s) / SWING_RAD if shaped else 0.0
        candidate_laws.append((max(over, _SWING_TOLERANCE), duration_s, c))
        if over <= _SWING_TOLERANCE and abs(duration_s - before_s) < _CONVERGED_SHARE * duration_s:
            break
    return _best_law(path, candidate_laws or [(np.inf, duration_s, c)], shaped)


def _best_law(path: PathGeometry, found: list[tuple[float, float, np.ndarray]], shaped: bool) -> SplineTimeLaw:
    """Select the fastest law whose swing is small; where none is, the one with least swing, slowed until its swing is
    small."""
    _, duration_s, c = min(found, key=lambda law: law[:2])
    state = _LinearizedLaw(path, c)
    while shaped and _residual_swing_rad(state, duration_s) > _SWING_TOLERANCE * SWING_RAD:
        duration_s *= _SLOWDOWN
    return SplineTimeLaw(duration_s, c)


def _residual_swing_rad(state: _LinearizedLaw, duration_s: float) -> float:
    """Compute the greatest residual swing [rad]."""
    return float(np.max(np.linalg.norm(np.abs(state.swing(duration_s)[0]), axis=0)))


def _solve_step(
    state: _LinearizedLaw, c: np.ndarray, duration_s: float, trust: float, shaped: bool
) -> np.ndarray | None:
    """Find the best change of coefficients and duration, and the excess swing in shares of its bound."""
    rows, bounds = state.limits(duration_s)
    parts = [
        np.hstack([rows, np.zeros((len(rows), 1))]),
        np.hstack([-_DIFFERENCE, np.zeros((_COEFFICIENT_COUNT - 1, 2))]),
    ]
    most = [bounds, _DIFFERENCE @ c]
    if shaped:
        residual_swing, by_c, by_t = (x / _DIRECTION_RAD for x in state.swing(duration_s))
        for side in _OCTAGON:
            change = np.concatenate([(by_c * side).real, (by_t * side).real[..., None]], axis=2)
            parts.append(np.hstack([change.reshape(-1, _COEFFICIENT_COUNT + 1), -np.ones((residual_swing.size, 1))]))
            most.append(1.0 - (residual_swing * side).real.ravel())
    keep = np.r_[_FREE, _COEFFICIENT_COUNT, _COEFFICIENT_COUNT + 1]
    n = len(keep) - 2
    price = np.concatenate([np.zeros(n), [1.0, _SWING_PENALTY * duration_s]])
    reach: list[tuple[float, float | None]] = [(-_COEFFICIENT_TRUST * trust, _COEFFICIENT_TRUST * trust)] * n
    reach += [(-trust * duration_s, trust * duration_s), (0.0, None)]
    solved = linprog(
        price,
        np.vstack(parts)[:, keep],
        np.concatenate(most),
        bounds=reach,
        method="highs",
        options={"presolve": False},  # it costs more than it saves: nearly every row matters
    )
    step: np.ndarray | None = solved.x
    return step
