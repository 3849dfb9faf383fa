"""Does the machine do what it is told?  Command against motion, per joint (safety_faults.md, 1, 5, 16, 17).

The commanded velocity passes a model of the valve (the profile's dead time and a first-order lag) and is
compared with the measured velocity in leaky integrals (0.5 s), which are distances: how far the joint should
have moved, how far it stayed behind, how far it moved on its own, and how far against its command.  Blind for
a stuck joint below a fifth of the speed limit: a wrong dead-band looks the same there.
"""

from __future__ import annotations

import math
from array import array
from typing import Final

from machine.faults import Reason
from machine.profile import JointSpec

_MEMORY_S: Final = 0.5
_LAG_S: Final = 0.05
_ENOUGH_S: Final = 0.08
"""Judged once the joint should have moved as far as it does in this time at its speed limit."""
_STUCK_SHARE: Final = 0.7
_AGAINST_S: Final = 0.02
_OWN_MOTION_S: Final = 0.06
_OWN_MARGIN: Final = 0.25
"""Share of the speed limit by which a joint may be faster than its command: gain error, pendulum, lag."""
_COMMANDED: Final = 0.1
"""Share of the speed limit from which motion the other way is reversal and not motion on its own."""


class MotionMonitor:
    """Watches one joint; `step` gives `Reason.NONE` or what is wrong."""

    __slots__ = (
        "_against", "_at", "_behind", "_decay", "_enough", "_expected", "_lag", "_limit", "_line", "_model", "_own",
        "_period_s",
    )  # fmt: skip

    def __init__(self, spec: JointSpec, period_s: float) -> None:
        self._line = array("d", [0.0] * max(1, round(spec.valve.delay_s / period_s)))
        self._period_s = period_s
        self._lag = -math.expm1(-period_s / _LAG_S)
        self._decay = math.exp(-period_s / _MEMORY_S)
        self._limit = spec.speed_limit
        self._enough = _ENOUGH_S * spec.speed_limit
        self.reset()

    def reset(self) -> None:
        """At rest with a neutral valve."""
        self._at = 0
        self._model = self._expected = self._behind = self._own = self._against = 0.0
        for i in range(len(self._line)):
            self._line[i] = 0.0

    def step(self, command: float, velocity: float) -> Reason:
        """One period with the commanded and the measured velocity [rad/s or m/s]."""
        delayed, self._line[self._at] = self._line[self._at], command
        self._at = (self._at + 1) % len(self._line)
        self._model += self._lag * (delayed - self._model)
        model, dt = self._model, self._period_s
        self._expected = self._decay * self._expected + dt * abs(model)
        self._behind = self._decay * self._behind + dt * (model - velocity) * math.copysign(1.0, model)
        opposed = velocity * model < 0.0 and abs(model) > _COMMANDED * self._limit
        faster = 0.0 if opposed else abs(velocity) - abs(model)
        self._against = self._decay * self._against + (dt * abs(velocity) if opposed else 0.0)
        self._own = max(0.0, self._decay * self._own + dt * (faster - _OWN_MARGIN * self._limit))
        if self._against > _AGAINST_S * self._limit:
            return Reason.JOINT_REVERSED
        if self._expected > self._enough and self._behind > _STUCK_SHARE * self._expected:
            return Reason.JOINT_STUCK
        if self._own > _OWN_MOTION_S * self._limit:
            return Reason.JOINT_RUNAWAY
        return Reason.NONE
