"""The extended Kalman filter: one state for odometry and antennas, late measurements, gates.

A receiver's solution is late, so it is compared with where the machine was then: the way since comes from the
odometry, which is good to a millimetre over a tenth of a second.  A measurement outside its gate changes nothing.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from typing import Final

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from autonomy.localization.motion_model import SIZE, Array, Noise, Odometry, State, advance, antenna
from autonomy.localization.local_plane import wrapped
from machine.profile import Carrier

GATES: Final = (0.0, 10.828, 13.816)
"""Chi square of 0.1 % for one and two degrees of freedom."""
CONSIDERED: Final = [State.ANTENNA_X, State.ANTENNA_Y]
"""Reckoned with and never learned: only what slip does in bends would teach it, and wrongly (Schmidt's filter)."""
KEPT: Final = 24
"""Steps back in time, 1.2 s at 20 Hz."""


class Filter(ExtendedKalmanFilter):
    """Located once ``begin`` was called.  ``x`` (12,), ``P`` (12, 12) as in ``motion.State``."""

    def __init__(self, carrier: Carrier, noise: Noise) -> None:
        super().__init__(SIZE, 2)
        self._carrier, self._noise = carrier, noise
        self._stamps: deque[int] = deque(maxlen=KEPT)
        self._ways: deque[Array] = deque(maxlen=KEPT)
        self._way = np.zeros(3)
        self._fix = 0

    def begin(self, x_m: float, y_m: float, yaw_rad: float, fix: int, sigma_m: float, stamp_ns: int) -> None:
        """Located anew: the front axle is about here, good to ``sigma_m`` in each axis."""
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
        self._quality(fix)
        self._stamps.clear()
        self._ways.clear()
        self._remember(stamp_ns)

    def begin_place(self, x_m: float, y_m: float, sigma_m: float) -> None:
        """The position anew, all else as it was."""
        places = [State.X, State.Y]
        self.x[places] = x_m, y_m
        self.P[places, :] = self.P[:, places] = 0.0
        self.P[places, places] = sigma_m**2

    def begin_yaw(self, turn_rad: float, reach_m: float) -> None:
        """The yaw anew, so much more than it was, all else as it was; the antenna is ``reach_m`` from the axle."""
        places = [State.X, State.Y]
        self.x[State.YAW] = wrapped(self.x[State.YAW] + turn_rad)
        self.P[State.YAW, :] = self.P[:, State.YAW] = 0.0
        self.P[State.YAW, State.YAW] = self._noise.heading_start_rad**2
        self.P[places, places] += (reach_m * turn_rad) ** 2

    @property
    def heading_sigma_rad(self) -> float:
        """Of one heading by both antennas."""
        base = math.dist(self._carrier.antenna_main_m[:2], self._carrier.antenna_aux_m[:2])
        return math.sqrt(2.0) * self._noise.phase_m / base

    def heading_off(self, yaw_rad: float, stamp_ns: int) -> float:
        """How much more a yaw by both antennas is than it ought to have been then [rad]."""
        then = self._then(self._since(stamp_ns))
        return wrapped(yaw_rad - then[State.YAW] - then[State.HEADING])

    def go(self, odometry: Odometry, stamp_ns: int) -> None:
        """On by what the machine did, to ``stamp_ns``."""
        before = self.x
        after, self.F, self.Q = advance(self._carrier, self._noise, before, odometry)
        keep = math.exp(-odometry.seconds / self._noise.wander_s)
        sigma = self._noise.fixes.get(self._fix, (math.inf, 0.0))[1] * math.sqrt(0.5)
        for place in (State.WANDER_X, State.WANDER_Y):
            self.F[place, place] = keep
            after[place] *= keep
            self.Q[place, place] = sigma**2 * (1.0 - keep * keep)
        self._next = after
        self.predict()
        self._way = self._way + (after - before)[[State.X, State.Y, State.YAW]]
        self._remember(stamp_ns)

    def creep(self, sigma_m: float) -> None:
        """The machine may have moved a little, in any direction, without its wheels' knowledge."""
        self.P[[State.X, State.Y], [State.X, State.Y]] += sigma_m**2

    def predict_x(self, u: float = 0) -> None:
        """The state that ``go`` found: the model is not linear."""
        self.x = self._next

    def position(self, east_m: float, north_m: float, reach: Array, fix: int, stated_m: float, stamp_ns: int) -> bool:
        """A position of the main antenna that held at ``stamp_ns``; False: outside the gate.

        ``reach`` as ``motion.antenna_reach``; ``stated_m`` is the receiver's own standard deviation, NaN if it says
        none.
        """
        self._quality(fix)
        since = self._since(stamp_ns)
        sigma = self._noise.fixes[fix][0] * math.sqrt(0.5)
        if math.isfinite(stated_m):
            sigma = max(sigma, stated_m * math.sqrt(0.5))
        spread = sigma**2 + (self._noise.attitude_rad * reach[2]) ** 2
        shown, h = antenna(self._then(since), reach)
        return self._take(np.array([east_m, north_m]) - shown, h, np.eye(2) * spread)

    def heading(self, yaw_rad: float, stamp_ns: int) -> bool:
        """A yaw of the front half by both antennas; False: outside the gate."""
        h = np.zeros((1, SIZE))
        h[0, [State.YAW, State.HEADING]] = 1.0
        off = self.heading_off(yaw_rad, stamp_ns)
        return self._take(np.array([off]), h, np.array([[self.heading_sigma_rad**2]]))

    def turn(self, rate_rad_s: float, speed_m_s: float, over_ns: int, stamp_ns: int) -> bool:
        """A yaw rate, mean of the ``over_ns`` before ``stamp_ns``; False: outside the gate."""
        h = np.zeros((1, SIZE))
        h[0, State.CURVE] = speed_m_s * (1.0 + self.x[State.SCALE])
        turned = self._since(stamp_ns - over_ns)[2] - self._since(stamp_ns)[2]
        off = rate_rad_s - turned / (over_ns * 1e-9)
        return self._take(np.array([off]), h, np.array([[self._noise.turn_rad_s**2]]))

    def shown(self, reach: Array, stamp_ns: int) -> Array:
        """Where the receiver ought to have shown the antenna at ``stamp_ns`` (2,)."""
        return antenna(self._then(self._since(stamp_ns)), reach)[0]

    def _take(self, off: Array, h: Array, r: Array) -> bool:
        s = h @ self.P @ h.T + r
        if float(off @ np.linalg.solve(s, off)) > GATES[len(off)]:
            return False
        gain = np.linalg.solve(s, h @ self.P).T
        gain[CONSIDERED] = 0.0
        self.x = self.x + gain @ off
        rest = np.eye(SIZE) - gain @ h
        spread = rest @ self.P @ rest.T + gain @ r @ gain.T
        self.P = 0.5 * (spread + spread.T)
        return True

    def _quality(self, fix: int) -> None:
        """The wandering error of another kind of fix is another one."""
        if fix == self._fix:
            return
        self._fix = fix
        places = [State.WANDER_X, State.WANDER_Y]
        self.x[places] = 0.0
        self.P[places, :] = self.P[:, places] = 0.0
        self.P[places, places] = 0.5 * self._noise.fixes[fix][1] ** 2

    def _remember(self, stamp_ns: int) -> None:
        self._stamps.append(stamp_ns)
        self._ways.append(self._way)

    def _then(self, since: Array) -> Array:
        """The state as it would have been before the way ``since``."""
        x = self.x.copy()
        x[[State.X, State.Y, State.YAW]] -= since
        return x

    def _since(self, stamp_ns: int) -> Array:
        """Way and turn (3,) since ``stamp_ns`` by the odometry; at most as far back as is remembered."""
        stamps = self._stamps
        i = bisect_left(stamps, stamp_ns)
        if i == 0 or i == len(stamps):
            return self._way - self._ways[min(i, len(stamps) - 1)]
        share = (stamp_ns - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
        return self._way - (self._ways[i - 1] + share * (self._ways[i] - self._ways[i - 1]))
