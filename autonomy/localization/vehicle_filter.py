"""Extended Kalman filter of the vehicle: one state for odometry and antennas, delayed measurements, gates.

A receiver's solution is delayed, so it is compared with the state at its time of validity: the motion since then comes
from the odometry, which is accurate to a millimetre over 0.1 s.  A measurement outside its gate is not used.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from typing import Final

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from autonomy.localization.local_plane import wrapped
from autonomy.localization.motion_model import (
    SIZE,
    Array,
    NoiseModel,
    Odometry,
    State,
    predicted_antenna,
    predicted_state,
)
from machine.profile import Carrier

CHI_SQUARE_GATES: Final = (0.0, 10.828, 13.816)
"""Chi-square quantiles of 99.9 % for one and two degrees of freedom, by the number of components."""
CONSIDERED_STATES: Final = [State.ANTENNA_X, State.ANTENNA_Y]
"""Considered but not estimated (Schmidt filter): only slip in bends would be attributed to them, which is wrong."""
HISTORY_STEPS: Final = 24
"""Stored steps, 1.2 s at 20 Hz."""


class VehicleFilter(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """Located once ``initialize`` was called.  ``x`` (12,), ``P`` (12, 12) are ordered as ``motion_model.State``."""

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
        """Innovation of a dual-antenna yaw at a time [rad]."""
        then = self._state_before(self._motion_since(stamp_ns))
        return wrapped(yaw_rad - then[State.YAW] - then[State.HEADING])

    def predict_motion(self, odometry: Odometry, stamp_ns: int) -> None:
        """Predict to ``stamp_ns`` with the odometry since the last step."""
        before = self.x
        after, self.F, self.Q = predicted_state(self._carrier, self._noise, before, odometry)
        keep = math.exp(-odometry.seconds / self._noise.wander_s)
        sigma = self._noise.fixes.get(self._fix, (math.inf, 0.0))[1] * math.sqrt(0.5)
        for place in (State.WANDER_X, State.WANDER_Y):
            self.F[place, place] = keep
            after[place] *= keep
            self.Q[place, place] = sigma**2 * (1.0 - keep * keep)
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
        """Predicted position of the antenna at ``stamp_ns`` (2,)."""
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
        """Another kind of fix has another slowly varying error: reset it."""
        if fix == self._fix:
            return
        self._fix = fix
        places = [State.WANDER_X, State.WANDER_Y]
        self.x[places] = 0.0
        self.P[places, :] = self.P[:, places] = 0.0
        self.P[places, places] = 0.5 * self._noise.fixes[fix][1] ** 2

    def _store(self, stamp_ns: int) -> None:
        self._stamps.append(stamp_ns)
        self._motions.append(self._motion)

    def _state_before(self, since: Array) -> Array:
        """The state before the motion ``since``."""
        x = self.x.copy()
        x[[State.X, State.Y, State.YAW]] -= since
        return x

    def _motion_since(self, stamp_ns: int) -> Array:
        """Odometry displacement and turn (3,) since ``stamp_ns``, limited to the stored steps."""
        stamps = self._stamps
        i = bisect_left(stamps, stamp_ns)
        if i == 0 or i == len(stamps):
            since: Array = self._motion - self._motions[min(i, len(stamps) - 1)]
            return since
        share = (stamp_ns - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
        since = self._motion - (self._motions[i - 1] + share * (self._motions[i] - self._motions[i - 1]))
        return since
