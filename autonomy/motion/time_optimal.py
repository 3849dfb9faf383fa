"""Time-optimal path parametrization with residual swing suppression, in a few milliseconds.

`autonomy.motion.time_law` finds a law by linear programs in a few tenths of a second.  This one integrates the phase
plane of progress and speed once backward and once forward (Bobrow 1985, Pham 2018), which gives the fastest law under
speed, pump and acceleration limits, and then averages the progress over a window in time.  Averaging keeps the path,
bounds the jerk by twice the acceleration over the window's first part, and cancels the swing whose periods the window
holds.  Of a family of windows it takes the shortest that leaves at most `SWING_RAD`, by the same pendulums.  Where
averaging violates a limit, the speed there is lowered and the law computed again.

No clock, no randomness: equal paths have equal laws.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import nnls

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.time_law import GRAVITY_M_S2, PENDULUM_POLES, PENDULUM_RAD_S, SWING_RAD, PathGeometry
from autonomy.motion.trajectory import STEP_S
from machine.joints import N_JOINTS

GRID_COUNT: Final = 128
"""Pieces of the path on which the phase plane is integrated."""
SAMPLES_PER_PIECE: Final = 4
"""Samples of the path's joints per piece."""
JERK_WINDOW_S: Final = 0.24
"""Least window: accelerations rise within it."""
TAP_S: Final = 0.04
"""Distance between the impulses of a window, ..."""
TAP_COUNTS: Final = (0, 12, 18, 22, 26, 30, 34, 38, 43, 48, 53)
"""... and their numbers less one to choose from: at most a period of the slowest pendulum."""
REFINEMENT_COUNT: Final = 3
"""How often the swing of a window is linearized again: paths are curved, so impulses do not simply superpose."""
ROUND_COUNT: Final = 2
_TINY: Final = 1e-9
_TAP_STEPS: Final = round(TAP_S / STEP_S)
_GAIN: Final = (PENDULUM_RAD_S**2 / GRAVITY_M_S2)[:, None]
_GOOD_SHARE: Final = 0.6
"""A window is good enough at this share of the bound."""
_SUM_WEIGHT: Final = 3.0
"""Weight of the condition that a window's impulses sum to 1, in bounds of the swing."""


def _jerk_kernel() -> np.ndarray:
    n = round(JERK_WINDOW_S / STEP_S / 2)
    kernel = np.convolve(np.ones(n), np.ones(n))
    result: np.ndarray = kernel / kernel.sum()
    return result


_JERK_KERNEL: Final = _jerk_kernel()


@dataclass(frozen=True)
class SampledTimeLaw:
    """A time law: progress (n,) every `STEP_S` from 0 to 1, and the residual swing [rad]."""

    done: np.ndarray
    swing_rad: float

    @cached_property
    def _curve(self) -> CubicSpline:
        return CubicSpline(np.arange(len(self.done)) * STEP_S, self.done, bc_type="clamped")

    @property
    def duration_s(self) -> float:
        """Time of its end."""
        return (len(self.done) - 1) * STEP_S

    def progress(self, time_s: np.ndarray) -> np.ndarray:
        """Compute the progress (0 to 1) at times; 0 before and 1 after the motion."""
        at: np.ndarray = self._curve(np.clip(time_s, 0.0, self.duration_s))
        result: np.ndarray = np.clip(at, 0.0, 1.0)
        return result


