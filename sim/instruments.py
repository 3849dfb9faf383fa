"""Instruments of a test bench round the plant: an ideal detector, a total station, targets of a camera survey."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from math import pi, radians
from typing import Any, Final

import numpy as np

from sim.camera.geometry import quaternion_matrix
from sim.geometry import Vector, quaternion_rpy
from sim.plant import Plant
from sim.truth.load import load_truth

# -- An ideal log detector: the true poses of the logs in the crane's base frame, without error.

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
    """Detect all logs of the plant, in scene order.  The base frame moves and leans with a carrier."""
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
    """Detect the logs that a forwarder's cameras see: around the crane, or in a quarter ahead of the front half."""
    return [log for log in detect(plant) if _in_view(*log.position_m[:2])]


def _in_view(x_m: float, y_m: float) -> bool:
    """Tell whether a place in the base frame, whose x axis points backwards, is in view."""
    return math.hypot(x_m, y_m) < AROUND_CRANE_M or (-AHEAD_OF_FRONT_M < x_m < 0.0 and abs(y_m) < -x_m)


# -- A surveying instrument of the test bench, with realistic noise: it reads the position of the hanger pin and the
# direction of the grapple in the crane's base frame.

POSITION_SIGMA_M: Final = 0.002
"""One sigma per axis: a total station that tracks a prism on a swinging boom."""
YAW_SIGMA_RAD: Final = radians(1.0)
"""One sigma: two points of a hanging grapple that still moves a little."""


class TotalStation:
    """Reads positions; its noise comes from its own seed."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(f"total station {seed}")
        self._yaw_rng = random.Random(f"total station, direction {seed}")

    def read(self, pin_m: Vector) -> Vector:
        """Take the reading [m] for a pin at ``pin_m``."""
        x, y, z = (axis + self._rng.gauss(0.0, POSITION_SIGMA_M) for axis in pin_m)
        return (x, y, z)

    def read_yaw(self, yaw_rad: float) -> float:
        """Take the reading [rad] for a grapple opening along ``yaw_rad``: 0..pi, because its two sides look alike."""
        return (yaw_rad + self._yaw_rng.gauss(0.0, YAW_SIGMA_RAD)) % pi


def grapple_yaw(plant: Plant) -> float:
    """Return the true direction along which the grapple opens, about the vertical, in the crane's base frame [rad]."""
    grapple, base = plant.link_poses()["rotator"][1], plant.base_pose()[1]
    return quaternion_rpy(grapple)[2] - quaternion_rpy(base)[2]


# -- What an emulated survey of a camera needs of the plant: its hidden mount and noise, for the targets that it sees.


def seen_with(truth: str, seed: int, machine: str) -> Any:
    """Load the truth about a machine and its cameras, as ``plant.world.truth``, where another process has the plant.

    Raises:
        PlantError: the truth cannot be used.
    """
    return load_truth(truth, seed, machine)
