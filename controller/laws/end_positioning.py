"""End positioning: bring a joint to its goal and keep it there, without a limit cycle.

Quantised feedback, a dead-band whose edges are known to a few percent of the stroke, a dead time, and a load that
swings on soft oil would keep any continuous law hunting (docs/reference/machines.md section 13, trap 1).  So where the
reference stands still, the law only brings the joint near.  Then the valve shuts until the joint has settled, and the
rest is covered by inching: the valve opens a little for as long as the remaining distance takes, and shuts until the
joint has settled again.

The distance of an inch is the oil that was metered, whatever the delay.  Two things are learned per direction: how far
an inch really goes, and how far the valve must open to move at all.  A long inch shows before it is over: it ends as
soon as what is still to come covers what is left.  Within the stop band nothing happens, and every inch at one place
widens the band.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from machine.profile import JointSpec

INCH_SHARE: Final = 0.03
"""Speed of an inch over the full speed of its side."""
REACH_S: Final = 0.8
"""The law brings the joint as near as an inch goes in this time."""
OPENING_STEP_SHARE: Final = 0.02
"""After an inch that moved nothing the valve opens by this share of the full speed more the next time, ..."""
MAX_OPENING_SHARE: Final = 0.14
"""... up to this share."""
NO_MOTION_SHARE: Final = 0.2
"""An inch that covered less than this share of its distance moved nothing."""
LEARNING_SHARE: Final = 0.7
"""Share of an inch's error that the next one in that direction corrects, ..."""
FULL_LEARNING_BANDS: Final = 4.0
"""... and less for a distance below this many stop bands, because a swinging load may cause as much."""
MIN_GAIN: Final = 0.3
MAX_GAIN: Final = 4.0
WIDENING_SHARE: Final = 0.25
"""Every inch at one place widens the stop band by this share."""
FAST_MEAN_S: Final = 0.1
SLOW_MEAN_S: Final = 0.4
SETTLED_SHARE: Final = 0.4
"""Settled: a fast and a slow mean of the error agree to this share of the stop band for `SETTLED_S`."""
SETTLED_S: Final = 0.2
MAX_SETTLING_S: Final = 1.6
"""A joint that never settles (a load swings on it) counts as settled after this time."""
FAR_BANDS: Final = 4.0
"""A joint that arrived more than this many stop bands away need not settle before the first inch, ..."""
FAR_WAIT_S: Final = 0.3
"""... but the valve must have shut."""


class _Phase(IntEnum):
    FOLLOWING = 0
    """The reference moves."""
    ARRIVING = 1
    """The reference stands, and the law brings the joint near."""
    INCHING = 2
    SETTLING = 3
    RESTING = 4


