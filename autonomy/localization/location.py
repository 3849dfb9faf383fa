"""What localization says: where the machine is, how sure of it, and why not when it cannot say."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


class Status(IntEnum):
    """How much a location is worth."""

    STARTING = 0
    """Not located yet."""
    TRACKING = 1
    DEAD_RECKONING = 2
    """By wheels and articulation alone, for at most ``localizer.RECKONING_NS``."""
    LOST = 3


@dataclass(frozen=True, slots=True)
class Location:
    """The machine at ``stamp_ns``; ``reason`` says why it is not tracked, empty while it is.

    ``x_m``, ``y_m`` are the middle of the front axle and ``yaw_rad`` the front half's direction, in the plane;
    ``z_m`` the height of that middle, NaN while no altitude is known.  ``covariance`` (3, 3) is of x, y and yaw.
    ``course_rad`` is where the front axle really goes, ``speed_m_s`` how fast, ``slip_curve_1_m`` the curvature that
    slip adds to what the articulation makes.  Roll (+ right side down) and pitch (+ nose up) are of the rear half.
    ``jumps`` counts how often position or heading were taken anew after they had been lost.
    """

    stamp_ns: int
    status: Status
    reason: str
    x_m: float = math.nan
    y_m: float = math.nan
    z_m: float = math.nan
    yaw_rad: float = math.nan
    covariance: np.ndarray = field(default_factory=lambda: np.full((3, 3), np.nan))
    height_sigma_m: float = math.nan
    course_rad: float = math.nan
    speed_m_s: float = 0.0
    slip_curve_1_m: float = 0.0
    articulation_rad: float = math.nan
    roll_rad: float = math.nan
    pitch_rad: float = math.nan
    front_height_m: float = math.nan
    jumps: int = 0

    @property
    def usable(self) -> bool:
        """Whether one may drive by it."""
        return self.status in (Status.TRACKING, Status.DEAD_RECKONING)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position along its worst direction [m]."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[:2, :2])[1]))
