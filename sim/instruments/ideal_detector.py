"""A detector that makes no mistakes: logs where they truly lie, in the crane's base frame."""

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
    """A log's number in the scene, its middle and the direction of its axis (a unit vector) in the crane's base frame,
    and its size.
    """

    id: int
    position_m: Vector
    axis: Vector
    length_m: float
    diameter_m: float


def detect(plant: Plant) -> list[Detection]:
    """Every log of the plant, in scene order.  The base frame moves and leans with a carrier."""
    logs = plant.logs()
    if plant.profile.carrier is None:
        return [Detection(i, log.position_m, log.axis, log.length_m, log.diameter_m) for i, log in enumerate(logs)]
    origin, turn = plant.base_pose()
    rotation = quaternion_matrix(turn)  # of the base in the world, so that a row vector times it is in the base
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
    """Those of them that cameras of a forwarder could see: round the crane, or before the front, a quarter wide."""
    return [log for log in detect(plant) if _in_view(*log.position_m[:2])]


def _in_view(x_m: float, y_m: float) -> bool:
    """Whether a place in the base frame, which looks backwards, is in view."""
    return math.hypot(x_m, y_m) < AROUND_CRANE_M or (-AHEAD_OF_FRONT_M < x_m < 0.0 and abs(y_m) < -x_m)
