"""Extraction grasp: draws a log off the end of a row that is too wide for the grapple.

One open jaw penetrates the valley between the log and its neighbour until its tip is beside them rather than on them;
the other comes down on free ground beyond.  Closing, they roll the log away from the row until both are under it.  Jaws
around the whole row would instead stall at its sides, pull, and slip off over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, pi
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders
from autonomy.grasp.grapple_heights import grasp_pose
from autonomy.grasp.jaws import Jaws
from autonomy.grasp.planner import GraspCandidate
from autonomy.motion.arm import Arm
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.kinematics import Unreachable

SUCCESS_PROBABILITY: Final = 0.9
"""In the plant's rows of three: 14 of 14 at the first try."""
VALLEY_OFFSET_M: Final = 0.02
"""Distance of the tip beyond the log's side: logs that touch part when the tip is pressed between them."""
NEIGHBOUR_OFFSET_M: Final = 0.05
"""A neighbour's centre is at least this far to the side of the log."""
ROW_RADIUS_M: Final = 2.5
"""Logs whose centres are farther apart belong to different rows."""


def extract_end_log(
    arm: Arm,
    jaws: Jaws,
    world: Cylinders,
    upon: np.ndarray,
    logs: Sequence[LogObservation],
    stays: np.ndarray,
    lowest_m: float,
    rot_rad: float,
) -> GraspCandidate | None:
    """The extraction of the thickest log at the end of a row on the ground, or None where there is none.

    The log is in reach, has free ground beside it at ``lowest_m``, is not marked in ``stays`` (n,), and neither lies on
    others nor carries any (``upon`` (n, n) of `quality.rests_upon`).  ``rot_rad`` is the present rotator angle.
    """
    barred = stays | upon.any(axis=0) | upon.any(axis=1)
    for i in np.argsort(-world.radius, kind="stable").tolist():
        if barred[i]:
            continue
        yaw = atan2(world.axis[i, 1], world.axis[i, 0]) + pi / 2
        for side in (1.0, -1.0):
            out = side * np.array([np.cos(yaw), np.sin(yaw)])
            away = world.center[:, :2] - world.center[i, :2]
            beyond, near = away @ out, np.hypot(*away.T) < ROW_RADIUS_M
            if np.any(near & (beyond > NEIGHBOUR_OFFSET_M)) or not np.any(near & (beyond < -NEIGHBOUR_OFFSET_M)):
                continue
            x, y = world.center[i, :2] + out * (jaws.half_gap_m - world.radius[i] - VALLEY_OFFSET_M)
            try:
                grasp_pose(arm, float(x), float(y), yaw, lowest_m, logs[i].diameter_m, rot_rad)
            except Unreachable:
                continue
            reason = f"draws log {logs[i].id} out of a row of {len(logs)} logs that is too wide for the grapple"
            return GraspCandidate(
                float(x), float(y), yaw, lowest_m, (i,), SUCCESS_PROBABILITY, reason, penetrates=True, extracts=True
            )
    return None
