"""The monitors of a valve: is its spool where it was commanded, and does its joint move as that lets expect?

Each judges one valve, once in a period, against the range of what was commanded lately (`RecentRange`), because its
dead time is not known well.  `SpoolMonitor` compares the spool with its command, `SpeedMonitor` the joint's speed with
the spool (`controller.valve_watch` runs both), and `DirectionMonitor` only the side to which a joint moves in a spool
test (`controller.joint_watch`).
"""

from __future__ import annotations

import math
from typing import Final

from controller.estimation.joint_estimator import TrackedJoint
from machine.profile import Valve
from machine.status.reasons import Reason

_NONE: Final = Reason.NONE
PARTS: Final = 4
"""Of the window of a `RecentRange`, ..."""
CERTAIN_SHARE: Final = 0.75
"""... and the share of it of which every value counts."""


class RecentRange:
    """``low`` and ``high`` of the values of the last ``window_s``, in constant time and without memory that grows.

    The window is cut into `PARTS` of which each keeps its least and its greatest value, so the range covers between
    `CERTAIN_SHARE` of the window and all of it.
    """

    # Attributes of a compiled class hold numbers without an object for each; a list would not.
    __slots__ = (
        "_high_1",
        "_high_2",
        "_high_3",
        "_high_now",
        "_left",
        "_low_1",
        "_low_2",
        "_low_3",
        "_low_now",
        "_older_high",
        "_older_low",
        "_ticks",
        "high",
        "low",
    )

    def __init__(self, window_s: float, period_s: float) -> None:
        self._ticks = max(1, round(window_s / period_s / PARTS))
        self.reset(0.0)

    def reset(self, value: float) -> None:
        """Fill the window with this value, as if it had always been this."""
        self._low_now = self._low_1 = self._low_2 = self._low_3 = value
        self._high_now = self._high_1 = self._high_2 = self._high_3 = value
        self._older_low = self._older_high = self.low = self.high = value
        self._left = self._ticks

    def add(self, value: float) -> None:
        """Add the value of this tick."""
        if self._left == 0:
            self._begin_part(value)
        self._left -= 1
        if value < self._low_now:
            self._low_now = value
        if value > self._high_now:
            self._high_now = value
        self.low = self._low_now if self._low_now < self._older_low else self._older_low
        self.high = self._high_now if self._high_now > self._older_high else self._older_high

    def _begin_part(self, value: float) -> None:
        self._left = self._ticks
        self._low_3, self._low_2, self._low_1, self._low_now = self._low_2, self._low_1, self._low_now, value
        self._high_3, self._high_2, self._high_1, self._high_now = self._high_2, self._high_1, self._high_now, value
        self._older_low = min(self._low_1, self._low_2, self._low_3)
        self._older_high = max(self._high_1, self._high_2, self._high_3)


# -- Spool monitor: is a valve as far open as commanded, by the position sensor of its spool?  (safety.md cases 16..18)
#
# A spool follows its command after a dead time that is not known well, so it has to be within the range of the commands
# of the last `SPOOL_WINDOW_S`, of which three quarters always count: the longest dead time (0.15 s) and the spool's own
# 0.07 s.  Measured on two machines with sampled valves, at work: never more than 0.25 % of the stroke outside.  Where a
# calibration has measured a longer dead time the window is as much longer (`spool_window_s`).  In a spool test, which
# measures it, it is `TEST_WINDOW_S`, and nearly that for a joint without an encoder, where nothing can measure it
# (`LONGEST_DELAY_S`).  A spool that is further open, or open on the other side, moves oil that nobody asked for; one
# that is shut moves none; anything else is a wrong gain.

SPOOL_WINDOW_S: Final = 0.3
SPOOL_S: Final = 0.075
"""What the spool itself takes behind its dead time."""
LONGEST_DELAY_S: Final = 0.25
"""The longest dead time that a valve can have."""
TEST_WINDOW_S: Final = 0.45
"""That dead time, and the spool's own."""
SPOOL_SLACK_PCT: Final = 3.0
"""A spool may be outside its commands by this much of the stroke, ..."""
SPOOL_SLACK_SHARE: Final = 0.12
"""... and this share of the command."""
OPEN_PCT: Final = 4.0
OPEN_SHARE: Final = 0.15
"""Further open than its command by these two: the valve is out of control, not out of adjustment."""
SHUT_SHARE: Final = 0.25
"""A spool at less than this share of its command counts as shut."""
OPEN_S: Final = 0.01
SHUT_S: Final = 0.05
WRONG_S: Final = 0.15
"""How long each must last."""
_OPEN: Final = Reason.SPOOL_OPEN
_SHUT: Final = Reason.SPOOL_SHUT
_SPOOL_WRONG: Final = Reason.SPOOL_WRONG