class EndPositioning:
    """End positioning of one joint; `step` returns the velocity to command in place of the law's."""

    __slots__ = (
        "_band", "_before", "_direction", "_distance", "_fast", "_full", "_gain", "_inches", "_lag_s", "_left_s",
        "_open", "_opened_s", "_phase", "_reaction_s", "_settling_s", "_slow", "_stall_s", "_still_s",
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
        """Resting with a neutral valve; what was learned is kept."""
        self._phase = _Phase.RESTING
        self._direction = self._inches = 0
        self._left_s = self._settling_s = self._still_s = self._fast = self._slow = 0.0
        self._before = self._distance = self._opened_s = 0.0

    @property
    def resting(self) -> bool:
        """Whether the valve is shut."""
        return self._phase >= _Phase.SETTLING

    def follow(self) -> None:
        """The reference moves: the law controls the joint."""
        self._phase = _Phase.FOLLOWING
        self._inches = 0

    def step(self, error: float, predicted: float, wanted: float, elapsed_s: float) -> float:
        """Velocity to command while the reference stands still [rad/s, m/s].

        ``error``: reference less position; ``predicted``: the same once all commands in flight have come through;
        ``wanted``: the law's command.
        """
        self._fast += min(1.0, elapsed_s / FAST_MEAN_S) * (error - self._fast)
        self._slow += min(1.0, elapsed_s / SLOW_MEAN_S) * (error - self._slow)
        if self._phase is _Phase.FOLLOWING:
            self._phase = _Phase.ARRIVING
            self._start_observing(error)
        if self._phase is _Phase.ARRIVING:
            # A law that moves nothing, because the dead-band is wider than in the profile, is of no more use.
            if abs(predicted) > self._reach(predicted) and not self._stands_still(self._stall_s, elapsed_s):
                return wanted
            self._settle(error, 0)
        elif self._phase is _Phase.INCHING:
            return self._inch(error, elapsed_s)
        elif self._phase is _Phase.SETTLING:
            if self._stands_still(SETTLED_S, elapsed_s) or self._settling_s >= MAX_SETTLING_S:
                self._learn()
                self._phase = _Phase.RESTING
            elif self._direction == 0 and self._far(error):
                self._phase = _Phase.RESTING
        elif abs(self._slow) > self._band * (1.0 + WIDENING_SHARE * self._inches):
            return self._begin_inch(error)
        return 0.0

    def _reach(self, error: float) -> float:
        """Distance that an inch may cover."""
        side = error > 0.0
        return REACH_S * INCH_SHARE * self._full[side]

    def _far(self, error: float) -> bool:
        """Whether so much is left that the joint need not settle before the first inch."""
        left = min(self._slow, self._fast, error) if error > 0.0 else -max(self._slow, self._fast, error)
        return self._settling_s > FAR_WAIT_S and left > FAR_BANDS * self._band

    def _settle(self, error: float, direction: int) -> None:
        self._phase = _Phase.SETTLING
        self._direction = direction
        self._start_observing(error)

    def _start_observing(self, error: float) -> None:
        self._settling_s = self._still_s = 0.0
        self._fast = self._slow = error

    def _stands_still(self, for_s: float, elapsed_s: float) -> bool:
        """Whether the error has not changed for this time."""
        self._settling_s += elapsed_s
        still = abs(self._fast - self._slow) < SETTLED_SHARE * self._band and self._settling_s > SLOW_MEAN_S
        self._still_s = self._still_s + elapsed_s if still else 0.0
        return self._still_s >= for_s

    def _begin_inch(self, error: float) -> float:
        """Begin an inch; a long distance takes more than one."""
        side = self._slow > 0.0
        self._phase = _Phase.INCHING
        self._direction, self._before = (1 if side else -1), self._slow
        self._distance = min(abs(self._slow), 2.0 * self._reach(self._slow))
        self._inches += self._distance == abs(self._slow)
        self._left_s = self._distance / self._inch_speed() + self._lag_s
        self._opened_s = 0.0
        return self._inch(error, 0.0)

    def _inch_speed(self) -> float:
        """Expected speed of the present inch."""
        side = self._direction > 0
        return self._gain[side] * self._open[side] * self._full[side]

    def _inch(self, error: float, elapsed_s: float) -> float:
        direction, side = self._direction, self._direction > 0
        self._left_s -= elapsed_s
        self._opened_s += elapsed_s
        if self._covered(error):
            self._distance -= max(0.0, self._left_s) * self._inch_speed()
            self._left_s = 0.0
        if self._left_s <= 0.0 or direction * error < -self._band:
            self._settle(error, direction)
            return 0.0
        return direction * self._open[side] * self._full[side]

    def _covered(self, error: float) -> bool:
        """Whether a joint that shows the inch reaches its goal with what is still to come, or passes it."""
        coming = self._direction * (self._fast - error) * self._reaction_s / FAST_MEAN_S
        return self._opened_s > self._reaction_s and coming > max(0.0, self._direction * error)

    def _learn(self) -> None:
        if self._direction == 0:
            return
        side = self._direction > 0
        went = self._direction * (self._before - self._slow) / self._distance
        if went < NO_MOTION_SHARE:
            self._open[side] = min(self._open[side] + OPENING_STEP_SHARE, MAX_OPENING_SHARE)
        else:
            learned = LEARNING_SHARE * min(1.0, self._distance / (FULL_LEARNING_BANDS * self._band))
            self._gain[side] = min(max(self._gain[side] * (1.0 + learned * (went - 1.0)), MIN_GAIN), MAX_GAIN)
