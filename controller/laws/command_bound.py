"""Command bound: how fast a joint may be commanded, so that it does not exceed its speed limit.

A bounded reference does not bound the joint: a planner can let it fall behind, by announcing again and again a rest
that never comes, and then have it catch up while the reference itself runs at the limit.  So what a joint shows is
compared with what was commanded, in each direction and while the command is steady, and its command is bounded where
the joint reaches the limit.  A valve that has not yet shown how it answers is taken to give a little more than its map
says, as load and oil swing a joint that has just become fast.
"""

from __future__ import annotations

from array import array
from typing import Final

from controller.estimation.recent_range import RecentRange

UNKNOWN_SHARE: Final = 0.92
"""Share of the speed limit that may be commanded before the answer is known."""
LEAST_SHARE: Final = 0.8
MOST_SHARE: Final = 1.0
"""Bounds of it afterwards: a load pushes or holds a joint for a while, and what held it may let it go."""
MEMORY_S: Final = 1.0
KNOWN_S: Final = 0.3
"""Time at the speed limit after which the answer is known."""
SETTLING_S: Final = 0.2
"""A joint answers a command after its reaction and this time, ..."""
STEADY_SHARE: Final = 0.1
"""... and the command is steady while it varied by less than this share of the speed limit meanwhile."""
MEASURED_SHARE: Final = 0.5
"""Slower commands tell nothing: there the dead-band decides."""


class CommandBound:
    """Of one joint."""

    __slots__ = ("_asked", "_commands", "_known", "_limits", "_moved", "_speed")

    def __init__(self, speed_limit: float, reaction_s: float, period_s: float) -> None:
        self._speed, self._known = speed_limit, KNOWN_S * speed_limit
        self._commands = RecentRange(reaction_s + SETTLING_S, period_s)
        self._asked, self._moved = array("d", (0.0, 0.0)), array("d", (0.0, 0.0))
        """Distances that were commanded and covered in the negative and the positive direction."""
        self._limits = array("d", (UNKNOWN_SHARE * speed_limit, UNKNOWN_SHARE * speed_limit))

    def limit(self, desired: float) -> float:
        """The greatest speed to command in the direction of ``desired`` [rad/s, m/s]."""
        return self._limits[desired >= 0.0]

    def reset(self) -> None:
        """The valve is at neutral; what it has shown stays."""
        self._commands.reset(0.0)

    def add(self, command: float, velocity: float, elapsed_s: float) -> None:
        """One tick with the commanded and the measured velocity [rad/s, m/s]."""
        commands, speed = self._commands, self._speed
        commands.add(command)
        low, high = commands.low, commands.high
        side = low > 0.0
        asked, moved = (0.5 * (low + high), velocity) if side else (-0.5 * (low + high), -velocity)
        if asked < MEASURED_SHARE * speed or high - low > STEADY_SHARE * speed:
            return
        kept = max(0.0, 1.0 - elapsed_s / MEMORY_S)
        self._asked[side] = kept * self._asked[side] + elapsed_s * asked
        self._moved[side] = kept * self._moved[side] + elapsed_s * max(0.0, moved)
        if self._asked[side] > self._known:
            share = self._asked[side] / max(self._moved[side], self._asked[side] / MOST_SHARE)
            self._limits[side] = max(share, LEAST_SHARE) * speed
