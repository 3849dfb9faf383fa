"""Motion monitor: does a joint follow its command?  (docs/reference/safety.md section 5, cases 1, 5, 16, 17)

The valve's dead time is not known well: it lies between an early and a late bound, whatever the profile says.  So the
commanded velocity passes two models of the valve, one at either bound, and a joint is wrong only against both.  They
are compared with the measured velocity in leaky integrals (0.5 s), which are distances: how far the joint should have
moved by now at the latest, how far it stayed behind that, how far it moved faster than any recent command, and how far
against its command.  The monitor cannot see a stuck joint below a fifth of the speed limit: a wrong dead-band looks the
same there.  Slow motion without a command is seen by `controller.estimation.standstill_monitor`.
"""

from __future__ import annotations

import math
from array import array
from typing import Final

from controller.estimation.joint_estimator import TrackedJoint
from machine.status.reasons import Reason

EARLY_DELAY_S: Final = 0.03
EARLY_LAG_S: Final = 0.03
LATE_DELAY_S: Final = 0.15
LATE_LAG_S: Final = 0.06
"""Bounds of the dead time, and the lags behind it: spool, and compressible oil."""
_MEMORY_S: Final = 0.5
_COMMAND_DECAY_S: Final = 0.2
"""A former command at the speed limit still counts for this time, a smaller one longer."""
_MIN_TRAVEL_S: Final = 0.08
"""A joint can be stuck once it should have moved as far as in this time at its speed limit."""
_STUCK_SHARE: Final = 0.7
AGAINST_S: Final = 0.02
"""A joint that went as far against its command as in this time at its speed limit is reversed."""
AGAINST_ELSEWHERE_S: Final = 0.05
"""The same where a PLC closes the loop: its law overshoots and lets the oil ring while ours, which acts on nothing,
asks for a steady speed (0.03 s in one of fifty log jobs on sampled machines)."""
_RUNAWAY_S: Final = 0.06
_YIELDING_S: Final = 0.4
"""The same of a joint that yields to what it carries: a log that caught at a stake wound a rotator up by 0.22 rad and
turned it back as far when it came free, at 1.4 rad/s; behind a PLC it then rang three times by 7 degrees.  Its spool
is watched besides."""
_OVERSPEED_SHARE: Final = 0.25
"""Share of the speed limit by which a joint may be faster than its command: pendulum, ringing, ..."""
_OVERSPEED_GAIN: Final = 0.3
"""... and share of the command: the valve's gain."""
_NONE: Final = Reason.NONE
_REVERSAL_SHARE: Final = 0.1
"""From this share of the speed limit on, motion against the command is reversal and not runaway."""


class MotionMonitor:
    """Monitors one joint; `step` returns the fault, or `Reason.NONE`."""

    __slots__ = (
        "_against",
        "_against_most",
        "_at",
        "_behind",
        "_command_decay",
        "_decay",
        "_early",
        "_early_at",
        "_early_lag",
        "_expected",
        "_late",
        "_late_lag",
        "_limit",
        "_line",
        "_min_travel",
        "_overspeed",
        "_period_s",
        "_recent_command",
        "_runaway_s",
        "_usual",
        "expected_velocity",
    )

    def __init__(
        self,
        spec: TrackedJoint,
        period_s: float,
        later_s: float = 0.0,
        lag_s: float = LATE_LAG_S,
        against_s: float = AGAINST_S,
        least_speed: float = 0.0,
    ) -> None:
        """``later_s``: delay that a bus and a node add to the late bound; ``lag_s``: the lag behind it; ``against_s``:
        one of the two above; ``least_speed``: see `controller.estimation.usual_speed`.
        """
        usual = max(spec.speed_limit, least_speed)
        self._against_most = against_s * usual
        self._line = array("d", [0.0] * (round((LATE_DELAY_S + later_s) / period_s) + 1))
        self._early_at = round(EARLY_DELAY_S / period_s)
        self._period_s = period_s
        self._early_lag, self._late_lag = (-math.expm1(-period_s / s) for s in (EARLY_LAG_S, lag_s))
        self._decay = math.exp(-period_s / _MEMORY_S)
        self._limit, self._usual = spec.speed_limit, usual
        self._command_decay = spec.speed_limit * period_s / _COMMAND_DECAY_S
        self._min_travel = _MIN_TRAVEL_S * usual
        self.reset()

    def reset(self) -> None:
        """At rest with a neutral valve."""
        self._at = 0
        self._early = self._late = self._recent_command = 0.0
        self.expected_velocity = 0.0
        """What the joint should do now at the latest."""
        self._expected = self._behind = self._overspeed = self._against = 0.0
        self._runaway_s = _RUNAWAY_S
        for i in range(len(self._line)):
            self._line[i] = 0.0

    def forgive(self) -> None:
        """What the joint has done so far is no evidence: its command was a spool's, and the map is being measured."""
        self._expected = self._behind = self._overspeed = self._against = 0.0

    def step(self, command: float, velocity: float, yields: bool = False) -> Reason:
        """One period with the commanded and the measured velocity [rad/s or m/s]; ``yields``: whether the joint is one
        that gives way to what it carries, and something presses on it now.
        """
        line, at = self._line, self._at
        line[at] = command
        self._early = early = self._early + self._early_lag * (line[at - self._early_at] - self._early)
        self._at = at = at + 1 if at + 1 < len(line) else 0
        self._late = self.expected_velocity = late = self._late + self._late_lag * (line[at] - self._late)
        dt, decay, usual = self._period_s, self._decay, self._usual
        wanted, moved = abs(late), abs(velocity)
        self._recent_command = recent = max(abs(early), wanted, self._recent_command - self._command_decay)
        self._expected = decay * self._expected + dt * wanted
        self._behind = decay * self._behind + dt * (late - velocity) * math.copysign(1.0, late)
        commanded = _REVERSAL_SHARE * self._limit
        opposed = (velocity < 0.0 and min(early, late) > commanded) or (
            velocity > 0.0 and max(early, late) < -commanded
        )
        self._against = decay * self._against + (dt * moved if opposed else 0.0)
        faster = 0.0 if opposed else moved - (1.0 + _OVERSPEED_GAIN) * recent - _OVERSPEED_SHARE * usual
        self._overspeed = max(0.0, decay * self._overspeed + dt * faster)
        if self._against > self._against_most:
            return Reason.JOINT_REVERSED
        if self._expected > self._min_travel and self._behind > _STUCK_SHARE * self._expected:
            return Reason.JOINT_STUCK
        self._runaway_s = _YIELDING_S if yields else _RUNAWAY_S
        if self._overspeed > self._runaway_s * usual:
            return Reason.JOINT_RUNAWAY
        return _NONE

    def shares(self) -> tuple[float, float, float]:
        """What was measured over what is a fault: joint reversed, stuck, running away.  1 and more is the fault."""
        expected = self._expected
        behind = self._behind / (_STUCK_SHARE * expected) if expected > 0.0 else 0.0
        return (
            self._against / self._against_most,
            max(0.0, min(expected / self._min_travel, behind)),
            self._overspeed / (self._runaway_s * self._usual),
        )
