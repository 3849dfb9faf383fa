"""Command bound: how fast a joint may be commanded, so that it does not exceed its speed limit.

A bounded reference does not bound the joint: a planner can let it fall behind, by announcing again and again a rest
that never comes, and then have it catch up while the reference itself runs at the limit.  So a place follows the joint
by its speed limit at most, and a command that takes the joint further ahead of that place than a slack is cut.  The
joint is taken where it will be when the commands of its reaction time have reached it.  Over any time its way is that
of its limit and the slack, whatever its valve gives; a joint behind its reference may still hurry for a moment.
"""

from __future__ import annotations

import math
from typing import Final

from controller.laws.delay_compensation import DelayCompensation

MOST_SHARE: Final = 1.15
"""Share of the speed limit that is commanded at most: to a joint that stood, or whose valve gives too little."""
LEAST_SHARE: Final = 0.7
"""Share that may always be commanded: a joint that a load pushes ahead is not brought to a stop by this."""
SLACK_S: Final = 0.01
"""How far ahead of its place the joint may come, as time at the speed limit."""
APPROACH_S: Final = 0.05
"""Time constant with which the slack is used up."""


class CommandBound:
    """Of one joint."""

    __slots__ = ("_ahead", "_flight", "_place", "_speed")

    def __init__(self, speed_limit: float, reaction_s: float, period_s: float) -> None:
        self._speed = speed_limit
        self._flight = DelayCompensation(reaction_s, period_s)
        self.reset()

    def reset(self) -> None:
        """The valve is at neutral: the joint may stand anywhere, and nothing is in flight."""
        self._flight.reset()
        self._place = math.nan
        self._ahead = 0.0

    def limit(self, desired: float) -> float:
        """The greatest speed to command in the direction of ``desired`` [rad/s, m/s]."""
        speed = self._speed
        ahead = self._ahead if desired >= 0.0 else -self._ahead
        allowed = speed + (SLACK_S * speed - ahead) / APPROACH_S
        return min(max(allowed, LEAST_SHARE * speed), MOST_SHARE * speed)

    def add(self, command: float, position: float, elapsed_s: float) -> None:
        """One tick with the commanded velocity [rad/s, m/s] and the measured position [rad, m]."""
        self._flight.add(command * elapsed_s)
        predicted = position + self._flight.travel
        if self._place != self._place:
            self._place = predicted
        most = self._speed * elapsed_s
        self._place += min(max(predicted - self._place, -most), most)
        self._ahead = predicted - self._place
