"""Receive times on the monotonic clock from stamps of the wall clock, whatever is done to the wall clock.

The kernel stamps a frame by the wall clock, which NTP, a GNSS receiver or a person may set at any moment.  A frame that
waited while the clock was set carries the old time and meets the new offset.  Two facts bound its true time: a frame
that is taken now came before now, and after the last moment at which the queue was empty.  A stamp outside is converted
with the offset of that moment, and if this does not fit either, the frame counts as being as old as it can be.  So a
clock that is set may make a frame look older by a drain or two, but never fresh, hours old or older than the socket.
"""

from __future__ import annotations

from typing import Final


class ReceiveClock:
    """Converts the stamps of one queue.  After `begin`, ``stamp + offset_ns`` is right if it lies between ``since_ns``
    and ``now_ns``; else `doubtful_ns` decides.
    """

    __slots__ = ("_offset_when_empty_ns", "_previous_ns", "now_ns", "offset_ns", "since_ns")

    def __init__(self, now_ns: int) -> None:
        self.now_ns = self.since_ns = self._previous_ns = now_ns
        self.offset_ns = self._offset_when_empty_ns = 0

    def begin(self, now_ns: int, wall_ns: int) -> None:
        """Note that frames were taken; both clocks [ns], read after that."""
        self._previous_ns, self.now_ns = self.now_ns, now_ns
        self.offset_ns = now_ns - wall_ns

    def emptied(self) -> None:
        """Note that the queue was empty between the last two calls of `begin`: later frames came after the former."""
        self.since_ns, self._offset_when_empty_ns = self._previous_ns, self.offset_ns

    def doubtful_ns(self, stamp_ns: int) -> int:
        """Receive time [ns] of a frame whose wall-clock stamp does not fit the present offset."""
        before_ns = stamp_ns + self._offset_when_empty_ns
        return before_ns if self.since_ns <= before_ns <= self.now_ns else self.since_ns


# -- Receive time of a frame from the kernel's two stamps: that of the receive interrupt and that of the adapter.
#
# The software stamp is on the system's clock and late by the latency of the interrupt, never early.  A hardware
# stamp is exact, but on the adapter's own clock, which has an arbitrary offset and drifts.  `HardwareClock`
# converts the latter to the former's scale: their difference is smallest for the frame with the shortest interrupt
# latency.

DRIFT_PPM: Final = 200
"""Drift between two cheap quartz oscillators; the offset may grow this fast, to follow a slow adapter clock."""
_JUMP_NS: Final = 100_000_000


class HardwareClock:
    """Follows one adapter's clock.  The result is never later than the software stamp and never runs backward."""

    __slots__ = ("_last_ns", "_offset_ns", "_seen_ns")

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._seen_ns = self._last_ns = 0

    def stamp_ns(self, hardware_ns: int, software_ns: int) -> int:
        """Receive time [ns] on the clock of `software_ns` of a frame with both stamps."""
        latency_ns = software_ns - hardware_ns
        offset_ns = self._offset_ns
        elapsed_ns = hardware_ns - self._seen_ns
        if offset_ns is not None:
            offset_ns -= -elapsed_ns * DRIFT_PPM // 1_000_000  # rounded up: many short gaps must not lose their drift
        if offset_ns is None or elapsed_ns < 0 or not 0 <= latency_ns - offset_ns < _JUMP_NS:
            offset_ns = latency_ns  # shortest latency so far, or one of the two clocks was set
        self._offset_ns, self._seen_ns = offset_ns, hardware_ns
        self._last_ns = stamp_ns = min(max(hardware_ns + offset_ns, self._last_ns), software_ns)
        return stamp_ns
