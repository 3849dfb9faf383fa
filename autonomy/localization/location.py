"""The result of localization: position, its uncertainty, and the reason when there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


class Status(IntEnum):
    """Quality of a location."""

    STARTING = 0
    """Not located yet."""
    TRACKING = 1
    DEAD_RECKONING = 2
    """By wheels and articulation only, for at most ``localizer.RECKONING_NS``."""
    LOST = 3


@dataclass(frozen=True, slots=True)
class Location:
    """The machine at ``stamp_ns``; ``reason`` says why it is not tracked, empty otherwise.

    ``x_m``, ``y_m`` are the centre of the front axle and ``yaw_rad`` the direction of the front half, in the plane;
    ``z_m`` is the height of that centre, NaN without an altitude.  ``covariance`` (3, 3) is of x, y and yaw.
    ``course_rad`` is the direction in which the front axle moves, ``speed_m_s`` its speed, ``slip_curve_1_m`` the
    curvature that slip adds to that of the articulation.  Roll (+ right side down) and pitch (+ nose up) are those of
    the rear half.  ``jumps`` counts re-initializations of position or heading after a loss.
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
        """Whether the location is good enough for driving."""
        return self.status in (Status.TRACKING, Status.DEAD_RECKONING)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position along its worst direction [m]."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[:2, :2])[1]))
