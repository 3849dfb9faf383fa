"""Speed monitor: does a joint move as fast as its valve lets oil flow?  (docs/reference/safety.md cases 1, 5 and 16)

The speed that belongs to the spool's measured position, or where no sensor measures it to the command, is known by the
valve map.  The joint follows it after up to 0.19 s (oil, steel, estimator; measured), so it is compared with the range
of the last `WINDOW_S`.  Measured on sampled machines, at work and with a log: 0.69 to 1.22 times the map.  An encoder
with half or twice its scale is outside that, and so is one that stands still, or a joint that something holds.

A dead-band that is known badly shifts the map by `DEADBAND_PCT` of the stroke, which is much at small openings.  The
shift is learned from steady motion, for each direction; before it is known the monitor allows for all of it.  Slow
joints stick, are pushed and slip: there being too slow must last longer.
"""

from __future__ import annotations

from typing import Final

from controller.estimation.recent_range import RecentRange
from machine.profile import Valve
from machine.status.reasons import Reason

WINDOW_S: Final = 0.28
COMMAND_WINDOW_S: Final = 0.4
"""A command comes before its spool, by a dead time of up to ..."""
USUAL_DELAY_S: Final = 0.15
"""... this.  One that is longer by the profile is added."""
DEADBAND_PCT: Final = 8.0
"""Half again as much as the 12 to 16 % of real valves, or as little."""
LEARNED_S: Final = 0.5
"""Time of steady motion after which the shift is known."""
LEARNING_S: Final = 0.4
KNOWN_DOUBT: Final = 0.2
"""Share of the doubt that remains about a joint that is fast: a dead-band differs a little with the load."""
STEADY_SHARE: Final = 0.2
"""The motion is steady while the expected speed varies by less than this share of the speed limit over the window."""
LEAST_SHARE: Final = 0.1
"""Below this share of the speed limit the monitor is blind."""
SLACK_SHARE: Final = 0.03
"""Share of the speed limit by which a joint may differ besides: pendulum and ringing oil."""
FASTEST: Final = 1.4
SLOWEST: Final = 0.75
STOOD: Final = 0.25
"""Times the map's speed; a joint slower than the last stands."""
FAST_S: Final = 0.05
FAST_PRESSED_S: Final = 0.25
"""A log that the jaws let go throws the boom up on its oil for a tenth of a second or two, one that comes free does."""
SLOW_S: Final = 0.07
STICKING_S: Final = 0.3
STICKING_SHARE: Final = 1.5
"""... below this many times the doubt, where a joint may stick."""
STOOD_S: Final = 0.1
BACKWARDS_S: Final = 0.03
HELD_PRESSED_S: Final = 1.5
"""Instead of the last four while jaws or a load press: ground, heap and bunk hold a boom that sets a log down, and push
it back (0.7 s, by 60 mrad, on the pile in a bunk that was a few centimetres higher than planned)."""
"""How long each must last.  In a quarter of an hour of recorded work none lasted longer than one sample."""
_NONE: Final = Reason.NONE
_WRONG: Final = Reason.SPEED_WRONG
_STUCK: Final = Reason.JOINT_STUCK
_RUNAWAY: Final = Reason.JOINT_RUNAWAY


def command_window_s(valve: Valve) -> float:
    """The window of a valve whose spool no sensor measures, s."""
    return COMMAND_WINDOW_S + max(0.0, valve.delay_s - USUAL_DELAY_S)


