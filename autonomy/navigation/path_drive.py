"""A drive along a planned path (ours): path following, with the speed limited by bends, ground and the next stop."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

from autonomy.localization.local_plane import wrapped
from autonomy.localization.location import Location, Status
from autonomy.navigation.clothoid_path import Path
from autonomy.navigation.drive_request import DriveRequest
from can_dbc.messages.vehicle import Steering
from machine.geometry.carrier import ARMS, hub_m, pivot_height_m, rear_from_front
from machine.profile import Carrier

# -- Speed limits: bends, tip-over margin, rough ground, distance to the stop.


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
DRIVE_RATE_SHARE: Final = 0.85
"""Share of the articulation rate limit that a bend may use."""
BRAKING_M_S2: Final = 0.15
CREEP_M_S: Final = 0.10
GRAVITY_M_S2: Final = 9.81
LOOK_AHEAD_M: Final = 1.5
"""Look-ahead distance for bends."""
LOOK_AHEAD_STEP_M: Final = 0.25


def tip_margin_m(carrier: Carrier, location: Location, acceleration_m_s2: float = 0.0) -> float:
    """Compute the distance of the weight's line of action inside the support polygon [m], from roll, pitch and
    articulation; 0 or less means tipping.

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
        """Update with a location; return the rate [rad/s]."""
        now = location.stamp_ns, location.roll_rad, location.pitch_rad
        if self._last is not None and now[0] > self._last[0]:
            seconds = (now[0] - self._last[0]) * 1e-9
            rate = math.hypot(now[1] - self._last[1], now[2] - self._last[2]) / seconds
            self.rate_rad_s += min(1.0, seconds / ROCKING_S) * (rate - self.rate_rad_s)
        self._last = now
        return self.rate_rad_s


def terrain_speed_share(margin_m: float, rocking_rad_s: float) -> float:
    """Compute the share of the wanted speed that ground and slope allow; 0 means stop."""
    if margin_m < MIN_MARGIN_M:
        return 0.0
    steady = min(1.0, (margin_m - MIN_MARGIN_M) / (FULL_MARGIN_M - MIN_MARGIN_M))
    calm = min(1.0, max(0.0, (ROUGH_RAD_S - rocking_rad_s) / (ROUGH_RAD_S - CALM_RAD_S)))
    return MIN_SPEED_SHARE + (1.0 - MIN_SPEED_SHARE) * min(steady, calm)


def bend_speed_m_s(carrier: Carrier, path: Path, s_m: float) -> float:
    """Compute the greatest speed at which the articulation can follow the path ahead of ``s_m``."""
    fastest = math.inf
    lf, lr = carrier.front_axle_m, carrier.rear_axle_m
    limit = DRIVE_RATE_SHARE * carrier.articulation_rate_limit_rad_s
    curves = [path.at(s_m + k * LOOK_AHEAD_STEP_M)[3] for k in range(int(LOOK_AHEAD_M / LOOK_AHEAD_STEP_M) + 2)]
    for before, after in pairwise(curves):
        articulation_rad_m = abs(after - before) / LOOK_AHEAD_STEP_M * (lf + lr)
        if articulation_rad_m > 0.0:
            fastest = min(fastest, limit / articulation_rad_m)
    return fastest


def stopping_speed_m_s(left_m: float) -> float:
    """Compute the speed with ``left_m`` to go: constant deceleration that ends in a creep."""
    return max(CREEP_M_S, math.sqrt(2.0 * BRAKING_M_S2 * max(0.0, left_m)))


# -- A drive along a planned path (ours)


MAX_SIGMA_M: Final = 0.25
"""A worse position is not used for driving."""
MAX_OFF_PATH_M: Final = 1.5
"""A machine that was on the path and is this far beside it is reported as off the path."""
ON_PATH_M: Final = 0.5
ON_PATH_RAD: Final = 0.3
"""Closer than this to the path and its direction, the machine is on it."""
RECKONING_SHARE: Final = 0.5
"""Share of the speed while dead reckoning."""
STOP_M: Final = 0.015
"""Stopping distance from creep speed (assumed)."""
SPEED_GAIN_1_S: Final = 0.5
SPEED_SPARE_M_S: Final = 0.15
SPEED_NEAR_M_S: Final = 0.2
"""The integral of the speed error runs only this close to the wanted speed, not while starting."""
HALTED_M_S: Final = 0.03
HALT_NS: Final = 2_000_000_000
"""A machine that does not come to rest in this time is braked."""


