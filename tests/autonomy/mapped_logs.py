"""Logs in the plane and their observations, for tests of the manager."""

from __future__ import annotations

import math

import numpy as np

from autonomy.manager.log_map import MappedLog
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation


def base(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return Pose(np.array([x_m, y_m, 1.5]), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def lying(number: int, x_m: float, y_m: float, yaw_rad: float = 0.0) -> MappedLog:
    axis = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    return MappedLog(number, np.array([x_m, y_m, 0.15]), axis, 2.0, 0.25, 0.1, 1, 0)


def seen(logs: list[MappedLog], at: Pose, error_m: tuple[float, float] = (0.0, 0.0)) -> list[LogObservation]:
    found = []
    for log in logs:
        o = log.observation(at)
        x, y, z = o.center_m
        found.append(LogObservation(o.id, (x + error_m[0], y + error_m[1], z), o.axis, o.length_m, o.diameter_m))
    return found
