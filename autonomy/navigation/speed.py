"""Speed limits: bends, tip-over margin, rough ground, distance to the stop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from autonomy.localization.location import Location
from autonomy.navigation.clothoid_path import Path
from machine.geometry.carrier import ARMS, hub_m, pivot_height_m, rear_from_front
from machine.profile import Carrier

MASS_HEIGHT_M: Final = 0.55
"""Height of the centre of mass above the pivots, crane in transport pose, bunk full (assumed)."""
MASS_REACH_SHARE: Final = 0.9
"""Both halves have the same mass, which acts at this share of the distance to the axle (assumed)."""
FULL_MARGIN_M: Final = 0.55
"""Full speed with this margin to the edge of the support polygon; ..."""
MIN_MARGIN_M: Final = 0.20
"""... no driving below this one."""
MIN_SPEED_SHARE: Final = 0.3
"""Share of the wanted speed just above the least margin, or on the roughest ground."""
CALM_RAD_S: Final = 0.06
ROUGH_RAD_S: Final = 0.30
"""Rate of rocking at full speed and at the slowest speed."""
ROCKING_S: Final = 2.0
RATE_SHARE: Final = 0.85
"""Share of the articulation rate limit that a bend may use."""
BRAKING_M_S2: Final = 0.15
CREEP_M_S: Final = 0.10
GRAVITY_M_S2: Final = 9.81
LOOK_AHEAD_M: Final = 1.5
"""Look-ahead distance for bends."""
LOOK_AHEAD_STEP_M: Final = 0.25


def tip_margin_m(carrier: Carrier, location: Location, acceleration_m_s2: float = 0.0) -> float:
    """Distance of the weight's line of action inside the support polygon [m], from roll, pitch and articulation; 0 or
    less means tipping.

    ``acceleration_m_s2`` is positive to the left.  The masses are assumed, because the profile has none.
    """
    height = pivot_height_m(carrier, location.front_height_m) + MASS_HEIGHT_M
    side = math.atan2(acceleration_m_s2, GRAVITY_M_S2)
    front = rear_from_front(location.articulation_rad, (MASS_REACH_SHARE * carrier.front_axle_m, 0.0, 0.0))
    x = 0.5 * (front[0] - MASS_REACH_SHARE * carrier.rear_axle_m) - height * math.tan(location.pitch_rad)
    y = 0.5 * front[1] - height * math.tan(side) - height * math.tan(location.roll_rad)
    points = []
    for arm in (ARMS[0], ARMS[2], ARMS[3], ARMS[1]):
        hub = hub_m(carrier, arm, location.front_height_m)
        points.append(rear_from_front(location.articulation_rad, hub) if arm.startswith("arm_f") else hub)
    margin = math.inf
    for (ax, ay, _), (bx, by, _) in zip(points, (*points[1:], points[0]), strict=True):
        ex, ey = bx - ax, by - ay
        margin = min(margin, (ex * (y - ay) - ey * (x - ax)) / math.hypot(ex, ey))
    return margin


@dataclass(slots=True)
class Rocking:
    """Rate of change of roll and pitch, smoothed over ``ROCKING_S``."""

    rate_rad_s: float = 0.0
    _last: tuple[int, float, float] | None = None

    def step(self, location: Location) -> float:
        """Update with a location; returns the rate [rad/s]."""
        now = location.stamp_ns, location.roll_rad, location.pitch_rad
        if self._last is not None and now[0] > self._last[0]:
            seconds = (now[0] - self._last[0]) * 1e-9
            rate = math.hypot(now[1] - self._last[1], now[2] - self._last[2]) / seconds
            self.rate_rad_s += min(1.0, seconds / ROCKING_S) * (rate - self.rate_rad_s)
        self._last = now
        return self.rate_rad_s


def terrain_speed_share(margin_m: float, rocking_rad_s: float) -> float:
    """Share of the wanted speed that ground and slope allow; 0 means stop."""
    if margin_m < MIN_MARGIN_M:
        return 0.0
    steady = min(1.0, (margin_m - MIN_MARGIN_M) / (FULL_MARGIN_M - MIN_MARGIN_M))
    calm = min(1.0, max(0.0, (ROUGH_RAD_S - rocking_rad_s) / (ROUGH_RAD_S - CALM_RAD_S)))
    return MIN_SPEED_SHARE + (1.0 - MIN_SPEED_SHARE) * min(steady, calm)


def bend_speed_m_s(carrier: Carrier, path: Path, s_m: float) -> float:
    """Greatest speed at which the articulation can follow the path ahead of ``s_m``."""
    fastest = math.inf
    lf, lr = carrier.front_axle_m, carrier.rear_axle_m
    limit = RATE_SHARE * carrier.articulation_rate_limit_rad_s
    curves = [path.at(s_m + k * LOOK_AHEAD_STEP_M)[3] for k in range(int(LOOK_AHEAD_M / LOOK_AHEAD_STEP_M) + 2)]
    for before, after in pairwise(curves):
        articulation_rad_m = abs(after - before) / LOOK_AHEAD_STEP_M * (lf + lr)
        if articulation_rad_m > 0.0:
            fastest = min(fastest, limit / articulation_rad_m)
    return fastest


def stopping_speed_m_s(left_m: float) -> float:
    """Speed with ``left_m`` to go: constant deceleration that ends in a creep."""
    return max(CREEP_M_S, math.sqrt(2.0 * BRAKING_M_S2 * max(0.0, left_m)))
