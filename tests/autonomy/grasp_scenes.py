"""Logs for grasp planners: beside, upon and across each other, in the pick area of palms_471."""

from __future__ import annotations

from dataclasses import replace
from math import cos, sin, sqrt

import numpy as np

from autonomy.grasp.network import GraspMaps, PixelGrasp
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import TRIANGLE, LogObservation
from machine.loading.profile_file import load_profile

PROFILE = load_profile("palms_471")
ARM = Arm(PROFILE)
GROUND = PROFILE.workspace.ground_z_m
X, Y = PROFILE.workspace.pick_center_m
MEASURED = tuple(1e-6 if i in (0, 7, 13) else 0.0 for i in range(TRIANGLE))
"""Of a log that a camera sees well: 1 mm across and at one end."""


def log(
    number: int, across_m: float = 0.0, z_m: float = 0.0, yaw: float = 0.0, diameter: float = 0.2, along_m: float = 0.0
) -> LogObservation:
    """A log of 2.6 m whose underside is ``z_m`` over the ground, axis along +x turned by ``yaw``."""
    center = (X + along_m, Y + across_m, GROUND + z_m + diameter / 2)
    return LogObservation(number, center, (cos(yaw), sin(yaw), 0.0), 2.6, diameter)


def measured(log: LogObservation) -> LogObservation:
    """A log as a camera sees it that sees it well."""
    return replace(log, covariance=MEASURED)


def pair() -> list[LogObservation]:
    """Two logs side by side."""
    return [log(0, -0.105), log(1, 0.105)]


def small_pile() -> list[LogObservation]:
    """Two logs and a third in their valley."""
    return [*pair(), log(2, 0.0, sqrt(0.205**2 - 0.105**2))]


def cross() -> list[LogObservation]:
    """One log across two others that lie apart."""
    return [log(0, -0.4), log(1, 0.4), log(2, 0.0, 0.2, yaw=1.4)]


class Chosen:
    """A network that always finds the same pixel."""

    def __init__(self, u_px: float, v_px: float, theta: float) -> None:
        self.found, self.seen = PixelGrasp(u_px, v_px, theta, 0.9), None

    def best(self, depth_m: np.ndarray) -> PixelGrasp:
        self.seen = depth_m
        return self.found

    def maps(self, depth_m: np.ndarray) -> GraspMaps:
        nearest = (depth_m < depth_m.min() + 0.01).astype(float)
        return GraspMaps(nearest, -np.ones_like(nearest), np.zeros_like(nearest))
