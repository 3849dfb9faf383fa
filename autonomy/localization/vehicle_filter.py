"""Extended Kalman filter of the vehicle: one state for odometry and antennas, delayed measurements, gates.

A receiver's solution is delayed, so it is compared with the state at its time of validity: the motion since then comes
from the odometry, which is accurate to a millimetre over 0.1 s.  A measurement outside its gate is not used.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from autonomy.localization.local_plane import wrapped
from machine.geometry.carrier import Point
from machine.profile import Carrier

# -- The filter's model: state transition of an articulated machine, and the measurements of its antennas.
#
# State (``State``): centre of the front axle [m] and yaw of the front half [rad] in the plane; curvature [1/m] and
# direction [rad] added by slip; scale error of the wheel speed; error of the receiver's heading [rad]; slowly
# varying position error of the receiver [m]; offset of the main antenna, ahead and to the left [m]; downhill drift
# of the direction per radian of lean.  Without slip (docs/reference/machines.md section 7.1)
#
#     x' = v cos psi,  y' = v sin psi,  psi' = (v sin g + lr g') / (lf cos g + lr)
#
# with the speed v of the front axle and the articulation g.  Slip noise grows with the distance driven, so a
# standing machine does not become uncertain.

Array = np.ndarray


class State(IntEnum):
    """Indices of the state vector."""

    X = 0
    Y = 1
    YAW = 2
    CURVE = 3
    SIDE = 4
    SCALE = 5
    HEADING = 6
    WANDER_X = 7
    WANDER_Y = 8
    ANTENNA_X = 9
    ANTENNA_Y = 10
    SLIDE = 11


SIZE: Final = len(State)


@dataclass(frozen=True, slots=True)
class GaussMarkov:
    """A first-order Gauss-Markov process: standard deviation, and correlation length [m] or time [s]."""

    sigma: float
    over: float

    def step(self, by: float) -> tuple[float, float]:
        """Compute the decay factor and added variance after ``by`` m or s."""
        keep = math.exp(-by / self.over)
        return keep, self.sigma**2 * (1.0 - keep * keep)


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of the filter; all of it assumed.  ``fixes`` by method of PGN 129029: white and slowly varying horizontal
    error of a position, root mean square [m].
    """

    curve: GaussMarkov = GaussMarkov(0.02, 4.0)
    side: GaussMarkov = GaussMarkov(0.02, 6.0)
    slide: GaussMarkov = GaussMarkov(0.25, 200.0)
    scale: GaussMarkov = GaussMarkov(0.12, 30.0)
    distance_m: float = 0.01
    """Position noise per square root of a metre driven."""
    distance_yaw_rad: float = 0.003
    """Yaw noise per square root of a metre driven."""
    standstill_m: float = 0.002
    """Position noise per square root of a second: the machine rocks while its crane works."""
    heading_start_rad: float = 0.015
    heading_rad: float = 2e-5
    """Noise of the heading error per square root of a second."""
    antenna_m: float = 0.02
    attitude_rad: float = 0.004
    articulation_rad: float = 0.004
    """Of the articulation encoder, including its zero."""
    phase_m: float = 0.003
    """Per antenna, for a dual-antenna heading."""
    turn_rad_s: float = 0.006
    wander_s: float = 60.0
    fixes: dict[int, tuple[float, float]] = field(
        default_factory=lambda: {1: (0.5, 2.5), 2: (0.2, 0.8), 4: (0.012, 0.010), 5: (0.07, 0.35)}
    )


@dataclass(frozen=True, slots=True)
class Odometry:
    """Motion since the last step: time [s], horizontal distance of the wheels [m], articulation before and now [rad],
    roll of the front half, + right side down [rad].
    """

    seconds: float
    distance_m: float
    articulation_before_rad: float
    articulation_rad: float
    roll_rad: float = 0.0


def turned_without_slip(carrier: Carrier, odometry: Odometry, distance_m: float) -> float:
    """Compute the turn of the front half over a distance ``distance_m`` of its axle, without slip [rad]."""
    articulation = 0.5 * (odometry.articulation_before_rad + odometry.articulation_rad)
    swing = odometry.articulation_rad - odometry.articulation_before_rad
    lf, lr = carrier.front_axle_m, carrier.rear_axle_m
    return (distance_m * math.sin(articulation) + lr * swing) / (lf * math.cos(articulation) + lr)


