"""PD law with velocity feed-forward of paper A's PLC, as machines.md section 4 writes it::

    v_cmd = qdot_ref(t + delay) + Kp (q_ref - q) + Kd (qdot_ref - qdot)

Inputs in rad and m per joint, output a joint velocity.  The feed-forward leads by the valve delay because the
trajectory is known ahead.  The law clips: to the speed cap, to what the valve can give, to a change per
second, and near the ends of the joint's range to a speed that still can stop.  Inside the stop band it rests,
with hysteresis.
"""

from __future__ import annotations

from typing import Final

from controller.valve import ValveMap
from machine.profile import JointSpec

HEADROOM: Final = 1.25
"""Share of the speed limit that a correction may use, so that a joint behind its reference can catch up."""
ACCELERATION_FACTOR: Final = 4.0
"""The command may change this many times faster than the planner's acceleration limit."""
_END_GAIN_1_S: Final = 4.0


class PdLaw:
    """The law of one joint; remembers its last output (rate limit) and whether it rests."""

    __slots__ = (
        "_band", "_kd", "_kp", "_lower", "_max_rate", "_resting", "_speed", "_upper", "_valve", "has_encoder",
        "velocity_command",
    )  # fmt: skip

    def __init__(self, spec: JointSpec, valve: ValveMap) -> None:
        law = spec.law
        self._kp, self._kd, self._band = law.kp_1_s, law.kd, law.stop_band
        self._lower, self._upper = spec.lower, spec.upper
        self._speed = HEADROOM * spec.speed_limit
        self._max_rate = ACCELERATION_FACTOR * spec.acceleration_limit
        self._valve = valve
        self.has_encoder = spec.encoder is not None
        self.reset()

    def reset(self) -> None:
        """Forgets the last command: the valve is at neutral."""
        self.velocity_command = 0.0
        self._resting = True

    def step(
        self, q_ref: float, v_ref: float, v_lead: float, q: float, v: float, cap: float, elapsed_s: float
    ) -> float:
        """The joint velocity to command; ``cap`` scales the speed limit (1, or 0.5 when degraded)."""
        command = v_lead
        if self.has_encoder:
            error = q_ref - q
            still = v_ref == 0.0 and v_lead == 0.0
            self._resting = still and abs(error) < (self._band if self._resting else 0.5 * self._band)
            if self._resting:
                command = 0.0
            else:
                command += self._kp * error + self._kd * (v_ref - v)
            command = min(command, max(0.0, (self._upper - q) * _END_GAIN_1_S))
            command = max(command, min(0.0, (self._lower - q) * _END_GAIN_1_S))
        limit = self._speed * cap
        command = self._valve.limit(min(max(command, -limit), limit))
        change = self._max_rate * elapsed_s
        last = self.velocity_command
        command = min(max(command, last - change), last + change)
        self.velocity_command = command
        return command
