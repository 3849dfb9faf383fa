"""How late a command comes, judged by its counter: one command a period, and the most punctual one sets the scale.

A transmit queue that a busy bus holds up delivers commands in order, complete, with good checksums, and old; the time
of reception does not show that.  Clocks differ, and a controller may skip a tick, so a lasting delay is forgiven
slowly, and a stream that begins anew after a silence has a new scale: a delay that was there before the first command
cannot be seen from its number.  Pure.
"""

from __future__ import annotations

from typing import Final

MAX_DELAY_NS: Final = 40_000_000
"""A node does not execute a command that comes later than this (docs/reference/can-bus.md section 9)."""
FORGIVEN_PER_S: Final = 0.02


class Punctuality:
    """One stream of commands with this period; a gap longer than ``silence_ns`` begins it anew."""

    __slots__ = ("_counter", "_due_ns", "_last_ns", "_period_ns", "_silence_ns")

    def __init__(self, period_ns: int, silence_ns: int) -> None:
        self._period_ns, self._silence_ns = period_ns, silence_ns
        self.reset()

    def reset(self) -> None:
        """Begin the stream again with the next command."""
        self._due_ns = self._last_ns = self._counter = -1

    def late(self, counter: int, stamp_ns: int) -> bool:
        """Tell whether the command with this counter (0 to 15), received at ``stamp_ns``, is too late."""
        gap_ns, steps = stamp_ns - self._last_ns, (counter - self._counter) & 0x0F
        begins = self._counter < 0 or gap_ns > self._silence_ns
        self._last_ns, self._counter = stamp_ns, counter
        due_ns = self._due_ns + steps * self._period_ns + int(gap_ns * FORGIVEN_PER_S)
        self._due_ns = stamp_ns if begins else min(due_ns, stamp_ns)
        return stamp_ns - self._due_ns > MAX_DELAY_NS
