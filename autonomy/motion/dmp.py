"""Dynamic movement primitives: a point-to-point motion learned from demonstrations, replayed to any goal.

Ijspeert 2013 with the goal term of Pastor 2009 (docs/reference/machines.md section 6; paper B 3.2.5), per coordinate
y and share of time:

    tau z' = alpha (beta (g - y) - z) + alpha beta (F(x) - (g - y0) x),   tau y' = z,   tau x' = -alpha_x x
    F(x) = x sum psi_i w_i / sum psi_i,   psi_i = exp(-h_i (x - c_i)^2)

The classic form multiplies F by (g - y0): it diverges where a demonstration ends where it began, and turns a lift
into a dip where the sign changes.  Here F is added as demonstrated, whatever the goal.  Only for a ``scaled``
coordinate is F a share of its travel, because it should mirror: a slew to the other side.  Such a coordinate is
learned only from demonstrations that move it.  The weights come from locally weighted regression over all
demonstrations together.

The equations are linear with constant coefficients, so a rollout is exact except for F between its points.  Numpy
only, no clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from runtime.errors import InputRefused

ALPHA: Final = 25.0
BETA: Final = ALPHA / 4.0
ALPHA_X: Final = -float(np.log(0.01))
"""The phase x falls to 0.01 over the duration."""
BASIS_COUNT: Final = 40
BASIS_OVERLAP: Final = 0.2
"""Value of a basis function at the centre of the next."""
CORRECTION_SHARE: Final = 0.4
"""Last share of the duration, in which the residual of the phase is corrected: some percent of the goal's change."""
_STEP_COUNT: Final = 400
_MIN_SAMPLES: Final = 8


@dataclass(frozen=True, slots=True)
class Dmp:
    """A primitive of D coordinates: duration [s] of the demonstrations, weights (D, n), which coordinates are
    scaled."""

    duration_s: float
    weights: np.ndarray
    scaled: tuple[bool, ...]

    def rollout(self, start: np.ndarray, goal: np.ndarray) -> Rollout:
        """The motion from rest at ``start`` (D,) to rest at ``goal`` (D,).

        Raises:
            InputRefused: a number is not finite, or the number of coordinates differs.
        """
        start, goal = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
        if start.shape != (len(self.weights),) or goal.shape != start.shape:
            raise InputRefused(
                "primitive.wrong-shape",
                f"a primitive of {len(self.weights)} coordinates got {start.shape} and {goal.shape}",
            )
        if not (np.all(np.isfinite(start)) and np.all(np.isfinite(goal))):
            raise InputRefused("primitive.not-finite", "start and goal of a primitive must be finite numbers")
        path = goal - start
        share = np.arange(_STEP_COUNT + 1) / _STEP_COUNT
        x = np.exp(-ALPHA_X * share)
        force = _design(x, self.weights.shape[1]) @ self.weights.T * np.where(self.scaled, path, 1.0)
        y = start + _filtered(path - path * x[:, None] + force)
        return Rollout(share * self.duration_s, _ending_at_goal(y, goal))


@dataclass(frozen=True, slots=True)
class Rollout:
    """A motion at rest at both ends: times (n,) [s] from 0 and positions (n, D)."""

    time_s: np.ndarray
    position: np.ndarray

    @property
    def duration_s(self) -> float:
        """Time of the last point."""
        return float(self.time_s[-1])

    def at(self, time_s: np.ndarray, duration_s: float | None = None) -> np.ndarray:
        """Positions (m, D) at times (m,), cubics between the points; ``duration_s`` slows the motion down to that."""
        span = self.duration_s
        t = np.clip(np.asarray(time_s, dtype=float) * (span / (duration_s or span)), 0.0, span)
        step = self.time_s[1]
        i = np.minimum((t / step).astype(int), len(self.time_s) - 2)
        s = (t / step - i)[:, None]
        slope = np.gradient(self.position, axis=0)
        slope[0] = slope[-1] = 0.0
        p0, p1, m0, m1 = self.position[i], self.position[i + 1], slope[i], slope[i + 1]
        c2, c3 = 3.0 * (p1 - p0) - 2.0 * m0 - m1, m0 + m1 - 2.0 * (p1 - p0)
        result: np.ndarray = p0 + s * (m0 + s * (c2 + s * c3))
        return result


