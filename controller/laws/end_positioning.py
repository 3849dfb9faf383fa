"""Coming to rest and staying there: the end of a motion, without a limit cycle.

Quantised feedback, a dead-band whose edges are known to a few percent of the stroke, a dead time and a load that swings
on soft oil would keep any continuous law hunting (machines.md section 13, 1). So where the reference stands still, the
law only brings the joint near. Then the valve shuts until the joint has settled, and what is left is inched away: the
valve opens a little for as long as the rest of the way takes, and shuts until all is settled again. The way of an inch
is the oil that was metered, whatever the delay; how far an inch really went is learned, per direction, and so is how
far the valve must open to move at all. A long inch shows before it is over: it ends as soon as what is still to come
is seen to cover what is left. Within the stop band nothing happens, and every inch at one place widens it.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from machine.profile import JointSpec

INCH_SHARE: Final = 0.03
"""Speed of an inch over the full speed of its side."""
REACH_S: Final = 0.8
"""The law brings the joint as near as an inch goes in this time."""
STEP_SHARE: Final = 0.02
"""An inch that moves nothing opens the valve for this share of the full speed more the next time, ..."""
OPEN_LIMIT: Final = 0.14
"""... up to this share."""
NOTHING: Final = 0.2
"""An inch that went less than this share of its way moved nothing."""
LEARNED: Final = 0.7
"""Share of an inch's error that its next one in that direction leaves out, ..."""
SURE: Final = 4.0
"""... less of it for a way of less than so many stop bands: as much may come from a load that swings."""
GAIN_RANGE: Final = (0.3, 4.0)
WIDENING: Final = 0.25
FAST_S, SLOW_S = 0.1, 0.4
SETTLED_SHARE: Final = 0.4
"""Settled: a fast and a slow mean of the error agree to this share of the stop band for `SETTLED_S`."""
SETTLED_S: Final = 0.2
SETTLE_LIMIT_S: Final = 1.6
"""A joint that never settles (a load swings on it) counts as settled after this time."""
FAR: Final = 4.0
"""A joint that arrived so many stop bands away need not have settled before the first inch, ..."""
FAR_S: Final = 0.3
"""... but the valve must have shut."""


class _Phase(IntEnum):
    FOLLOWING = 0
    """The reference moves."""
    ARRIVING = 1
    """It stands, and the law brings the joint near."""
    INCHING = 2
    SETTLING = 3
    RESTING = 4


