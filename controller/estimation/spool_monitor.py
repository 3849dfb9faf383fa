"""Spool monitor: is a valve as far open as commanded, by the position sensor of its spool?  (safety.md cases 16 to 18)

A spool follows its command after a dead time that is not known well, so it has to be within the range of the commands
of the last `WINDOW_S`, of which three quarters always count: the longest dead time (0.15 s) and the spool's own 0.07 s.
Measured on two machines with sampled valves, at work: never more than 0.25 % of the stroke outside.  Where a
calibration has measured a longer dead time the window is as much longer (`window_s`).  In a spool test, which measures
it, it is `TEST_WINDOW_S`, and nearly that for a joint without an encoder, where nothing can measure it
(`LONGEST_DELAY_S`).  A spool that is further open, or open on the other side, moves oil that nobody asked for; one that
is shut moves none; anything else is a wrong gain.
"""

from __future__ import annotations

from typing import Final

from controller.estimation.recent_range import RecentRange
from machine.status.reasons import Reason

WINDOW_S: Final = 0.3
SPOOL_S: Final = 0.075
"""What the spool itself takes behind its dead time."""
LONGEST_DELAY_S: Final = 0.25
"""The longest dead time that a valve can have."""
TEST_WINDOW_S: Final = 0.45
"""That dead time, and the spool's own."""
SLACK_PCT: Final = 3.0
"""A spool may be outside its commands by this much of the stroke, ..."""
SLACK_SHARE: Final = 0.12
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
CERTAIN_SHARE: Final = 0.75
"""Share of a window of which every command counts (`controller.estimation.recent_range`)."""
_NONE: Final = Reason.NONE
_OPEN: Final = Reason.SPOOL_OPEN
_SHUT: Final = Reason.SPOOL_SHUT
_WRONG: Final = Reason.SPOOL_WRONG


def window_s(delay_s: float) -> float:
    """The window for a valve with this dead time by its profile, s."""
    return max(WINDOW_S, (delay_s + SPOOL_S) / CERTAIN_SHARE)


class SpoolMonitor:
    """Monitors one spool; ``deadband_pct`` is the lesser of its dead-bands: inside it no oil flows."""

    __slots__ = ("_commands", "_deadband_pct", "_in_tests", "_open_s", "_period_s", "_shut_s", "_wrong_s")

    def __init__(self, deadband_pct: float, period_s: float, delay_s: float = 0.0) -> None:
        """``delay_s``: the valve's dead time by its profile."""
        self._deadband_pct, self._period_s = deadband_pct, period_s
        self._commands = RecentRange(window_s(delay_s), period_s)
        self._in_tests = RecentRange(TEST_WINDOW_S, period_s)
        self._open_s = self._shut_s = self._wrong_s = 0.0

    def follow(self, command_pct: float) -> None:
        """One period in which the spool is not judged; it may still be on its way from former commands."""
        self._commands.add(command_pct)
        self._in_tests.add(command_pct)
        self._open_s = self._shut_s = self._wrong_s = 0.0

    def step(self, command_pct: float, spool_pct: float, tested: bool = False) -> Reason:
        """One period with the command and the measured position [% of the stroke]; ``tested``: a spool test drives this
        valve, or did a moment ago.
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
            wanted, short = least, least - spool
        elif most < 0.0:  # all commands were to the other side
            wanted, short = -most, spool - most
        else:
            wanted = short = 0.0
        beyond = spool - most if most > 0.0 else spool
        opened = beyond > OPEN_PCT + OPEN_SHARE * max(most, 0.0) and spool > self._deadband_pct
        slack = SLACK_PCT + SLACK_SHARE * max(wanted, most)
        shut = short > slack and (most < 0.0 or spool < SHUT_SHARE * wanted)
        self._open_s = self._open_s + dt if opened else 0.0
        self._shut_s = self._shut_s + dt if shut else 0.0
        self._wrong_s = self._wrong_s + dt if beyond > slack or short > slack else 0.0
        if self._open_s >= OPEN_S:
            return _OPEN
        if self._shut_s >= SHUT_S:
            return _SHUT
        return _WRONG if self._wrong_s >= WRONG_S else _NONE

    def shares(self) -> tuple[float, float, float]:
        """How long the spool has been too far open, shut, and otherwise wrong, over what is a fault."""
        return self._open_s / OPEN_S, self._shut_s / SHUT_S, self._wrong_s / WRONG_S
