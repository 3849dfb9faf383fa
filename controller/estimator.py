"""Joint positions and velocities from quantised encoder counts.

A critically damped alpha-beta tracker per joint (fading memory): it follows a ramp without lag and does not
turn one count of 0.38 mrad into 0.08 rad/s as a difference would.  Gains are computed at start from the
profile's filter time, so that no gain is per cycle.  A sample that no joint of this machine could have
reached is refused and counted; three refusals within 100 ms are a fault (safety_faults.md, case 2), after
which the tracker starts anew.
"""

from __future__ import annotations

import math
from typing import Final

from machine.profile import JointSpec

_JUMP_WINDOW_NS: Final = 100_000_000
_JUMPS: Final = 3
_NAN: Final = math.nan


class JointEstimator:
    """Tracks one joint; ``known`` is False until the first sample, and then position and velocity are NaN."""

    __slots__ = (
        "_alpha", "_beta", "_gate_speed", "_jump_stamps", "_measured", "_measured_ns", "_period_s",
        "_predicted_ns", "_slack", "jumped", "known", "position", "refused", "velocity",
    )  # fmt: skip

    def __init__(self, spec: JointSpec, period_s: float) -> None:
        encoder = spec.encoder
        theta = math.exp(-period_s / spec.law.velocity_filter_s)
        self._alpha, self._beta = 1.0 - theta * theta, (1.0 - theta) ** 2
        self._period_s = period_s
        valve = spec.valve
        self._gate_speed = 3.0 * max(valve.full_speed_plus, valve.full_speed_minus, spec.speed_limit)
        self._slack = 4.0 * encoder.unit_per_count + 6.0 * encoder.noise if encoder else 0.0
        self.refused = 0
        self.reset()

    def reset(self) -> None:
        """Forgets everything: the value is unknown again."""
        self.known = self.jumped = False
        self.position = self.velocity = self._measured = _NAN
        self._measured_ns = self._predicted_ns = 0
        self._jump_stamps = [-_JUMP_WINDOW_NS] * _JUMPS

    def predict(self, now_ns: int) -> None:
        """Moves the estimate on to ``now_ns``; once per tick, before `sample`."""
        if self.known:
            self.position += self.velocity * (now_ns - self._predicted_ns) * 1e-9
        self._predicted_ns = now_ns

    def sample(self, measured: float, now_ns: int) -> None:
        """Takes the position measured for this tick; sets ``jumped`` at the third refusal within 100 ms."""
        self.jumped = False
        if not self.known:
            self._start(measured, now_ns)
            return
        elapsed_s = (now_ns - self._measured_ns) * 1e-9
        if abs(measured - self._measured) > self._gate_speed * elapsed_s + self._slack:
            self.refused += 1
            stamps = self._jump_stamps
            stamps[self.refused % _JUMPS] = now_ns
            if now_ns - min(stamps) < _JUMP_WINDOW_NS:
                self.jumped = True
                self._start(measured, now_ns)
            return
        residual = measured - self.position
        self.position += self._alpha * residual
        self.velocity += self._beta / max(elapsed_s, self._period_s) * residual
        self._measured, self._measured_ns = measured, now_ns

    def _start(self, measured: float, now_ns: int) -> None:
        self.known = True
        self.position = self._measured = measured
        self.velocity = 0.0
        self._measured_ns = self._predicted_ns = now_ns
        for i in range(_JUMPS):
            self._jump_stamps[i] = now_ns - _JUMP_WINDOW_NS
