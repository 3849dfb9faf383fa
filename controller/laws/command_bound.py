"""Command bound: how fast a joint may be commanded, so that it does not exceed its speed limit.

A bounded reference does not bound the joint: a planner can let it fall behind, by announcing again and again a rest
that never comes, and then have it catch up while the reference itself runs at the limit.  So a place follows the joint
by its speed limit at most, and the further the joint is ahead of that place, the less may be commanded.  The joint is
taken where it will be when the commands of its reaction time have reached it.  So its way in any time is that of its
limit, and a little more while a valve that gives more than its map has not shown it; slower work is not touched.
"""

from __future__ import annotations

import math
from typing import Final

from controller.laws.delay_compensation import DelayCompensation

MOST_SHARE: Final = 1.1
"""Share of the speed limit that is commanded at most: to a joint that stood, or whose valve gives too little."""
LEAST_SHARE: Final = 0.7
"""Share that may always be commanded: a joint that a load pushes ahead is not brought to a stop by this."""
RETURN_S: Final = 0.03
"""Time constant with which a joint ahead of its place is brought back to it."""


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
        most = MOST_SHARE * self._speed
        ahead = self._ahead if desired >= 0.0 else -self._ahead
        return min(max(most - ahead / RETURN_S, LEAST_SHARE * self._speed), most)

    def add(self, command: float, position: float, elapsed_s: float) -> None:
        """One tick with the commanded velocity [rad/s, m/s] and the measured position [rad, m]."""
        self._flight.add(command * elapsed_s)
        predicted = position + self._flight.travel
        if self._place != self._place:
            self._place = predicted
        most = self._speed * elapsed_s
        self._place += min(max(predicted - self._place, -most), most)
        self._ahead = predicted - self._place