class Rest:
    """One joint's end of motion.  `step` gives the velocity to command instead of the law's."""

    __slots__ = (
        "_band", "_before", "_calm_s", "_direction", "_fast", "_full", "_gain", "_inches", "_lag_s", "_left_s", "_open",
        "_opened_s", "_phase", "_reaction_s", "_settling_s", "_slow", "_stall_s", "_way",
    )  # fmt: skip

    def __init__(self, spec: JointSpec) -> None:
        valve = spec.valve
        self._band = spec.law.stop_band
        self._lag_s = valve.lag_s
        self._reaction_s = valve.delay_s + valve.lag_s + valve.oil_s
        self._stall_s = SETTLED_S + 2.0 * (valve.delay_s + valve.lag_s)
        self._full = (valve.full_speed_minus, valve.full_speed_plus)
        self._open = [INCH_SHARE, INCH_SHARE]
        self._gain = [1.0, 1.0]
        self.reset()

    def reset(self) -> None:
        """At rest with a neutral valve; what was learned stays."""
        self._phase = _Phase.RESTING
        self._direction = self._inches = 0
        self._left_s = self._settling_s = self._calm_s = self._fast = self._slow = 0.0
        self._before = self._way = self._opened_s = 0.0

    @property
    def resting(self) -> bool:
        """Whether the valve is shut."""
        return self._phase >= _Phase.SETTLING

    def follow(self) -> None:
        """The reference moves: the law has the joint."""
        self._phase = _Phase.FOLLOWING
        self._inches = 0

    def step(self, error: float, predicted: float, wanted: float, elapsed_s: float) -> float:
        """Velocity to command while the reference stands still.

        ``error``: reference less position; ``predicted``: the same when what was commanded has come through;
        ``wanted``: what the law would command.
        """
        self._fast += min(1.0, elapsed_s / FAST_S) * (error - self._fast)
        self._slow += min(1.0, elapsed_s / SLOW_S) * (error - self._slow)
        if self._phase is _Phase.FOLLOWING:
            self._phase = _Phase.ARRIVING
            self._watch(error)
        if self._phase is _Phase.ARRIVING:
            # A law that moves nothing, because the dead-band is wider than the profile has it, is of no more use.
            if abs(predicted) > self._reach(predicted) and not self._calm(self._stall_s, elapsed_s):
                return wanted
            self._settle(error, 0)
        elif self._phase is _Phase.INCHING:
            return self._inch(error, elapsed_s)
        elif self._phase is _Phase.SETTLING:
            if self._calm(SETTLED_S, elapsed_s) or self._settling_s >= SETTLE_LIMIT_S:
                self._learn()
                self._phase = _Phase.RESTING
            elif self._direction == 0 and self._far(error):
                self._phase = _Phase.RESTING
        elif abs(self._slow) > self._band * (1.0 + WIDENING * self._inches):
            return self._begin(error)
        return 0.0

    def _reach(self, error: float) -> float:
        """How far an inch may go."""
        side = error > 0.0
        return REACH_S * INCH_SHARE * self._full[side]

    def _far(self, error: float) -> bool:
        """Whether so much is left that it need not stand still to be inched away."""
        left = min(self._slow, self._fast, error) if error > 0.0 else -max(self._slow, self._fast, error)
        return self._settling_s > FAR_S and left > FAR * self._band

    def _settle(self, error: float, direction: int) -> None:
        self._phase = _Phase.SETTLING
        self._direction = direction
        self._watch(error)

    def _watch(self, error: float) -> None:
        self._settling_s = self._calm_s = 0.0
        self._fast = self._slow = error

    def _calm(self, long_s: float, elapsed_s: float) -> bool:
        """Whether the error has stood for this time."""
        self._settling_s += elapsed_s
        calm = abs(self._fast - self._slow) < SETTLED_SHARE * self._band and self._settling_s > SLOW_S
        self._calm_s = self._calm_s + elapsed_s if calm else 0.0
        return self._calm_s >= long_s

    def _begin(self, error: float) -> float:
        """What is left is inched away, in more than one inch when it is much."""
        side = self._slow > 0.0
        self._phase = _Phase.INCHING
        self._direction, self._before = (1 if side else -1), self._slow
        self._way = min(abs(self._slow), 2.0 * self._reach(self._slow))
        self._inches += self._way == abs(self._slow)
        self._left_s = self._way / self._inch_speed() + self._lag_s
        self._opened_s = 0.0
        return self._inch(error, 0.0)

    def _inch_speed(self) -> float:
        """How fast the present inch is believed to be."""
        side = self._direction > 0
        return self._gain[side] * self._open[side] * self._full[side]

    def _inch(self, error: float, elapsed_s: float) -> float:
        direction, side = self._direction, self._direction > 0
        self._left_s -= elapsed_s
        self._opened_s += elapsed_s
        if self._covered(error):
            self._way -= max(0.0, self._left_s) * self._inch_speed()
            self._left_s = 0.0
        if self._left_s <= 0.0 or direction * error < -self._band:
            self._settle(error, direction)
            return 0.0
        return direction * self._open[side] * self._full[side]

    def _covered(self, error: float) -> bool:
        """Whether a joint that shows an inch gets to its goal with what is still to come, or beyond."""
        coming = self._direction * (self._fast - error) * self._reaction_s / FAST_S
        return self._opened_s > self._reaction_s and coming > max(0.0, self._direction * error)

    def _learn(self) -> None:
        if self._direction == 0:
            return
        side = self._direction > 0
        went = self._direction * (self._before - self._slow) / self._way
        if went < NOTHING:
            self._open[side] = min(self._open[side] + STEP_SHARE, OPEN_LIMIT)
        else:
            low, high = GAIN_RANGE
            learned = LEARNED * min(1.0, self._way / (SURE * self._band))
            self._gain[side] = min(max(self._gain[side] * (1.0 + learned * (went - 1.0)), low), high)
