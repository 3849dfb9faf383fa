"""One bus as the loop uses it: drained, sent to, and got back when it was lost.

Nothing here ends the process, because a controller that lives can say what is wrong.  After a recovery everything that
waited on either side is thrown away: it belongs to a time in which the machine was not under control.
"""

from __future__ import annotations

from can_dbc.bus import Bus
from can_dbc.frame import Frame
from can_dbc.lost_link import LostLink
from can_dbc.tick_record import BusReading


class Link:
    """A bus with what a loop needs around it; ``watch(now_ns)`` belongs at the end of a cycle."""

    __slots__ = ("bus", "send", "watch")

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.send = bus.send_all
        self.watch = LostLink(bus).watch

    def read(self, frames: list[Frame], reading: BusReading) -> None:
        """All that waits, into the emptied ``frames``, and how the bus is."""
        frames.clear()
        stats = self.bus.stats
        self.bus.drain(frames)
        if stats.recoveries != reading.recoveries:
            self.bus.flush()
            frames.clear()
        reading.take(stats)
