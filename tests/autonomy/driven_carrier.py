"""The carrier of the driving tests, and locations of it."""

from __future__ import annotations

import numpy as np

from autonomy.localization.location import Location, Status
from machine.loading.profile_file import load_profile

CARRIER = load_profile("aoro_fc8").carrier
assert CARRIER is not None
SQUARE = [(0.0, 0.0), (25.0, 0.0), (25.0, 20.0)]


def at(x_m: float, y_m: float, yaw_rad: float, **values: float) -> Location:
    """A machine that is tracked there, straight and level, at cruising speed."""
    base = {
        "course_rad": yaw_rad,
        "speed_m_s": 0.6,
        "articulation_rad": 0.0,
        "roll_rad": 0.0,
        "pitch_rad": 0.0,
        "covariance": np.eye(3) * 1e-4,
        "front_height_m": 0.35,
    }
    stamp = int(values.pop("stamp_ns", 10**9))
    return Location(stamp, Status.TRACKING, "", x_m, y_m, 0.0, yaw_rad, **(base | values))
