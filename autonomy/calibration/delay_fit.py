"""Dead time and lag of a valve's spool, from the commands on the bus and the spool positions of the valve node.

    spool'' = w^2 (command(t - dead time) - spool) - 2 z w spool'          (docs/reference/machines.md section 3)

``delay_s`` is the pure dead time from the command's frame to the first motion of the spool; ``lag_s`` = 2 z / w is the
delay of a moving spool beyond it.  Joints show neither cleanly, because pump and oil are between.  `response_s` is the
delay of the joint itself, from command to encoder, for the report.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from autonomy.calibration.trace import FINE_FACTOR, GRID_S, SpoolTestRecord

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
    """The fit of the staircases of both sides; None where the valve node reports no spools."""
    usable = [t for t in tests if t.spool is not None and float(np.ptp(t.spool)) > 0.02]
    if not usable:
        return None
    both = _fit(usable)
    sides = [_fit(chosen)[0] for side in (1, -1) if (chosen := [t for t in usable if t.side == side])]
    return DelayFit(both[0], both[1], (sides[0], sides[-1]), both[2])


def _fit(tests: Sequence[SpoolTestRecord]) -> tuple[float, float, float]:
    """Dead time, lag, residual."""
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
    """The spool's second-order response as a digital filter (bilinear)."""
    k = 2.0 / step_s
    first = k * k + 2.0 * zeta * omega * k + omega * omega
    b = np.array([1.0, 2.0, 1.0]) * omega * omega / first
    a = np.array([1.0, (2.0 * omega**2 - 2.0 * k * k) / first, (k * k - 2.0 * zeta * omega * k + omega**2) / first])
    return b, a


def response_s(test: SpoolTestRecord, deadband: float) -> float:
    """Time from the command that leaves the dead-band to the joint's first motion in a staircase, s; NaN if it never
    moves.

    The joint counts as moving once it has travelled `MOVED_SHARE` of its travel in the first 0.3 s of steady motion.
    """
    opened = np.flatnonzero(test.side * test.command > deadband)
    if not len(opened):
        return float("nan")
    way = test.side * (test.position - float(np.mean(test.position[: max(1, opened[0])])))
    settled = min(len(way) - 1, opened[0] + round(0.6 / GRID_S))
    before = max(opened[0], settled - round(0.3 / GRID_S))
    threshold = MOVED_SHARE * (way[settled] - way[before])
    moved = np.flatnonzero(way[opened[0] :] > threshold)
    return float(moved[0] * GRID_S) if len(moved) else float("nan")
