"""Metrics of one motion from its trace: errors at rest, motion time, swing, share of closed valves.

Times are in s from the start of the reference.  A motion ends when the pin, by encoder kinematics, stays within
`NEAR_M` of its end point.  It has arrived when, in addition, the reference is at its end.  Swing counts from the end of
the reference, whether or not the pin has settled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

NEAR_M: Final = 0.02
REST_S: Final = (2.5, 3.0)
"""Interval after arrival whose mean is the rest position of the crane."""
SWING_S: Final = (1.0, 3.0)
"""Interval after the end of the reference in which swing counts."""
QUIET_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class Trace:
    """One motion and its rest: (n,) times, (n, 3) pins [m] by encoder kinematics and in truth (crane base frame), (n,)
    lean of the grapple against the vertical [deg]; (m,) times of valve commands and whether all were exactly zero.
    """

    time_s: np.ndarray
    encoder_m: np.ndarray
    true_m: np.ndarray
    lean_deg: np.ndarray
    command_s: np.ndarray
    shut: np.ndarray


def motion_metrics(trace: Trace, commanded_m: Any, goal_m: Any, reference_end_s: float) -> dict[str, Any]:
    """Compute the metrics of one motion as plain data.

    Vectors [m]: encoder error (reached less commanded), encoders and true pin relative to the goal.  ``motion_s`` is
    None if the pin did not stay near its end.  ``shut`` of ``commands`` valve commands after settling were zero.
    """
    near = np.linalg.norm(trace.encoder_m - commanded_m, axis=1) <= NEAR_M
    away = np.flatnonzero(~near)
    ended = bool(len(near)) and bool(near[-1])
    settled = int(away[-1]) + 1 if len(away) else 0
    motion_s = float(trace.time_s[settled]) if ended else None
    arrived_s = max(reference_end_s, motion_s or 0.0)
    rest = _within(trace.time_s, arrived_s, REST_S)
    swing = _within(trace.time_s, reference_end_s, SWING_S)
    reached, true = trace.encoder_m[rest].mean(axis=0), trace.true_m[rest].mean(axis=0)
    quiet = trace.shut[trace.command_s >= arrived_s + QUIET_S]
    return {
        "encoder_m": (reached - commanded_m).tolist(),
        "encoder_to_goal_m": (reached - goal_m).tolist(),
        "true_m": (true - goal_m).tolist(),
        "motion_s": motion_s,
        "arrived_s": arrived_s,
        "swing_deg": float(trace.lean_deg[swing].max()),
        "shut": int(quiet.sum()),
        "commands": len(quiet),
    }


def _within(time_s: np.ndarray, from_s: float, interval: tuple[float, float]) -> np.ndarray:
    """Select samples in an interval after a time; the last half second if the trace is too short."""
    in_interval = (time_s >= from_s + interval[0]) & (time_s <= from_s + interval[1])
    return in_interval if in_interval.any() else time_s >= time_s[-1] - 0.5