def predicted_state(carrier: Carrier, noise: NoiseModel, x: Array, odometry: Odometry) -> tuple[Array, Array, Array]:
    """Predict state (12,), Jacobian (12, 12) and process noise (12, 12) one step later."""
    s, d = State, odometry
    distance = d.distance_m * (1.0 + x[s.SCALE])
    turned = turned_without_slip(carrier, d, distance) + x[s.CURVE] * distance
    course = x[s.YAW] + 0.5 * turned + drift_rad(x, d.roll_rad)
    c, si = math.cos(course), math.sin(course)
    out = x.copy()
    out[s.X] += distance * c
    out[s.Y] += distance * si
    out[s.YAW] += turned
    jacobian = np.eye(SIZE)
    articulation = 0.5 * (d.articulation_before_rad + d.articulation_rad)
    from_distance = (
        math.sin(articulation) / (carrier.front_axle_m * math.cos(articulation) + carrier.rear_axle_m) + x[s.CURVE]
    )
    for index, of_turn, of_length in ((s.CURVE, distance, 0.0), (s.SCALE, from_distance * d.distance_m, d.distance_m)):
        jacobian[s.YAW, index] = of_turn
        jacobian[s.X, index] = c * of_length - 0.5 * distance * si * of_turn
        jacobian[s.Y, index] = si * of_length + 0.5 * distance * c * of_turn
    for index, of_course in ((s.YAW, 1.0), (s.SIDE, 1.0), (s.SLIDE, -d.roll_rad)):
        jacobian[s.X, index], jacobian[s.Y, index] = -of_course * distance * si, of_course * distance * c
    driven = abs(d.distance_m)
    added = np.zeros(SIZE)
    added[[s.X, s.Y]] = noise.distance_m**2 * driven + noise.standstill_m**2 * d.seconds
    added[s.YAW] = noise.distance_yaw_rad**2 * driven
    added[s.HEADING] = noise.heading_rad**2 * d.seconds
    for index, drift in ((s.CURVE, noise.curve), (s.SIDE, noise.side), (s.SCALE, noise.scale), (s.SLIDE, noise.slide)):
        keep, added[index] = drift.step(driven)
        out[index] *= keep
        jacobian[index, index] = keep
    return out, jacobian, np.diag(added)


def drift_rad(x: Array, roll_rad: float) -> float:
    """Compute the direction of the front axle's motion relative to the front half, + left [rad]."""
    return float(x[State.SIDE] - x[State.SLIDE] * roll_rad)


def tilt(roll_rad: float, pitch_rad: float) -> Array:
    """Return the rotation (3, 3) of a half without its yaw: roll + right side down, pitch + nose up."""
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    rotation: Array = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]]) @ roll
    return rotation


def axle_m(carrier: Carrier, height_m: float) -> Point:
    """Return the centre of the front axle, between the hubs, in the front frame."""
    return carrier.front_axle_m, 0.0, -(carrier.arm_drop_low_m + height_m)


def antenna_reach(carrier: Carrier, roll_rad: float, pitch_rad: float, height_m: float) -> Array:
    """Return the vector from the centre of the front axle to the main antenna (3,): along the front's yaw, to its left,
    and up [m].
    """
    lever = np.subtract(carrier.antenna_main_m, axle_m(carrier, height_m))
    return tilt(roll_rad, pitch_rad) @ lever


def predicted_antenna(x: Array, reach: Array) -> tuple[Array, Array]:
    """Predict the position of the main antenna (2,) and its Jacobian (2, 12)."""
    s = State
    c, si = math.cos(x[s.YAW]), math.sin(x[s.YAW])
    ahead, left = reach[0] + x[s.ANTENNA_X], reach[1] + x[s.ANTENNA_Y]
    shown = np.array(
        [
            x[s.X] + c * ahead - si * left + x[s.WANDER_X],
            x[s.Y] + si * ahead + c * left + x[s.WANDER_Y],
        ]
    )
    jacobian = np.zeros((2, SIZE))
    jacobian[:, [s.X, s.Y]] = jacobian[:, [s.WANDER_X, s.WANDER_Y]] = np.eye(2)
    jacobian[:, s.YAW] = -si * ahead - c * left, c * ahead - si * left
    jacobian[:, [s.ANTENNA_X, s.ANTENNA_Y]] = [[c, -si], [si, c]]
    return shown, jacobian


def front_attitude(roll_rad: float, pitch_rad: float, articulation_rad: float) -> tuple[float, float]:
    """Compute roll and pitch of the front half from those of the rear, for a rigid articulation axis."""
    down = tilt(roll_rad, pitch_rad)[2]
    c, s = math.cos(articulation_rad), math.sin(articulation_rad)
    ahead, left, up = c * down[0] + s * down[1], -s * down[0] + c * down[1], down[2]
    return math.atan2(left, up), math.asin(max(-1.0, min(1.0, ahead)))


