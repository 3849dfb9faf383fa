"""A log at the end of a row that is too wide for the tongs is drawn out of it.

One open tong is pressed into the valley between it and its neighbour until its tip is beside them rather than on them,
the other comes down on free ground beyond; closing, they roll the log away from the row until both are under it.  Tongs
round the whole row, instead, stall at its sides, pull, and slip off over it.
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
"""In the plant's rows of three: 14 of 14, without another try."""
VALLEY_OFFSET_M: Final = 0.02
"""The tip comes down so far beyond the log's side: logs that touch part when it is pressed between them."""
NEIGHBOUR_OFFSET_M: Final = 0.05
"""What lies on one side of a log lies so far over there, at least."""
ROW_RADIUS_M: Final = 2.5
"""Logs whose middles are farther away are of no row with it."""


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
    """The thickest log at an end of a row on the ground at ``lowest_m`` that is in reach with free ground beside it and
    is none of those that are to stay (n,), nor lies on others or under them (``upon`` (n, n) of `quality.lies_upon`);
    None where there is none.  ``rot_rad`` is where the rotator stands.
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
            reason = f"log {logs[i].id} is drawn out of a row of {len(logs)} logs that is too wide for the tongs"
            return GraspCandidate(float(x), float(y), yaw, lowest_m, (i,), SUCCESS_PROBABILITY, reason, pressed=True, drawn=True)
    return None
