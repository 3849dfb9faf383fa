"""An ideal log detector: the true poses of the logs in the crane's base frame, without error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim.camera.geometry import quaternion_matrix
from sim.geometry.shape import Vector
from sim.plant import Plant

AROUND_CRANE_M: Final = 9.0
AHEAD_OF_FRONT_M: Final = 12.0


@dataclass(frozen=True, slots=True)
class Detection:
    """Number of the log in the scene, its middle and unit axis in the crane's base frame, and its size."""

    id: int
    position_m: Vector
    axis: Vector
    length_m: float
    diameter_m: float


def detect(plant: Plant) -> list[Detection]:
    """All logs of the plant, in scene order.  The base frame moves and leans with a carrier."""
    logs = plant.logs()
    if plant.profile.carrier is None:
        return [Detection(i, log.position_m, log.axis, log.length_m, log.diameter_m) for i, log in enumerate(logs)]
    origin, turn = plant.base_pose()
    rotation = quaternion_matrix(turn)  # base to world: a row vector times it is in the base frame
    return [
        Detection(
            i,
            tuple((np.subtract(log.position_m, origin) @ rotation).tolist()),
            tuple((np.asarray(log.axis) @ rotation).tolist()),
            log.length_m,
            log.diameter_m,
        )
        for i, log in enumerate(logs)
    ]


def detect_in_view(plant: Plant) -> list[Detection]:
    """The logs that the cameras of a forwarder could see: around the crane, or in a quarter ahead of the front half."""
    return [log for log in detect(plant) if _in_view(*log.position_m[:2])]


def _in_view(x_m: float, y_m: float) -> bool:
    """Whether a place in the base frame, whose x axis points backwards, is in view."""
    return math.hypot(x_m, y_m) < AROUND_CRANE_M or (-AHEAD_OF_FRONT_M < x_m < 0.0 and abs(y_m) < -x_m)