class PathLimits:
    """A path's limits on its grid: first and second derivative of the moving joints, and the greatest speed."""

    def __init__(self, arm: Arm, path: PathGeometry) -> None:
        self.s = np.linspace(0.0, 1.0, GRID_COUNT + 1)
        self.slope = path.curve(self.s, 1)[:, path.moving]
        self.bend = path.curve(self.s, 2)[:, path.moving]
        self.most = path.acceleration
        self.speed = 1.0 / np.maximum(path.cost(self.s)[0], _TINY)
        fine = np.linspace(0.0, 1.0, SAMPLES_PER_PIECE * GRID_COUNT + 1)
        self.fine, self.table = fine, path.curve(fine)
        self.pin = self.table[:, N_JOINTS:]
        self._pin_slope = np.gradient(self.pin, fine, axis=0)
        self.sideways = path.sideways

    def pin_at(self, progress: np.ndarray) -> np.ndarray:
        """Interpolate the pin (n, 2) at progress (n,)."""
        return np.column_stack([np.interp(progress, self.fine, column) for column in self.pin.T])

    def pin_slope_at(self, progress: np.ndarray) -> np.ndarray:
        """Interpolate the pin's derivative by the progress (n, 2) there."""
        return np.column_stack([np.interp(progress, self.fine, column) for column in self._pin_slope.T])

    def fastest(self, brake: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute times and speeds of the fastest law on the grid; ``brake`` (n,) lowers the speed there."""
        step = 1.0 / GRID_COUNT
        most = self.most
        slope = np.where(np.abs(self.slope) < 1e-6, 1e-6, self.slope)
        # |slope a + bend b| <= most, with b the squared speed: two lines a over b for every joint.
        size = most / np.abs(slope)
        tilt = -self.bend / slope
        ceiling = (self.speed * brake) ** 2
        spread = size[:, :, None] + size[:, None, :]
        apart = tilt[:, :, None] - tilt[:, None, :]
        crossing = np.where(apart > _TINY, spread / np.maximum(apart, _TINY), np.inf)
        ceiling = np.minimum(ceiling, np.min(crossing, axis=(1, 2)))
        low, top = (-size).tolist(), ceiling.tolist()
        lean, high = tilt.tolist(), size.tolist()
        two = 2.0 * step
        reach = [0.0] * (GRID_COUNT + 1)
        for k in range(GRID_COUNT - 1, -1, -1):
            best, beyond = top[k], reach[k + 1] / two
            for a0, m in zip(low[k], lean[k], strict=True):
                rise = m + 1.0 / two
                if rise > 0.0:
                    best = min(best, (beyond - a0) / rise)
            reach[k] = max(best, 0.0)
        b, squared = 0.0, [0.0] * (GRID_COUNT + 1)
        for k in range(GRID_COUNT):
            push = min(a1 + m * b for a1, m in zip(high[k], lean[k], strict=True))
            b = min(reach[k + 1], max(b + two * push, 0.0))
            squared[k + 1] = b
        v = np.sqrt(np.array(squared))
        pace = np.maximum(v[1:] + v[:-1], 1e-4)
        return np.concatenate([[0.0], np.cumsum(2.0 * step / pace)]), v


def _sampled(time: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Sample the progress every `STEP_S` of a law given on the grid."""
    end = max(int(np.ceil(time[-1] / STEP_S)), 2)
    at = np.linspace(0.0, time[-1], end + 1)
    i = np.minimum(np.searchsorted(time, at, side="right") - 1, GRID_COUNT - 1)
    span = np.maximum(time[i + 1] - time[i], _TINY)
    part = at - time[i]
    done = i / GRID_COUNT + speed[i] * part + 0.5 * (speed[i + 1] - speed[i]) / span * part**2
    result: np.ndarray = np.clip(done, 0.0, 1.0)
    return result


@lru_cache(maxsize=256)
def _weights(length: int) -> np.ndarray:
    """Compute the residual swing [rad] per place of a path with one place every `TAP_S`, from rest to rest: real and
    imaginary parts for every pendulum, (2 n, length).
    """
    decay = np.exp(-np.outer(PENDULUM_POLES, np.arange(length - 1) * TAP_S))  # of a swing over a number of taps
    late = _GAIN * decay[:, ::-1]
    none = np.zeros((len(late), 1))
    weights = np.hstack([none, late]) - np.hstack([late, none])
    return np.vstack([weights.real, weights.imag])


def _residual_swing(pin: np.ndarray) -> np.ndarray:
    """Compute the residual swing [rad] of paths (t, m), every `TAP_S` from rest to rest: real and imaginary part for
    every pendulum, (2 n, m).
    """
    swing_rad: np.ndarray = _weights(len(pin)) @ pin
    return swing_rad


def _max_swing_rad(left: np.ndarray) -> float:
    size = np.sum(left**2, axis=1)
    return float(np.sqrt(np.max(size[: len(size) // 2] + size[len(size) // 2 :])))


def time_optimal_law(arm: Arm, path: PathGeometry, shaped: bool = True) -> SampledTimeLaw:
    """Find the fastest law of a path that keeps the limits and, if ``shaped``, leaves at most `SWING_RAD` of swing."""
    limits = PathLimits(arm, path)
    brake = np.ones(GRID_COUNT + 1)
    taps = None if shaped and limits.sideways else 0
    for turn in range(ROUND_COUNT + 1):
        raw = np.convolve(
            np.pad(_sampled(*limits.fastest(brake)), len(_JERK_KERNEL) - 1, mode="edge"), _JERK_KERNEL, mode="valid"
        )
        taps, law = _shortest_window(limits, raw, taps)
        load = _load(arm, limits, law.done)
        over = float(np.max(load))
        if over <= 1.0 or turn == ROUND_COUNT:
            break
        brake = _reduced_speeds(brake, load, law.done)
    return law if over <= 1.0 else _slowed(limits, law, over)


def _shortest_window(limits: PathLimits, raw: np.ndarray, taps: int | None) -> tuple[int, SampledTimeLaw]:
    """Find the law through a window of ``taps``; None: through the shortest window that leaves little swing."""
    if taps is not None:
        return taps, _with_window(limits, raw, taps)
    low, high = 0, len(TAP_COUNTS) - 1
    law = _with_window(limits, raw, TAP_COUNTS[high])
    while low < high:
        middle = (low + high) // 2
        tried = _with_window(limits, raw, TAP_COUNTS[middle])
        if tried.swing_rad <= SWING_RAD:
            high, law = middle, tried
        else:
            low = middle + 1
    return TAP_COUNTS[high], law


def _with_window(limits: PathLimits, raw: np.ndarray, taps: int) -> SampledTimeLaw:
    """Average the law over the window of ``taps`` that leaves least swing."""
    whole = len(raw) + taps * _TAP_STEPS
    whole += (whole + 1) % _TAP_STEPS
    impulses = np.full(taps + 1, 1.0 / (taps + 1))
    if not limits.sideways:
        return SampledTimeLaw(_convolved(raw, impulses, whole), 0.0)
    # The raw law every `TAP_S` up to the common end, delayed by every impulse.
    at = np.arange((whole - 1) % _TAP_STEPS - taps * _TAP_STEPS, whole, _TAP_STEPS)
    progress_samples = np.where(at < 0, 0.0, raw[np.clip(at, 0, len(raw) - 1)])
    delayed = np.lib.stride_tricks.sliding_window_view(progress_samples, taps + 1)[:, ::-1]
    residual_swing = _residual_swing(limits.pin_at(delayed @ impulses))
    for _ in range(REFINEMENT_COUNT if taps else 0):
        if _max_swing_rad(residual_swing) <= _GOOD_SHARE * SWING_RAD:
            break
        improved = _improved_impulses(limits, delayed, residual_swing, impulses)
        for share in (1.0, 0.5, 0.25):  # paths are curved: half a step may be better than a whole one
            tried = impulses + share * (improved - impulses)
            tried_swing = _residual_swing(limits.pin_at(delayed @ tried))
            if _max_swing_rad(tried_swing) < _max_swing_rad(residual_swing):
                impulses, residual_swing = tried, tried_swing
                break
        else:
            break
    return SampledTimeLaw(_convolved(raw, impulses, whole), _max_swing_rad(residual_swing))


def _convolved(raw: np.ndarray, impulses: np.ndarray, length: int) -> np.ndarray:
    """Convolve the raw law with the impulses, ``length`` samples."""
    kernel = np.zeros((len(impulses) - 1) * _TAP_STEPS + 1)
    kernel[::_TAP_STEPS] = impulses
    late = length - len(raw)
    begun = np.concatenate([np.zeros(len(kernel) - 1), raw, np.full(late, raw[-1])])
    return np.convolve(begun, kernel, mode="valid")


def _improved_impulses(limits: PathLimits, delayed: np.ndarray, left: np.ndarray, impulses: np.ndarray) -> np.ndarray:
    """Compute impulses with the least swing, linearized about the present ones."""
    slope = limits.pin_slope_at(delayed @ impulses) / SWING_RAD
    weights = _weights(len(delayed))
    rows = np.vstack([weights * column for column in slope.T]) @ delayed
    wish = rows @ impulses - left.T.ravel() / SWING_RAD
    size = _SUM_WEIGHT * max(1.0, float(np.max(np.abs(rows))))
    system = np.vstack([rows, np.full((1, len(impulses)), size)])
    try:
        solution, _ = nnls(system, np.append(wish, size))
    except RuntimeError:
        return impulses
    total = float(solution.sum())
    return solution / total if total > 0.0 else impulses


def _load(arm: Arm, limits: PathLimits, progress: np.ndarray) -> np.ndarray:
    """Compute the use of the limits at the samples, as a factor of time (1 = just within)."""
    q = np.column_stack([np.interp(progress, limits.fine, column) for column in limits.table[:, :N_JOINTS].T])
    v = np.gradient(q, STEP_S, axis=0)
    a = np.gradient(v, STEP_S, axis=0)
    fast = np.maximum(np.max(np.abs(v) / arm.speed, axis=1), arm.pump_load(q, v))
    result: np.ndarray = np.maximum(fast, np.sqrt(np.max(np.abs(a) / arm.acceleration, axis=1)))
    return result


def _reduced_speeds(brake: np.ndarray, load: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Lower the speed factors on the grid where a limit was violated."""
    worst = np.ones(GRID_COUNT + 1)
    at = np.clip(np.rint(where * GRID_COUNT).astype(int), 0, GRID_COUNT)
    np.maximum.at(worst, at, load)
    wide = np.max(np.stack([np.roll(worst, k) for k in range(-3, 4)]), axis=0)
    result: np.ndarray = brake / np.clip(wide, 1.0, 1.6)
    return result


def _slowed(limits: PathLimits, law: SampledTimeLaw, factor: float) -> SampledTimeLaw:
    """Return the same law, evenly slowed."""
    n = max(int(np.ceil((len(law.done) - 1) * factor)), 2)
    n += n % _TAP_STEPS
    done = law.progress(np.linspace(0.0, law.duration_s, n + 1))
    return SampledTimeLaw(
        done, _max_swing_rad(_residual_swing(limits.pin_at(done[::_TAP_STEPS]))) if limits.sideways else 0.0
    )