def learn(
    demonstrations: Sequence[tuple[np.ndarray, np.ndarray]],
    scaled: Sequence[bool] | None = None,
    bases: int = BASIS_COUNT,
    least_way: float = 0.2,
) -> Dmp:
    """A primitive from demonstrations (times (n,) [s], positions (n, D)), each from rest to rest.

    ``scaled`` coordinates learn only from demonstrations that move them by at least ``least_way``; by default none is
    scaled.  The duration is the mean of the demonstrations'.

    Raises:
        InputRefused: there is nothing to learn from.
    """
    if not demonstrations:
        raise InputRefused("demonstration.none", "there is no demonstration to learn from")
    if bases < 2:
        raise InputRefused("demonstration.too-few-bases", f"a primitive needs at least 2 basis functions, not {bases}")
    count = np.asarray(demonstrations[0][1]).shape[-1]
    flags = tuple(scaled) if scaled is not None else (False,) * count
    above, below, spans = np.zeros((count, bases)), np.zeros((count, bases)), []
    for number, (time_s, position) in enumerate(demonstrations, 1):
        share, y, span = _normalized(number, time_s, position, count)
        spans.append(span)
        x = np.exp(-ALPHA_X * share)
        velocity = np.gradient(y, share, axis=0)
        acceleration = np.gradient(velocity, share, axis=0)
        path = y[-1] - y[0]
        wanted = (acceleration + ALPHA * velocity) / (ALPHA * BETA) - (y[-1] - y) + path * x[:, None]
        size = np.where(flags, path, 1.0)
        use = ~np.array(flags) | (np.abs(path) >= least_way)
        wanted = wanted / np.where(use, size, 1.0)
        psi = _activations(x, bases)
        # demonstrations have equal weight, however many samples they have
        above += np.where(use[:, None], (wanted * x[:, None]).T @ psi, 0.0) / len(x)
        below += np.where(use[:, None], np.sum(psi * (x**2)[:, None], axis=0), 0.0) / len(x)
    if np.any(below <= 0.0):
        j = int(np.argmax(np.any(below <= 0.0, axis=1)))
        raise InputRefused(
            "demonstration.coordinate-unmoved",
            f"no demonstration moves coordinate {j} by {least_way:g}; add one that does",
        )
    return Dmp(float(np.mean(spans)), above / below, flags)


def _ending_at_goal(y: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The same motion (n, D) ending at rest at the goal, corrected by a polynomial over its last part."""
    last = int(CORRECTION_SHARE * _STEP_COUNT)
    h = 1.0 / last
    tail = y[-3:]
    speed, bend = (tail[2] - tail[1]) / h, (tail[2] - 2.0 * tail[1] + tail[0]) / h**2
    left = goal - y[-1]
    # Position, speed and acceleration of the correction are 0 at its beginning and the residuals at its end.
    a, b, c = np.linalg.solve([[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [6.0, 12.0, 20.0]], np.stack([left, -speed, -bend]))
    t = np.linspace(0.0, 1.0, last + 1)[:, None]
    out = y.copy()
    out[-last - 1 :] += t**3 * (a + t * (b + t * c))
    return out


def _normalized(
    number: int, time_s: np.ndarray, position: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, float]:
    t, y = np.asarray(time_s, dtype=float), np.asarray(position, dtype=float)
    if y.ndim != 2 or t.shape != y.shape[:1] or y.shape[1] != count:
        raise InputRefused(
            "demonstration.wrong-shape", f"demonstration {number} has {t.shape} times and {y.shape} positions"
        )
    if len(t) < _MIN_SAMPLES:
        raise InputRefused(
            "demonstration.too-few-samples",
            f"demonstration {number} has {len(t)} samples; at least {_MIN_SAMPLES} are needed",
        )
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(y))):
        raise InputRefused("demonstration.not-finite", f"demonstration {number} holds a number that is not finite")
    if np.any(np.diff(t) <= 0.0):
        raise InputRefused(
            "demonstration.times-not-increasing", f"demonstration {number} has times that do not increase"
        )
    span = float(t[-1] - t[0])
    return (t - t[0]) / span, y, span


def _centres(bases: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres in the phase, evenly in time, and widths that overlap by `BASIS_OVERLAP`."""
    centres = np.exp(-ALPHA_X * np.linspace(0.0, 1.0, bases))
    gaps = np.diff(centres)
    return centres, -np.log(BASIS_OVERLAP) / np.append(gaps, gaps[-1]) ** 2


def _activations(x: np.ndarray, bases: int) -> np.ndarray:
    """psi (n, bases), each row summing to 1."""
    centres, widths = _centres(bases)
    psi = np.exp(-widths * (np.maximum(x, centres[-1])[:, None] - centres) ** 2)
    result: np.ndarray = psi / np.sum(psi, axis=1, keepdims=True)
    return result


def _design(x: np.ndarray, bases: int) -> np.ndarray:
    """F(x) = _design(x) @ w."""
    result: np.ndarray = x[:, None] * _activations(x, bases)
    return result


def _filtered(pull: np.ndarray) -> np.ndarray:
    """The solution of y'' + alpha y' + alpha beta y = alpha beta pull from rest at 0, for pull (n, D) every
    1 / `_STEP_COUNT`, linear between: exact, as alpha = 4 beta makes the double pole p = -alpha / 2.
    """
    h, p = 1.0 / _STEP_COUNT, -ALPHA / 2.0
    e = np.exp(p * h)
    free = e * np.array([[1.0 - p * h, h], [-p * p * h, 1.0 + p * h]])
    # With y - pull as the state, a linear pull has the particular solution pull - slope * alpha / (alpha beta).
    y, out, lag = np.zeros((2, pull.shape[1])), np.zeros_like(pull), ALPHA / (ALPHA * BETA)
    slopes = np.diff(pull, axis=0) / h
    for k, slope in enumerate(slopes):
        steady = np.stack([pull[k] - lag * slope, slope])
        y = steady + free @ (y - steady)
        y[0] += slope * h
        out[k + 1] = y[0]
    return out
