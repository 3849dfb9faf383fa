"""Choice of the telescope's extension along a path, the arm's redundancy, for the shortest travel time.

With a fixed telescope, a crane raises, lowers and retracts its grapple with the boom, its slowest joint; operators
let the telescope do most of it.  The corners of a path get those extensions with which every joint, and the pump, has
least to do. Speeds only, no time laws; no clock, no randomness.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from autonomy.motion.arm_kinematics import ArmKinematics
from autonomy.motion.pose import Pose
from machine.joints import Joint
from machine.profile import joint_limits

EXTENSION_COUNT: Final = 13
"""Number of extensions that are compared."""
_SAMPLES: Final = 7
_TOTAL_WORK_WEIGHT: Final = 0.15
"""Weight of all joints' work relative to that of the busiest joint."""
OUTER_RESERVE_M: Final = 0.2
"""Reserve at the outer end for a descent, where a log may not be exactly where it was detected."""
END_RESERVE_M: Final = 0.03
"""Reserve at both ends."""


def candidate_extensions(arm: ArmKinematics) -> np.ndarray:
    """The extensions to compare, m."""
    low, high = joint_limits(arm.profile)[Joint.EXT]
    return np.linspace(low + END_RESERVE_M, high - END_RESERVE_M, EXTENSION_COUNT)


def fastest_extension(arm: ArmKinematics, low: Pose, high: Pose, home: Pose) -> float | None:
    """The extension from which the crane gets up and over ``home`` fastest; None where none serves at both heights with
    `OUTER_RESERVE_M` to spare.
    """
    least, most = joint_limits(arm.profile)[Joint.EXT]
    free = np.linspace(least + END_RESERVE_M, most - OUTER_RESERVE_M, EXTENSION_COUNT)
    heights = np.array([low, low.at_height(0.5 * (low.z_m + high.z_m)), high])
    poses = np.repeat(heights[None], len(free), axis=0)
    poses[:, :, 3] = free[:, None]
    _, outside = arm.straight_column_joints(poses.reshape(-1, 5))
    any_way = candidate_extensions(arm)
    home_s = np.min(full_speed_times(arm, high, home, any_way, any_way), axis=1)
    seconds = np.min(full_speed_times(arm, low, high, free, any_way) + home_s, axis=1)
    seconds = np.where(outside.reshape(len(free), 3).any(axis=1), np.inf, seconds)
    best = int(np.argmin(seconds))
    return float(free[best]) if np.isfinite(seconds[best]) else None


def full_speed_times(arm: ArmKinematics, start: Pose, goal: Pose, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Duration of a straight path at full speed, from every extension ``before`` (n,) to every ``after`` (m,), (n, m).

    Infinite where it leaves the crane's reach.
    """
    share = np.linspace(0.0, 1.0, _SAMPLES)
    line = np.array(start) + share[:, None] * (np.array(goal) - np.array(start))
    n, m = len(before), len(after)
    poses = np.broadcast_to(line, (n, m, *line.shape)).copy()
    poses[..., Joint.EXT] = before[:, None, None] + share * (after[None, :, None] - before[:, None, None])
    q, outside = arm.straight_column_joints(poses.reshape(-1, 5))
    step = np.diff(q.reshape(n, m, _SAMPLES, 5), axis=2)
    middle = q.reshape(n, m, _SAMPLES, 5)[:, :, :-1] + 0.5 * step
    turned = np.sum(np.abs(step), axis=2) / arm.speed
    oil = arm.pump_load(middle.reshape(-1, 5), step.reshape(-1, 5)).reshape(n, m, -1).sum(axis=2)
    seconds = np.maximum(np.max(turned, axis=2), oil) + _TOTAL_WORK_WEIGHT * np.sum(turned, axis=2)
    return np.where(outside.reshape(n, m, _SAMPLES).any(axis=2), np.inf, seconds)


def with_fastest_extensions(arm: ArmKinematics, via: Sequence[Pose]) -> tuple[Pose, ...]:
    """The via points with the fastest extensions between the ends; unchanged where none is in reach."""
    if len(via) < 3:
        return tuple(via)
    free = candidate_extensions(arm)
    choices = [np.array([via[0].ext_m]), *[np.append(free, p.ext_m) for p in via[1:-1]], np.array([via[-1].ext_m])]
    best, came = np.zeros(1), []
    for k in range(len(via) - 1):
        total = best[:, None] + full_speed_times(arm, via[k], via[k + 1], choices[k], choices[k + 1])
        came.append(np.argmin(total, axis=0))
        best = np.min(total, axis=0)
    if not np.isfinite(best[0]):
        return tuple(via)
    at, out = 0, [via[-1]]
    for k in range(len(via) - 2, 0, -1):
        at = int(came[k][at])
        out.append(via[k]._replace(ext_m=float(choices[k][at])))
    return (via[0], *reversed(out))
