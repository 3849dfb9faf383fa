"""Shortest time for a path under limits of joint speeds, joint accelerations and the pump's flow.

The path is a sequence of joint positions; its own timing does not count.  Over the path parameter s the state is the
squared speed x = (ds/dt)^2 and the control is u = d2s/dt2, so that every limit is linear in both:

    speed         q'^2 x <= v^2
    flow          (sum |q'| flow lever)^2 x <= pump^2
    acceleration  -a <= q' u + q'' x <= a

A backward pass gives the largest x from which the rest of the path is feasible; a forward pass drives as fast as that
allows (reachability analysis after Pham and Pham, 2018).  Jerk, delay, swing and error are not included: no controller
reaches this time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from machine.joints import JOINTS
from machine.profile import Profile, joint

POINT_COUNT: Final = 400
MIN_SPACING_SHARE: Final = 1e-6
"""Samples nearer than this share of the path are merged; the slow ends of a timed motion would disturb the spline."""
EPSILON: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits per joint: speed [unit/s], acceleration [unit/s^2], flow on the plus and the minus side [m^3/unit].

    ``levers``: tables of positions and shares per joint, empty for none; ``pump_m3_s``: flow of all joints together.
    """

    speed: np.ndarray
    acceleration: np.ndarray
    flow_plus: np.ndarray
    flow_minus: np.ndarray
    levers: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]
    pump_m3_s: float

    def flow(self, q: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Compute the flow [m^3] per unit of the path's parameter at positions and slopes (n, joints), (n,)."""
        per_unit = np.where(slope >= 0.0, self.flow_plus, self.flow_minus)
        arms = [
            np.interp(c, at, share) if at else np.ones(len(q)) for c, (at, share) in zip(q.T, self.levers, strict=True)
        ]
        total: np.ndarray = np.sum(np.abs(slope) * per_unit * np.column_stack(arms), axis=1)
        return total


def full_limits(profile: Profile) -> Limits:
    """Return the full limits of the profile, without the margins that a planner leaves to the law."""
    specs = [joint(profile, j) for j in JOINTS]
    return Limits(
        np.array([s.speed_limit for s in specs]),
        np.array([s.acceleration_limit for s in specs]),
        np.array([s.valve.flow_plus for s in specs]),
        np.array([s.valve.flow_minus for s in specs]),
        tuple((s.valve.lever_at, s.valve.lever) for s in specs),
        profile.hydraulics.pump_flow_m3_s,
    )


def minimum_time_s(path: np.ndarray, limits: Limits) -> float:
    """Compute the shortest time [s] from rest to rest along joint positions (n, joints); 0 for one without motion."""
    q, slope, bend, step = _resampled(path, limits.speed)
    if not step:
        return 0.0
    most = _largest(q, slope, limits)
    reach = np.zeros(len(q))
    for i in range(len(q) - 2, -1, -1):
        low, high = _bounds(slope[i], bend[i], limits.acceleration)
        # Bounds from the next point: 0 <= x + 2 step u <= its largest x.
        low = np.vstack([low, [0.0, -0.5 / step]])
        high = np.vstack([high, [0.5 * reach[i + 1] / step, -0.5 / step]])
        reach[i] = min(most[i], _at_zero_slope(slope[i], bend[i], limits.acceleration), _crossing(low, high))
    x, time_s = 0.0, 0.0
    for i in range(len(q) - 1):
        _, high = _bounds(slope[i], bend[i], limits.acceleration)
        following = min(reach[i + 1], x + 2.0 * step * float(np.min(high[:, 0] + high[:, 1] * x)))
        following = max(following, 0.0)
        speeds = np.sqrt(x) + np.sqrt(following)
        if not speeds:
            return float("inf")
        time_s += 2.0 * step / float(speeds)
        x = following
    return time_s


def _resampled(path: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return positions, first and second derivatives at even steps of s (time at the speed limits), and the step."""
    path_times_s = np.concatenate([[0.0], np.cumsum(np.sqrt(np.sum((np.diff(path, axis=0) / speed) ** 2, axis=1)))])
    end = float(path_times_s[-1])
    if end <= 0.0:
        return path[:1], path[:1], path[:1], 0.0
    node_indices = [0]
    for i, path_time_s in enumerate(path_times_s):
        if path_time_s - path_times_s[node_indices[-1]] > MIN_SPACING_SHARE * end:
            node_indices.append(i)
    curve = CubicSpline(path_times_s[node_indices], path[node_indices])
    s = np.linspace(0.0, float(path_times_s[node_indices[-1]]), POINT_COUNT + 1)
    return curve(s), curve(s, 1), curve(s, 2), float(s[1])


def _largest(q: np.ndarray, slope: np.ndarray, limits: Limits) -> np.ndarray:
    """Compute the largest x allowed by speeds and flow, (n,)."""
    by_speed = np.max(np.abs(slope) / limits.speed, axis=1)
    by_flow = limits.flow(q, slope) / limits.pump_m3_s
    greatest: np.ndarray = np.maximum(np.maximum(by_speed, by_flow), EPSILON) ** -2
    return greatest


def _bounds(slope: np.ndarray, bend: np.ndarray, most: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute lower and upper bounds of the control as lines (at x = 0, per x), one per joint that moves along s."""
    moves = np.abs(slope) > EPSILON
    size, lean = most[moves] / np.abs(slope[moves]), -bend[moves] / slope[moves]
    return np.column_stack([-size, lean]), np.column_stack([size, lean])


def _at_zero_slope(slope: np.ndarray, bend: np.ndarray, most: np.ndarray) -> float:
    """Compute the largest x allowed by joints whose slope is zero here: their acceleration is q'' x."""
    still = (np.abs(slope) <= EPSILON) & (np.abs(bend) > EPSILON)
    return float(np.min(most[still] / np.abs(bend[still]))) if np.any(still) else float("inf")


def _crossing(low: np.ndarray, high: np.ndarray) -> float:
    """Compute the largest x at which no lower line is above an upper one; all hold at x = 0."""
    rise = low[:, None, 1] - high[None, :, 1]
    room = high[None, :, 0] - low[:, None, 0]
    rising = rise > EPSILON
    return max(0.0, float(np.min(room[rising] / rise[rising]))) if np.any(rising) else float("inf")
