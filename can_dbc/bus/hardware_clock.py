"""Receive time of a frame from the kernel's two stamps: that of the receive interrupt and that of the adapter.

The software stamp is on the system's clock and late by the latency of the interrupt, never early.  A hardware stamp is
exact, but on the adapter's own clock, which has an arbitrary offset and drifts.  `HardwareClock` converts the latter to
the former's scale: their difference is smallest for the frame with the shortest interrupt latency.
"""

from __future__ import annotations

from typing import Final

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
