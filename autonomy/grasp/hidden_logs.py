"""Hidden logs: a camera above a heap sees its uppermost logs only, but those lie on others.

A log whose underside is off the ground is held up on both sides.  Where no log in view does so on one side, a log on
the ground does that touches it from below, as thick as the logs in view are by their median.  A planner that knew only
the logs in view would choose jaws that open no wider than these, and close them on what holds them up.
"""

from __future__ import annotations

from math import cos, radians, sqrt
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders, axis_offsets
from autonomy.grasp.quality import CONTACT_M, rests_upon
from autonomy.grasp.settled_poses import MAX_HEIGHT_ON_GROUND_M, surface_gaps
from autonomy.perception.log_list import ACROSS_1, ACROSS_2, RADIUS, SIZE, TILT_1, TILT_2, LogObservation

MAX_OVERLAP_M: Final = 0.06
"""A hidden log that would overlap one in view by more than this is not there: that one holds up what lies on it."""
MAX_COUNT: Final = 6
CROSSING_COS: Final = cos(radians(25.0))
"""A log that crosses the one on it at a larger angle holds it up on both sides."""
_SIGMA: Final = {ACROSS_1: 0.06, ACROSS_2: 0.02, TILT_1: 0.05, TILT_2: 0.02, RADIUS: 0.03}
_END_SIGMA_M: Final = 0.3
"""Standard deviations [m, rad] of the pose and the radius of a hidden log, and of its ends."""


def with_hidden_logs(
    measured: Cylinders, world: Cylinders, covariances: np.ndarray, ground_z_m: float
) -> tuple[Cylinders, np.ndarray]:
    """Append the hidden logs, and their covariances (7, 7), to the settled logs (n) in view on level ground.

    ``measured``: the same logs before they were settled.  Of two that were measured too thick one is pushed up, and
    lies on the ground all the same.
    """
    radius_m, count = float(np.median(world.radius)), 0
    undersides_m = np.minimum(measured.center[:, 2] - measured.radius, world.center[:, 2] - world.radius)
    above_ground_m = undersides_m - ground_z_m
    for i in np.argsort(world.center[:, 2], kind="stable").tolist():
        if above_ground_m[i] < MAX_HEIGHT_ON_GROUND_M:
            continue
        for side in (-1.0, 1.0):
            if count == MAX_COUNT or _is_held_up(world, i, side):
                continue
            holding = _joined(world, _beneath(world, i, side, radius_m, ground_z_m))
            if np.all(surface_gaps(holding)[-1, :-1] > -MAX_OVERLAP_M):
                world, count = holding, count + 1
    sigma = np.full(SIZE, _END_SIGMA_M)
    sigma[list(_SIGMA)] = list(_SIGMA.values())
    return world, np.concatenate([covariances, np.tile(np.diag(sigma**2), (count, 1, 1))])


def hidden_observations(world: Cylinders, visible_count: int) -> list[LogObservation]:
    """List the logs of ``world`` from index ``visible_count`` on, with negative numbers."""
    hidden = []
    for i in range(visible_count, world.count):
        (x, y, z), (ax, ay, az) = world.center[i].tolist(), world.axis[i].tolist()
        length_m, diameter_m = float(world.length[i]), 2.0 * float(world.radius[i])
        hidden.append(LogObservation(visible_count - 1 - i, (x, y, z), (ax, ay, az), length_m, diameter_m))
    return hidden


def _is_held_up(world: Cylinders, i: int, side: float) -> bool:
    """Tell whether a log holds up log ``i`` on one side of its axis (1: left of it)."""
    left = np.array([-world.axis[i, 1], world.axis[i, 0]])
    off = axis_offsets(world)[:, i]
    touches = np.linalg.norm(off, axis=-1) < (world.radius + world.radius[i] + CONTACT_M)[:, None]
    beside = np.any(touches & (-side * (off[..., :2] @ left) > 0.0), axis=-1)
    crosses = np.abs(world.axis @ world.axis[i]) < CROSSING_COS
    return bool(np.any(rests_upon(world)[:, i] & (beside | crosses)))


def _beneath(world: Cylinders, i: int, side: float, radius_m: float, ground_z_m: float) -> Cylinders:
    """Make the log on the ground that touches log ``i`` from below on one side, parallel to it."""
    axis = world.axis[i] * (1.0, 1.0, 0.0)
    axis /= max(float(np.linalg.norm(axis)), 1e-6)
    apart_m, rise_m = radius_m + world.radius[i], world.center[i, 2] - ground_z_m - radius_m
    aside_m = sqrt(max(apart_m**2 - rise_m**2, (0.5 * apart_m) ** 2))
    center = world.center[i] + side * aside_m * np.array([-axis[1], axis[0], 0.0])
    center[2] = max(ground_z_m + radius_m, world.center[i, 2] - sqrt(apart_m**2 - min(aside_m, apart_m) ** 2))
    return Cylinders(center[None], axis[None], world.length[i : i + 1], np.array([radius_m]))


def _joined(a: Cylinders, b: Cylinders) -> Cylinders:
    pairs = ((a.center, b.center), (a.axis, b.axis), (a.length, b.length), (a.radius, b.radius))
    return Cylinders(*(np.concatenate(pair) for pair in pairs))
