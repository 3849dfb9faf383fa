"""How a joint answers its commands: what is in flight, how fast it may be commanded, and what its valve gives."""

from __future__ import annotations

import math
from array import array
from typing import Final

# -- Delay compensation: what was commanded within the last delay, which a joint or the articulation cannot show yet.


class DelayCompensation:
    """Travel in flight: the commands of the last delay, which the joint cannot show yet; fixed size."""

    __slots__ = ("_at", "_line", "travel")

    def __init__(self, delay_s: float, period_s: float) -> None:
        self._line = array("d", [0.0] * max(1, round(delay_s / period_s)))
        self.reset()

    def reset(self) -> None:
        """Reset with nothing in flight."""
        self._at = 0
        self.travel = 0.0
        for i in range(len(self._line)):
            self._line[i] = 0.0

    def add(self, travel: float) -> float:
        """Add one tick's commanded travel; the oldest leaves and is returned."""
        line, at = self._line, self._at
        oldest = line[at]
        self.travel += travel - oldest
        line[at] = travel
        self._at = at + 1 if at + 1 < len(line) else 0
        return oldest


# -- What arrives and what the joint makes of it.


class ArrivedSpeed:
    """Means over the same time of the commands as they reach a joint and of its speed [rad/s, m/s]."""

    __slots__ = ("_line", "_mean_s", "_position", "change", "commanded", "moved")

    def __init__(self, reaction_s: float, period_s: float, mean_s: float) -> None:
        self._line = DelayCompensation(reaction_s, period_s)
        self._mean_s = mean_s
        self.reset()

    def reset(self) -> None:
        """Begin with the valve at neutral: the joint may stand anywhere, and nothing is in flight."""
        self._line.reset()
        self._position = math.nan
        self.commanded = self.moved = 0.0
        self.change = 0.0
        """By how much the command that arrives now differs from the mean: while the speed changes, the ratio tells how
        late the joint is rather than what its valve gives."""

    def add(self, command: float, position: float, elapsed_s: float) -> None:
        """Run one tick with the commanded velocity [rad/s, m/s] and the measured position [rad, m]."""
        arrived = self._line.add(command * elapsed_s) / elapsed_s
        moved = 0.0 if self._position != self._position else (position - self._position) / elapsed_s
        self._position = position
        share = min(1.0, elapsed_s / self._mean_s)
        self.commanded += share * (arrived - self.commanded)
        self.moved += share * (moved - self.moved)
        self.change = abs(arrived - self.commanded)


# -- Command bound: how fast a joint may be commanded, so that it does not exceed its speed limit.
#
# A bounded reference does not bound the joint: a planner can let it fall behind, by announcing again and again a rest
# that never comes, and then have it catch up while the reference itself runs at the limit.  And a valve may give more
# than its map says; a joint shows that only after its reaction time, when it is too fast already.
#
# So the command is bounded by what the joint is known to give at speed, at first by `UNKNOWN_GAIN`.  That is learned
# from steady commands, upwards fast and downwards slowly.  Besides, a place follows the joint by its speed limit at
# most, and the further the joint is ahead of that place, the less may be commanded.  The joint is taken where it will
# be when the commands of its reaction time have reached it.  This feedback is weak: oil and a load answer later than
# the reaction time of the profile, and with a strong one (0.03 s in place of `RETURN_S`) the lift of an individual
# crane went to and fro between 0.8 and 1.25 times its limit, until the guard stopped it.


MOST_SHARE: Final = 1.1
"""Share of the speed limit that is commanded at most: to a joint whose valve gives too little."""
LEAST_SHARE: Final = 0.7
"""Share that may always be commanded: a joint that a load pushes ahead is not brought to a stop by this."""
RETURN_S: Final = 0.1
"""Time constant with which a joint ahead of its place is brought back to it."""
UNKNOWN_GAIN: Final = 1.2
"""Speed over the commanded one that is reckoned with before a joint has moved: what calibration would correct."""
GREATEST_GAIN: Final = 1.6
"""More is not learned, and a joint that moves by less than 1 over this is held."""
FAST_SHARE: Final = 0.5
"""Slower than this share of the speed limit a joint does not show what it gives at the limit."""
SPEED_MEAN_S: Final = 0.2
"""Arrived commands and travel are both averaged over this time."""
UNSTEADY_SHARE: Final = 0.15
"""A command farther from its own mean than this share teaches nothing."""
RISE_S: Final = 0.2
"""Time constant with which a greater gain is learned, ..."""
FALL_S: Final = 0.6
"""... and a smaller one."""