def spool_window_s(delay_s: float) -> float:
    """Compute the window for a valve with this dead time by its profile, s."""
    return max(SPOOL_WINDOW_S, (delay_s + SPOOL_S) / CERTAIN_SHARE)


class SpoolMonitor:
    """Monitors one spool; ``deadband_pct`` is the lesser of its dead-bands: inside it no oil flows."""

    __slots__ = ("_commands", "_deadband_pct", "_in_tests", "_open_s", "_period_s", "_shut_s", "_wrong_s")

    def __init__(self, deadband_pct: float, period_s: float, delay_s: float = 0.0) -> None:
        """``delay_s``: the valve's dead time by its profile."""
        self._deadband_pct, self._period_s = deadband_pct, period_s
        self._commands = RecentRange(spool_window_s(delay_s), period_s)
        self._in_tests = RecentRange(TEST_WINDOW_S, period_s)
        self._open_s = self._shut_s = self._wrong_s = 0.0

    def follow(self, command_pct: float) -> None:
        """Take one period in which the spool is not judged; it may still be on its way from former commands."""
        self._commands.add(command_pct)
        self._in_tests.add(command_pct)
        self._open_s = self._shut_s = self._wrong_s = 0.0

    def step(self, command_pct: float, spool_pct: float, tested: bool = False) -> Reason:
        """Take one period with the command and the measured position [% of the stroke]; ``tested``: a spool test drives
        this valve, or did a moment ago.
        """
        dt = self._period_s
        self._commands.add(command_pct)
        self._in_tests.add(command_pct)
        commands = self._in_tests if tested else self._commands
        # Seen from the spool's own side: 0 is neutral, more is further open.
        if spool_pct >= 0.0:
            spool, least, most = spool_pct, commands.low, commands.high
        else:
            spool, least, most = -spool_pct, -commands.high, -commands.low
        if least > 0.0:
            needed, short = least, least - spool
        elif most < 0.0:  # all commands were to the other side
            needed, short = -most, spool - most
        else:
            needed = short = 0.0
        beyond = spool - most if most > 0.0 else spool
        opened = beyond > OPEN_PCT + OPEN_SHARE * max(most, 0.0) and spool > self._deadband_pct
        slack = SPOOL_SLACK_PCT + SPOOL_SLACK_SHARE * max(needed, most)
        shut = short > slack and (most < 0.0 or spool < SHUT_SHARE * needed)
        self._open_s = self._open_s + dt if opened else 0.0
        self._shut_s = self._shut_s + dt if shut else 0.0
        self._wrong_s = self._wrong_s + dt if beyond > slack or short > slack else 0.0
        if self._open_s >= OPEN_S:
            return _OPEN
        if self._shut_s >= SHUT_S:
            return _SHUT
        return _SPOOL_WRONG if self._wrong_s >= WRONG_S else _NONE

    def shares(self) -> tuple[float, float, float]:
        """Tell how long the spool has been too far open, shut, and otherwise wrong, over what is a fault."""
        return self._open_s / OPEN_S, self._shut_s / SHUT_S, self._wrong_s / WRONG_S


# -- Speed monitor: does a joint move as fast as its valve lets oil flow?  (docs/reference/safety.md cases 1, 5 and 16)
#
# The speed that belongs to the spool's measured position, or where no sensor measures it to the command, is known by
# the valve map.  The joint follows it after up to 0.19 s (oil, steel, estimator; measured), so it is compared with the
# range of the last `SPEED_WINDOW_S`.  Measured on sampled machines, at work and with a log: 0.69 to 1.22 times the map.
# An encoder with half or twice its scale is outside that, and so is one that stands still, or a joint that something
# holds.
#
# A dead-band that is known badly shifts the map by `DEADBAND_PCT` of the stroke, which is much at small openings.  The
# shift is learned from steady motion, for each direction; before it is known the monitor allows for all of it.  Slow
# joints stick, are pushed and slip: there being too slow must last longer.

SPEED_WINDOW_S: Final = 0.28
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
SPEED_SLACK_SHARE: Final = 0.03
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
_SPEED_WRONG: Final = Reason.SPEED_WRONG
_STUCK: Final = Reason.JOINT_STUCK
_RUNAWAY: Final = Reason.JOINT_RUNAWAY


def command_window_s(valve: Valve) -> float:
    """Compute the window of a valve whose spool no sensor measures, s."""
    return COMMAND_WINDOW_S + max(0.0, valve.delay_s - USUAL_DELAY_S)


