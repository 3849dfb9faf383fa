"""One bus as the loop uses it: received from, sent to, and reopened when it was lost.

Nothing here ends the process, because a running controller can report the fault.  After a recovery all waiting frames
of both directions are discarded: they are from a time in which the machine was not under control.

Old commands are never left in the transmit queue.  One that is full holds commands that have waited too long
(`controller.config.Settings.tx_queue_frames`): they are cancelled, and until the queue has been empty every tick that
sends cancels those of the one before.  A kernel's queue cannot be emptied from outside: there its own length is the
bound (`txqueuelen`), and guard and nodes refuse what comes late.
"""

from __future__ import annotations

from collections.abc import Sequence

from can_dbc.bus.base import Bus
from can_dbc.bus.reconnector import Reconnector
from can_dbc.frame import Frame, RawFrame
from can_dbc.messages.tick_record import BusReading


class BusLink:
    """A bus with its reconnection; call ``watch(now_ns)`` at the end of a cycle."""

    __slots__ = ("_held_up", "bus", "watch")

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.watch = Reconnector(bus).watch
        self._held_up = False

    def receive(self, frames: list[Frame], reading: BusReading) -> None:
        """Replace ``frames`` by all waiting frames, and update ``reading`` with the state of the bus."""
        frames.clear()
        stats = self.bus.stats
        self.bus.drain(frames)
        if stats.recoveries != reading.recoveries:
            self.bus.flush()
            frames.clear()
        reading.copy_from(stats)

    def send(self, frames: Sequence[RawFrame]) -> int:
        """Send the frames of a tick; returns how many the bus accepted.

        Frames that find no room are offered again once the old ones are cancelled; each refusal counts.
        """
        if not frames:
            return 0
        bus = self.bus
        if self._held_up:
            self._held_up = bus.discard() > 0
        accepted = bus.send_all(frames)
        if accepted < len(frames) and bus.discard():
            self._held_up = True
            accepted = bus.send_all(frames)
        return accepted
