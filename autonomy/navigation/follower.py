"""Path following by articulation: feed-forward of the path's curvature, feedback of lateral and course error.

The centre of the front axle follows the path.  Without slip, its curvature is kappa = (sin g + lr g_s) / (lf cos g +
lr), where g_s is the articulation's change per metre.  A wanted curvature therefore needs

    g_s = (kappa (lf cos g + lr) - sin g) / lr,

which is stable forwards without look-ahead.  With the lateral error e (+ left of the path) and the course error c,

    c_wanted = -atan(LAMBDA e),   kappa = path's + d c_wanted / ds - GAMMA (c - c_wanted) - slip's curvature,

so that far from the path the machine returns at a bounded angle, and near it the error decays as exp(-LAMBDA s) over
the distance s.  Course and slip come from the localization filter: on a side slope the front points uphill while the
machine drives straight.  The remaining error is integrated, slowly and only near the path, and added to e.  All errors
are predicted to the time at which the valve acts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from autonomy.localization.local_plane import wrapped
from autonomy.localization.location import Location
from autonomy.navigation.clothoid_path import Path
from machine.profile import Carrier

LAMBDA_1_M: Final = 0.55
GAMMA_1_M: Final = 1.1
INTEGRAL_M: Final = 6.0
"""A lateral error that persists over this distance counts twice."""
INTEGRAL_LIMIT_M: Final = 0.10
NEAR_M: Final = 0.25
NEAR_RAD: Final = 0.15
"""The error is integrated only closer than this to the path and its direction."""
REACTION_S: Final = 0.10
"""Delay from report to oil flow that the controller's own loop does not compensate (assumed)."""
BACK_M: Final = 1.0
FORTH_M: Final = 2.0
"""Search range around the last nearest point, because a path may cross itself."""
RATE_SHARE: Final = 0.95
ANGLE_SPARE_RAD: Final = 0.005
MAX_LEAD_RAD: Final = 0.12
"""Maximum lead of the wanted angle over the measured one."""
MAX_EXTRAPOLATION_S: Final = 0.2
"""Maximum extrapolation time of a wanted angle."""
MAX_RETURN_RAD: Final = 1.1
"""Greatest angle between course and path while returning to it."""


@dataclass(frozen=True, slots=True)
class SteeringCommand:
    """The follower's output: articulation [rad] and its rate [rad/s], + bends left; and the machine's position on the
    path: nearest point ``s_m``, lateral error ``off_m`` (+ left of it), course error ``off_rad``.
    """

    articulation_rad: float
    articulation_rate_rad_s: float
    s_m: float
    off_m: float
    off_rad: float


@dataclass(frozen=True, slots=True)
class FollowerState:
    """The follower's state: position along the path and last wanted articulation; None at the beginning."""

    s_m: float | None = None
    articulation_rad: float | None = None
    articulation_rate_rad_s: float = 0.0
    stamp_ns: int = 0
    integral_m: float = 0.0


def follow_path(
    carrier: Carrier, path: Path, state: FollowerState, location: Location, speed_m_s: float
) -> tuple[FollowerState, SteeringCommand]:
    """One step at the location's stamp; ``speed_m_s`` is the speed about to be requested."""
    articulation, speed = location.articulation_rad, location.speed_m_s
    turn_1_m = (
        math.sin(articulation) / (carrier.front_axle_m * math.cos(articulation) + carrier.rear_axle_m)
        + location.slip_curve_1_m
    )
    ahead_m = speed * REACTION_S
    course = location.course_rad + 0.5 * ahead_m * turn_1_m
    x, y = location.x_m + ahead_m * math.cos(course), location.y_m + ahead_m * math.sin(course)
    course = location.course_rad + ahead_m * turn_1_m
    around = () if state.s_m is None else (state.s_m - BACK_M, state.s_m + FORTH_M)
    s = path.nearest(x, y, *around)
    px, py, heading, curve = path.at(s)
    off = -math.sin(heading) * (x - px) + math.cos(heading) * (y - py)
    off_course = wrapped(course - heading)
    integral = state.integral_m
    if abs(off) < NEAR_M and abs(off_course) < NEAR_RAD and state.s_m is not None:
        integral += max(0.0, min(FORTH_M, s - state.s_m)) * off / INTEGRAL_M
        integral = max(-INTEGRAL_LIMIT_M, min(INTEGRAL_LIMIT_M, integral))
    pull = LAMBDA_1_M * (off + integral)
    wanted = max(-MAX_RETURN_RAD, min(MAX_RETURN_RAD, -math.atan(pull)))
    course_change = -LAMBDA_1_M / (1.0 + pull**2) * math.sin(off_course)
    own = curve * math.cos(off_course) / max(0.3, 1.0 - curve * off)
    kappa = own + course_change - GAMMA_1_M * wrapped(off_course - wanted) - location.slip_curve_1_m
    angle, rate = _articulation(carrier, state, location, kappa, speed_m_s)
    return FollowerState(s, angle, rate, location.stamp_ns, integral), SteeringCommand(angle, rate, s, off, off_course)


def _articulation(
    carrier: Carrier, state: FollowerState, location: Location, kappa: float, speed_m_s: float
) -> tuple[float, float]:
    """The wanted articulation at the location's stamp and its rate, within the machine's limits."""
    angle = measured = location.articulation_rad
    if state.articulation_rad is not None:
        seconds = min(MAX_EXTRAPOLATION_S, (location.stamp_ns - state.stamp_ns) * 1e-9)
        angle = state.articulation_rad + seconds * state.articulation_rate_rad_s
    limit = carrier.articulation_limit_rad - ANGLE_SPARE_RAD
    low, high = max(-limit, measured - MAX_LEAD_RAD), min(limit, measured + MAX_LEAD_RAD)
    angle = max(low, min(high, angle))
    lf, lr = carrier.front_axle_m, carrier.rear_axle_m
    fastest = RATE_SHARE * carrier.articulation_rate_limit_rad_s
    rate = speed_m_s * (kappa * (lf * math.cos(angle) + lr) - math.sin(angle)) / lr
    rate = max(-fastest, min(fastest, rate))
    if abs(angle) >= limit and angle * rate > 0.0:
        rate = 0.0
    return angle, rate