class SpeedMonitor:
    """Monitors one joint.

    Args:
        window_s: `SPEED_WINDOW_S`, or by `command_window_s`.
        least_speed: see `controller.estimation.joint_monitors.USUAL_SPEED`.
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
        self._limit, self._least, self._slack = speed_limit, LEAST_SHARE * usual, SPEED_SLACK_SHARE * usual
        self._doubt = DEADBAND_PCT / 100.0 * max(valve.full_speed_plus, valve.full_speed_minus)
        self._period_s = period_s
        self._range = RecentRange(window_s, period_s)
        self._shift, self._learned_s = [0.0, 0.0], [0.0, 0.0]
        """By which the map is too fast in the negative and the positive direction, and how long it was learned."""
        self._stood_s = self._fast_s = self._slow_s = self._backwards_s = 0.0
        self._fast_most_s, self._slow_most_s = FAST_S, STICKING_S
        self._backwards_most_s, self._stood_most_s = BACKWARDS_S, STOOD_S

    def reset(self) -> None:
        """Begin with the valve shut; what was learned of it stays."""
        self._range.reset(0.0)
        self._stood_s = self._fast_s = self._slow_s = self._backwards_s = 0.0

    def step(self, expected: float, velocity: float, pressed: bool = False, pushed: bool = False) -> Reason:
        """Take one period with the speed that belongs to the valve and the measured one [rad/s or m/s], whether the
        jaws press on the joint, and whether it moves against the pressure of its own oil, which no valve does.
        """
        recent, dt = self._range, self._period_s
        recent.add(expected)
        lowest, highest = recent.low, recent.high
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
            return _SPEED_WRONG
        return _STUCK if self._stood_s >= self._stood_most_s else _NONE

    def shares(self) -> tuple[float, float, float]:
        """Tell how long the joint has been too fast, backwards or too slow, and standing, over what is a fault."""
        wrong = max(self._backwards_s / self._backwards_most_s, self._slow_s / self._slow_most_s)
        return self._fast_s / self._fast_most_s, wrong, self._stood_s / self._stood_most_s

    def _learn(self, side: int, shift: float) -> None:
        """Take a steady speed into account; a shift beyond what a dead-band explains is none."""
        bounded = max(-self._doubt, min(self._doubt, shift))
        self._shift[side] += self._period_s / LEARNING_S * (bounded - self._shift[side])
        self._learned_s[side] += self._period_s


# -- Direction monitor: does a joint in a spool test move to the side to which its spool is open?
#
# A spool test measures a valve of which nothing is known: where oil begins to flow, how much, and when.  So a speed
# that is expected of the command proves nothing, and neither does a joint that stands.  Only the side is certain.  Any
# valve has answered `ANSWER_S` after its command; if the command has been to one side for so long and the joint still
# goes to the other, by more than ringing oil swings it, then valve or encoder is connected the wrong way round.  How
# far and how fast a tested joint may go at all is limited by `controller.crane.spool_test_run`.

ANSWER_S: Final = 0.45
"""The longest dead time (0.25 s) and the spool's own 0.07 s are within three quarters of it."""
DIRECTION_MEMORY_S: Final = 0.5
AGAINST_S_AT_LIMIT: Final = 0.1
LEAST_AGAINST: Final = 0.02
"""A joint goes against its test by the way of the first at the speed limit, and at least by this [rad, m]: a procedure
that watches its own test ends it at less than half of it and knows more about the cause."""


class DirectionMonitor:
    """Monitors one joint; `step` tells whether it moves against its test."""

    __slots__ = ("_against", "_commands", "_decay", "_limit", "_period_s")

    def __init__(self, spec: TrackedJoint, period_s: float) -> None:
        self._period_s, self._decay = period_s, math.exp(-period_s / DIRECTION_MEMORY_S)
        self._limit = max(AGAINST_S_AT_LIMIT * spec.speed_limit, LEAST_AGAINST)
        self._commands = RecentRange(ANSWER_S, period_s)
        self._against = 0.0

    def reset(self) -> None:
        """Reset as if no test had been lately."""
        self._against = 0.0
        self._commands.reset(0.0)

    def step(self, command: float, velocity: float) -> bool:
        """Take one period with the spool's command (+ moves the joint in its positive direction) and the joint's
        velocity [rad/s, m/s].
        """
        commands = self._commands
        commands.add(command)
        opposed = (commands.low > 0.0 and velocity < 0.0) or (commands.high < 0.0 and velocity > 0.0)
        self._against = self._decay * self._against + (self._period_s * abs(velocity) if opposed else 0.0)
        return self._against > self._limit
