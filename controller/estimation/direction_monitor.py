"""Direction monitor: does a joint in a spool test move to the side to which its spool is open?

A spool test measures a valve of which nothing is known: where oil begins to flow, how much, and when.  So a speed that
is expected of the command proves nothing, and neither does a joint that stands.  Only the side is certain.  Any valve
has answered `ANSWER_S` after its command; if the command has been to one side for so long and the joint still goes to
the other, by more than ringing oil swings it, then valve or encoder is connected the wrong way round.  How far and how
fast a tested joint may go at all is limited by `controller.crane.spool_test_run`.
"""

from __future__ import annotations

import math
from typing import Final

from controller.estimation.joint_estimator import TrackedJoint
from controller.estimation.recent_range import RecentRange

ANSWER_S: Final = 0.45
"""The longest dead time (0.25 s) and the spool's own 0.07 s are within three quarters of it."""
MEMORY_S: Final = 0.5
AGAINST_S_AT_LIMIT: Final = 0.1
LEAST_AGAINST: Final = 0.02
"""A joint goes against its test by the way of the first at the speed limit, and at least by this [rad, m]: a procedure
that watches its own test ends it at less than half of it and knows more about the cause."""


class DirectionMonitor:
    """Monitors one joint; `step` tells whether it moves against its test."""

    __slots__ = ("_against", "_commands", "_decay", "_limit", "_period_s")

    def __init__(self, spec: TrackedJoint, period_s: float) -> None:
        self._period_s, self._decay = period_s, math.exp(-period_s / MEMORY_S)
        self._limit = max(AGAINST_S_AT_LIMIT * spec.speed_limit, LEAST_AGAINST)
        self._commands = RecentRange(ANSWER_S, period_s)
        self._against = 0.0

    def reset(self) -> None:
        """No test has been lately."""
        self._against = 0.0
        self._commands.reset(0.0)

    def step(self, command: float, velocity: float) -> bool:
        """One period with the spool's command (+ moves the joint in its positive direction) and the joint's velocity
        [rad/s, m/s].
        """
        commands = self._commands
        commands.add(command)
        opposed = (commands.low > 0.0 and velocity < 0.0) or (commands.high < 0.0 and velocity > 0.0)
        self._against = self._decay * self._against + (self._period_s * abs(velocity) if opposed else 0.0)
        return self._against > self._limit