class CommandBound:
    """Of one joint; the gains of both directions are kept while the controller runs."""

    __slots__ = ("_ahead", "_flight", "_gain", "_place", "_speed", "_way")

    def __init__(self, speed_limit: float, reaction_s: float, period_s: float) -> None:
        self._speed = speed_limit
        self._flight = DelayCompensation(reaction_s, period_s)
        self._way = ArrivedSpeed(reaction_s, period_s, SPEED_MEAN_S)
        self._gain = [UNKNOWN_GAIN, UNKNOWN_GAIN]
        self.reset()

    def reset(self) -> None:
        """Begin with the valve at neutral: the joint may stand anywhere, and nothing is in flight."""
        self._flight.reset()
        self._way.reset()
        self._place = math.nan
        self._ahead = 0.0

    def limit(self, desired: float) -> float:
        """Compute the greatest speed to command in the direction of ``desired`` [rad/s, m/s]."""
        most = self._speed * min(1.0 / self._gain[desired >= 0.0], MOST_SHARE)
        ahead = self._ahead if desired >= 0.0 else -self._ahead
        return min(max(most - ahead / RETURN_S, LEAST_SHARE * self._speed), most)

    def add(self, command: float, position: float, elapsed_s: float) -> None:
        """Run one tick with the commanded velocity [rad/s, m/s] and the measured position [rad, m]."""
        self._flight.add(command * max(1.0, self._gain[command >= 0.0]) * elapsed_s)
        predicted = position + self._flight.travel
        if self._place != self._place:
            self._place = predicted
        most = self._speed * elapsed_s
        self._place += min(max(predicted - self._place, -most), most)
        self._ahead = predicted - self._place
        self._way.add(command, position, elapsed_s)
        self._learn(elapsed_s)

    def _learn(self, elapsed_s: float) -> None:
        way = self._way
        speed = abs(way.commanded)
        if speed < FAST_SHARE * self._speed or way.change > UNSTEADY_SHARE * speed:
            return
        side, ratio = way.commanded >= 0.0, way.moved / way.commanded
        if ratio * GREATEST_GAIN < 1.0:  # held, or its encoder is wrong
            return
        gain = self._gain[side]
        gain += min(1.0, elapsed_s / (RISE_S if ratio > gain else FALL_S)) * (ratio - gain)
        self._gain[side] = min(max(gain, 1.0 / MOST_SHARE), GREATEST_GAIN)


# -- Valve gain: how fast a joint really goes for what is commanded.
#
# Temperature, wear, a load or a low supply change what a valve gives for an opening, by more than feedback can make up
# for: behind a dead time its gain is small, and a joint that is 30 % slow trails by a third of its speed over that
# gain.  The commands that arrive and the travel that they make are both known, so the ratio is measured, not fed back:
# it needs no margin of the loop, and it stays for the next motion.  This is the perturbation estimate of a sliding mode
# (Elmali and Olgac 1992, "Sliding mode control with perturbation estimation"), for a perturbation that is a factor.


LEAST_GAIN: Final = 0.6
MOST_GAIN: Final = 1.6
"""What calibration, temperature and load leave."""
GAIN_WINDOW_S: Final = 0.25
"""Arrived commands and travel are both averaged over this time: a swinging load moves the joint to and fro."""
GAIN_TIME_S: Final = 0.3
"""Time constant of the estimate at speed."""
STEADY_SHARE: Final = 0.3
"""A command that differs from its own mean by this share of it teaches nothing, a steady one most."""
GAIN_SPEED_SHARE: Final = 0.05
"""Slower than this share of the speed limit a joint says little about its valve."""


class ValveGain:
    """Of one joint and both directions; what was learned is kept while the controller runs."""

    __slots__ = ("_gain", "_least", "_way")

    def __init__(self, speed_limit: float, reaction_s: float, period_s: float) -> None:
        self._way = ArrivedSpeed(reaction_s, period_s, GAIN_WINDOW_S)
        self._least = GAIN_SPEED_SHARE * speed_limit
        self._gain = [1.0, 1.0]
        self.reset()

    def reset(self) -> None:
        """Begin with the valve at neutral, and nothing in flight."""
        self._way.reset()

    def of(self, velocity: float) -> float:
        """Return the speed of the joint over the commanded one, in the direction of ``velocity``."""
        return self._gain[velocity > 0.0]

    def add(self, command: float, position: float, elapsed_s: float) -> None:
        """Run one tick with the commanded velocity [rad/s, m/s] and the measured position [rad, m]."""
        way = self._way
        way.add(command, position, elapsed_s)
        speed, side = abs(way.commanded), way.commanded > 0.0
        if speed > self._least:
            steady = max(0.0, 1.0 - way.change / (STEADY_SHARE * speed))
            ratio = way.moved / way.commanded
            learned = self._gain[side] + steady * min(1.0, elapsed_s / GAIN_TIME_S) * (ratio - self._gain[side])
            self._gain[side] = min(max(learned, LEAST_GAIN), MOST_GAIN)