class SpeedMonitor:
    """Monitors one joint.

    Args:
        window_s: one of the two above.
        least_speed: see `controller.estimation.usual_speed`.
    """

    __slots__ = (
        "_backwards_most_s",
        "_backwards_s",
        "_doubt",
        "_fast_most_s",
        "_fast_s",
        "_learned_s",
        "_least",
        "_limit",
        "_period_s",
        "_range",
        "_shift",
        "_slack",
        "_slow_most_s",
        "_slow_s",
        "_stood_most_s",
        "_stood_s",
    )

    def __init__(
        self, valve: Valve, speed_limit: float, period_s: float, window_s: float, least_speed: float = 0.0
    ) -> None:
        usual = max(speed_limit, least_speed)
        self._limit, self._least, self._slack = speed_limit, LEAST_SHARE * usual, SLACK_SHARE * usual
        self._doubt = DEADBAND_PCT / 100.0 * max(valve.full_speed_plus, valve.full_speed_minus)
        self._period_s = period_s
        self._range = RecentRange(window_s, period_s)
        self._shift, self._learned_s = [0.0, 0.0], [0.0, 0.0]
        """By which the map is too fast in the negative and the positive direction, and how long it was learned."""
        self._stood_s = self._fast_s = self._slow_s = self._backwards_s = 0.0
        self._fast_most_s, self._slow_most_s = FAST_S, STICKING_S
        self._backwards_most_s, self._stood_most_s = BACKWARDS_S, STOOD_S

    def reset(self) -> None:
        """The valve has been shut; what was learned of it stays."""
        self._range.reset(0.0)
        self._stood_s = self._fast_s = self._slow_s = self._backwards_s = 0.0

    def step(self, expected: float, velocity: float, pressed: bool = False, pushed: bool = False) -> Reason:
        """One period with the speed that belongs to the valve and the measured one [rad/s or m/s], whether the jaws
        press on the joint, and whether it moves against the pressure of its own oil, which no valve does.
        """
        seen, dt = self._range, self._period_s
        seen.add(expected)
        lowest, highest = seen.low, seen.high
        # Seen from the side to which the joint had to move all the time; without one it may stand or move either way.
        if lowest > 0.0:
            side, least, most, speed = 1, lowest, highest, velocity
        elif highest < 0.0:
            side, least, most, speed = 0, -highest, -lowest, -velocity
        else:
            side, least, most, speed = -1, 0.0, max(highest, -lowest), abs(velocity)
        shift, doubt = 0.0, self._doubt
        if side >= 0:
            shift = self._shift[side]
            if self._learned_s[side] >= LEARNED_S:
                doubt = 0.0
        # What was learned only widens the range: at another opening the map's error is another one.
        low = least - max(shift, 0.0) - doubt
        high = most - min(shift, 0.0) + max(doubt, self._doubt * KNOWN_DOUBT)
        driven = side >= 0 and low > self._least
        stood = driven and speed < STOOD * low
        backwards = stood and speed < -STOOD * low
        slow = driven and speed < SLOWEST * low - self._slack
        fast = not pushed and speed > 2.0 * self._least and speed > FASTEST * high + self._slack
        learns = side >= 0 and most - least < STEADY_SHARE * self._limit
        if learns and not slow and not fast and speed > 0.0:
            self._learn(side, 0.5 * (least + most) - speed)
        self._stood_s = self._stood_s + dt if stood and not backwards else 0.0
        self._backwards_s = self._backwards_s + dt if backwards else 0.0
        self._slow_s = self._slow_s + dt if slow and not stood else 0.0
        self._fast_s = self._fast_s + dt if fast else 0.0
        self._fast_most_s = FAST_PRESSED_S if pressed else FAST_S
        if self._fast_s >= self._fast_most_s:
            return _RUNAWAY
        if pressed:
            self._slow_most_s = self._backwards_most_s = self._stood_most_s = HELD_PRESSED_S
        else:
            self._slow_most_s = SLOW_S if low > STICKING_SHARE * self._doubt else STICKING_S
            self._backwards_most_s, self._stood_most_s = BACKWARDS_S, STOOD_S
        if self._backwards_s >= self._backwards_most_s or self._slow_s >= self._slow_most_s:
            return _WRONG
        return _STUCK if self._stood_s >= self._stood_most_s else _NONE

    def shares(self) -> tuple[float, float, float]:
        """How long the joint has been too fast, backwards or too slow, and standing, over what is a fault."""
        wrong = max(self._backwards_s / self._backwards_most_s, self._slow_s / self._slow_most_s)
        return self._fast_s / self._fast_most_s, wrong, self._stood_s / self._stood_most_s

    def _learn(self, side: int, shift: float) -> None:
        """Take a steady speed into account; a shift beyond what a dead-band explains is none."""
        bounded = max(-self._doubt, min(self._doubt, shift))
        self._shift[side] += self._period_s / LEARNING_S * (bounded - self._shift[side])
        self._learned_s[side] += self._period_s