CHI_SQUARE_GATES: Final = (0.0, 10.828, 13.816)
"""Chi-square quantiles of 99.9 % for one and two degrees of freedom, by the number of components."""
CONSIDERED_STATES: Final = [State.ANTENNA_X, State.ANTENNA_Y]
"""Considered but not estimated (Schmidt filter): only slip in bends would be attributed to them, which is wrong."""
HISTORY_STEPS: Final = 24
"""Stored steps, 1.2 s at 20 Hz."""


class VehicleFilter(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """Located once ``initialize`` was called.  ``x`` (12,), ``P`` (12, 12) are ordered as ``State``."""

    def __init__(self, carrier: Carrier, noise: NoiseModel) -> None:
        super().__init__(SIZE, 2)
        self._carrier, self._noise = carrier, noise
        self._stamps: deque[int] = deque(maxlen=HISTORY_STEPS)
        self._motions: deque[Array] = deque(maxlen=HISTORY_STEPS)
        self._motion = np.zeros(3)
        self._fix = 0

    def initialize(self, x_m: float, y_m: float, yaw_rad: float, fix: int, sigma_m: float, stamp_ns: int) -> None:
        """Initialize: the front axle is at this position, with a standard deviation ``sigma_m`` in each axis."""
        n, s = self._noise, State
        self.x = np.zeros(SIZE)
        self.x[[s.X, s.Y, s.YAW]] = x_m, y_m, yaw_rad
        sigma = np.zeros(SIZE)
        sigma[[s.X, s.Y]] = sigma_m
        sigma[s.YAW] = 2.0 * n.heading_start_rad
        sigma[[s.CURVE, s.SIDE, s.SCALE]] = n.curve.sigma, n.side.sigma, n.scale.sigma
        sigma[s.HEADING], sigma[s.SLIDE] = n.heading_start_rad, n.slide.sigma
        sigma[[s.ANTENNA_X, s.ANTENNA_Y]] = n.antenna_m
        self.P = np.diag(sigma**2)
        self._fix = 0
        self._set_fix(fix)
        self._stamps.clear()
        self._motions.clear()
        self._store(stamp_ns)

    def reset_position(self, x_m: float, y_m: float, sigma_m: float) -> None:
        """Re-initialize the position; the rest of the state stays."""
        places = [State.X, State.Y]
        self.x[places] = x_m, y_m
        self.P[places, :] = self.P[:, places] = 0.0
        self.P[places, places] = sigma_m**2

    def reset_yaw(self, turn_rad: float, reach_m: float) -> None:
        """Re-initialize the yaw by a correction; the antenna is ``reach_m`` from the axle.  The rest stays."""
        places = [State.X, State.Y]
        self.x[State.YAW] = wrapped(self.x[State.YAW] + turn_rad)
        self.P[State.YAW, :] = self.P[:, State.YAW] = 0.0
        self.P[State.YAW, State.YAW] = self._noise.heading_start_rad**2
        self.P[places, places] += (reach_m * turn_rad) ** 2

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of one dual-antenna heading."""
        base = math.dist(self._carrier.antenna_main_m[:2], self._carrier.antenna_aux_m[:2])
        return math.sqrt(2.0) * self._noise.phase_m / base

    def heading_off(self, yaw_rad: float, stamp_ns: int) -> float:
        """Compute the innovation of a dual-antenna yaw at a time [rad]."""
        then = self._state_before(self._motion_since(stamp_ns))
        return wrapped(yaw_rad - then[State.YAW] - then[State.HEADING])

    def predict_motion(self, odometry: Odometry, stamp_ns: int) -> None:
        """Predict to ``stamp_ns`` with the odometry since the last step."""
        before = self.x
        after, self.F, self.Q = predicted_state(self._carrier, self._noise, before, odometry)
        keep = math.exp(-odometry.seconds / self._noise.wander_s)
        sigma = self._noise.fixes.get(self._fix, (math.inf, 0.0))[1] * math.sqrt(0.5)
        for index in (State.WANDER_X, State.WANDER_Y):
            self.F[index, index] = keep
            after[index] *= keep
            self.Q[index, index] = sigma**2 * (1.0 - keep * keep)
        self._next = after
        self.predict()
        self._motion = self._motion + (after - before)[[State.X, State.Y, State.YAW]]
        self._store(stamp_ns)

    def add_creep(self, sigma_m: float, sigma_rad: float) -> None:
        """Add uncertainty of position and yaw for motion that the wheels do not measure."""
        self.P[[State.X, State.Y], [State.X, State.Y]] += sigma_m**2
        self.P[State.YAW, State.YAW] += sigma_rad**2

    def predict_x(self, u: float = 0) -> None:
        """Use the state from ``predict_motion``: the model is not linear."""
        self.x = self._next

    def position(self, east_m: float, north_m: float, reach: Array, fix: int, stated_m: float, stamp_ns: int) -> bool:
        """Update with a position of the main antenna that was valid at ``stamp_ns``; False outside the gate.

        ``reach`` is ``motion_model.antenna_reach``; ``stated_m`` is the receiver's own standard deviation, NaN without.
        """
        self._set_fix(fix)
        since = self._motion_since(stamp_ns)
        sigma = self._noise.fixes[fix][0] * math.sqrt(0.5)
        if math.isfinite(stated_m):
            sigma = max(sigma, stated_m * math.sqrt(0.5))
        spread = sigma**2 + (self._noise.attitude_rad * reach[2]) ** 2
        shown, h = predicted_antenna(self._state_before(since), reach)
        return self._update_gated(np.array([east_m, north_m]) - shown, h, np.eye(2) * spread)

    def heading(self, yaw_rad: float, stamp_ns: int) -> bool:
        """Update with a dual-antenna yaw of the front half; False outside the gate."""
        h = np.zeros((1, SIZE))
        h[0, [State.YAW, State.HEADING]] = 1.0
        off = self.heading_off(yaw_rad, stamp_ns)
        return self._update_gated(np.array([off]), h, np.array([[self.heading_sigma_rad**2]]))

    def turn(self, rate_rad_s: float, speed_m_s: float, over_ns: int, stamp_ns: int) -> bool:
        """Update with a yaw rate, averaged over the ``over_ns`` before ``stamp_ns``; False outside the gate."""
        h = np.zeros((1, SIZE))
        h[0, State.CURVE] = speed_m_s * (1.0 + self.x[State.SCALE])
        turned = self._motion_since(stamp_ns - over_ns)[2] - self._motion_since(stamp_ns)[2]
        off = rate_rad_s - turned / (over_ns * 1e-9)
        return self._update_gated(np.array([off]), h, np.array([[self._noise.turn_rad_s**2]]))

    def predicted_position(self, reach: Array, stamp_ns: int) -> Array:
        """Predict the position of the antenna at ``stamp_ns`` (2,)."""
        return predicted_antenna(self._state_before(self._motion_since(stamp_ns)), reach)[0]

    def _update_gated(self, off: Array, h: Array, r: Array) -> bool:
        s = h @ self.P @ h.T + r
        if float(off @ np.linalg.solve(s, off)) > CHI_SQUARE_GATES[len(off)]:
            return False
        gain = np.linalg.solve(s, h @ self.P).T
        gain[CONSIDERED_STATES] = 0.0
        self.x = self.x + gain @ off
        rest = np.eye(SIZE) - gain @ h
        spread = rest @ self.P @ rest.T + gain @ r @ gain.T
        self.P = 0.5 * (spread + spread.T)
        return True

    def _set_fix(self, fix: int) -> None:
        """Reset the slowly varying error: another kind of fix has another one."""
        if fix == self._fix:
            return
        self._fix = fix
        indices = [State.WANDER_X, State.WANDER_Y]
        self.x[indices] = 0.0
        self.P[indices, :] = self.P[:, indices] = 0.0
        self.P[indices, indices] = 0.5 * self._noise.fixes[fix][1] ** 2

    def _store(self, stamp_ns: int) -> None:
        self._stamps.append(stamp_ns)
        self._motions.append(self._motion)

    def _state_before(self, since: Array) -> Array:
        """Return the state before the motion ``since``."""
        x = self.x.copy()
        x[[State.X, State.Y, State.YAW]] -= since
        return x

    def _motion_since(self, stamp_ns: int) -> Array:
        """Return the odometry displacement and turn (3,) since ``stamp_ns``, limited to the stored steps."""
        stamps = self._stamps
        i = bisect_left(stamps, stamp_ns)
        if i == 0 or i == len(stamps):
            since: Array = self._motion - self._motions[min(i, len(stamps) - 1)]
            return since
        share = (stamp_ns - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
        since = self._motion - (self._motions[i - 1] + share * (self._motions[i] - self._motions[i - 1]))
        return since