class PathDrive:
    """One drive along ``path``; ``stop_m`` is where along it to stop, None for its end.

    ``steer`` is the follower's last output.
    """

    def __init__(
        self, carrier: Carrier, path: Path, stop_m: float | None = None, speed_m_s: float | None = None
    ) -> None:
        self.path = path
        self.steer: SteeringCommand | None = None
        self._carrier = carrier
        self._speed = carrier.cruise_speed_m_s if speed_m_s is None else speed_m_s
        self._following = FollowerState()
        self._rocking = Rocking()
        self._on = False
        self._correction = 0.0
        self._stamp_ns = self._halting_ns = 0
        self.stop_at(path.length_m if stop_m is None else stop_m)

    def stop_at(self, s_m: float) -> None:
        """Stop at this distance along the path instead; if it is passed already, stop as soon as possible."""
        self._stop_m = min(max(s_m, 0.0), self.path.length_m)

    @property
    def left_m(self) -> float:
        """Distance left to the stop."""
        return self._stop_m - (self.steer.s_m if self.steer else 0.0)

    def step(self, location: Location) -> DriveRequest:
        """Compute the drive request for one location."""
        if stop_reason := self._stop_reason(location):
            self._following = replace(self._following, articulation_rad=None, stamp_ns=0)
            self._correction = 0.0
            return DriveRequest(stop_reason=stop_reason)
        target_speed_m_s = self._wanted(location)
        self._following, steer = follow_path(self._carrier, self.path, self._following, location, target_speed_m_s)
        self.steer = steer
        self._on = self._on or (abs(steer.off_m) < ON_PATH_M and abs(steer.off_rad) < ON_PATH_RAD)
        if self._on and abs(steer.off_m) > MAX_OFF_PATH_M:
            return DriveRequest(
                stop_reason=f"the machine is {abs(steer.off_m):.1f} m beside its path; plan the drive again"
            )
        if self.left_m <= STOP_M:
            return self._halt(location)
        self._halting_ns = 0
        speed = self._corrected(min(target_speed_m_s, stopping_speed_m_s(self.left_m - STOP_M)), location)
        return DriveRequest(
            Steering.ARTICULATION, 0.0, 0.0, steer.articulation_rad, steer.articulation_rate_rad_s, speed, False
        )

    def reset(self, location: Location) -> None:
        """Reset the speed correction while the machine stands; it is not valid for the next start."""
        self._following = replace(self._following, articulation_rad=None, stamp_ns=0)
        self._correction = 0.0
        self._stamp_ns = location.stamp_ns

    def _halt(self, location: Location) -> DriveRequest:
        """Come to rest: on a slope the drive must hold the machine until the brake is on."""
        self._halting_ns = self._halting_ns or location.stamp_ns
        at_rest = abs(location.speed_m_s) < HALTED_M_S or location.stamp_ns - self._halting_ns > HALT_NS
        speed = 0.0 if at_rest else self._corrected(0.0, location)
        return DriveRequest(Steering.ARTICULATION, 0.0, 0.0, location.articulation_rad, 0.0, speed, at_rest)

    def _stop_reason(self, location: Location) -> str:
        if not location.usable:
            return f"not located: {location.reason}"
        if location.sigma_m > MAX_SIGMA_M:
            return f"the position is only accurate to {location.sigma_m:.2f} m"
        margin = self._margin(location)
        if terrain_speed_share(margin, self._rocking.step(location)) == 0.0:
            return f"the machine is too close to tipping over: {margin:.2f} m margin left"
        return ""

    def _margin(self, location: Location) -> float:
        articulation = location.articulation_rad
        lf, lr = self._carrier.front_axle_m, self._carrier.rear_axle_m
        return tip_margin_m(
            self._carrier, location, location.speed_m_s**2 * math.sin(articulation) / (lf * math.cos(articulation) + lr)
        )

    def _wanted(self, location: Location) -> float:
        """Compute the speed allowed by bends and ground."""
        share = terrain_speed_share(self._margin(location), self._rocking.rate_rad_s)
        if location.status is Status.DEAD_RECKONING:
            share *= RECKONING_SHARE
        s = self._following.s_m
        articulation = math.inf if s is None else bend_speed_m_s(self._carrier, self.path, s)
        target_speed_m_s = min(share * self._speed, articulation)
        return (
            target_speed_m_s if self.steer is None else min(target_speed_m_s, stopping_speed_m_s(self.left_m - STOP_M))
        )

    def _corrected(self, wanted_m_s: float, location: Location) -> float:
        """Compute the speed to request: compensate for wheel slip and drive droop."""
        seconds = min(0.2, (location.stamp_ns - self._stamp_ns) * 1e-9) if self._stamp_ns else 0.0
        self._stamp_ns = location.stamp_ns
        error = wanted_m_s - location.speed_m_s
        if abs(error) < SPEED_NEAR_M_S:
            change = SPEED_GAIN_1_S * seconds * error
            self._correction = min(max(self._correction + change, -SPEED_SPARE_M_S), SPEED_SPARE_M_S)
        return min(wanted_m_s + self._correction, self._carrier.speed_limit_m_s)


# -- Path following by articulation: feed-forward of the path's curvature, feedback of lateral and course error.
#
# The centre of the front axle follows the path.  Without slip, its curvature is kappa = (sin g + lr g_s) / (lf cos
# g + lr), where g_s is the articulation's change per metre.  A wanted curvature therefore needs
#
#     g_s = (kappa (lf cos g + lr) - sin g) / lr,
#
# which is stable forwards without look-ahead.  With the lateral error e (+ left of the path) and the course error
# c,
#
#     c_wanted = -atan(LAMBDA e),   kappa = path's + d c_wanted / ds - GAMMA (c - c_wanted) - slip's curvature,
#
# so that far from the path the machine returns at a bounded angle, and near it the error decays as exp(-LAMBDA s)
# over the distance s.  Course and slip come from the localization filter: on a side slope the front points uphill
# while the machine drives straight.  The remaining error is integrated, slowly and only near the path, and added to
# e.  All errors are predicted to the time at which the valve acts.

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
    """Take one step at the location's stamp; ``speed_m_s`` is the speed about to be requested."""
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
    target_course_rad = max(-MAX_RETURN_RAD, min(MAX_RETURN_RAD, -math.atan(pull)))
    course_change = -LAMBDA_1_M / (1.0 + pull**2) * math.sin(off_course)
    own = curve * math.cos(off_course) / max(0.3, 1.0 - curve * off)
    kappa = own + course_change - GAMMA_1_M * wrapped(off_course - target_course_rad) - location.slip_curve_1_m
    angle, rate = _articulation(carrier, state, location, kappa, speed_m_s)
    return FollowerState(s, angle, rate, location.stamp_ns, integral), SteeringCommand(angle, rate, s, off, off_course)


def _articulation(
    carrier: Carrier, state: FollowerState, location: Location, kappa: float, speed_m_s: float
) -> tuple[float, float]:
    """Compute the wanted articulation at the location's stamp and its rate, within the machine's limits."""
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
