"""One bus as the loop uses it: received from, sent to, and reopened when it was lost.

Nothing here ends the process, because a running controller can report the fault.  After a recovery all waiting frames
of both directions are discarded: they are from a time in which the machine was not under control.
"""

from __future__ import annotations

from can_dbc.bus.base import Bus
from can_dbc.bus.reconnector import Reconnector
from can_dbc.frame import Frame
from can_dbc.messages.tick_record import BusReading


class BusLink:
    """A bus with its reconnection; call ``watch(now_ns)`` at the end of a cycle."""

    __slots__ = ("bus", "send", "watch")

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.send = bus.send_all
        self.watch = Reconnector(bus).watch

    def receive(self, frames: list[Frame], reading: BusReading) -> None:
        """Replace ``frames`` by all waiting frames, and update ``reading`` with the state of the bus."""
        frames.clear()
        stats = self.bus.stats
        self.bus.drain(frames)
        if stats.recoveries != reading.recoveries:
            self.bus.flush()
            frames.clear()
        reading.copy_from(stats)
