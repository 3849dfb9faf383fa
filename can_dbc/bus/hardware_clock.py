"""When a frame came in, from the kernel's two stamps: that of its receive interrupt and that of the adapter.

The software stamp is on the system's clock and late by the latency of the interrupt, never early.  A hardware stamp is
exact but on the adapter's own clock, which starts anywhere and drifts.  `HardwareClock` puts the second on the scale
of the first: their difference is smallest for the frame whose interrupt came quickest.
"""

from __future__ import annotations

from typing import Final

DRIFT_PPM: Final = 200
"""Two cheap quartz oscillators apart; the offset may grow this fast, so that it follows a slow adapter clock."""
_JUMP_NS: Final = 100_000_000


class HardwareClock:
    """Follows one adapter's clock.  The result is never later than the software stamp and never runs back."""

    __slots__ = ("_last_ns", "_offset_ns", "_seen_ns")

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._seen_ns = self._last_ns = 0

    def stamp_ns(self, hardware_ns: int, software_ns: int) -> int:
        """The time [ns] on the clock of `software_ns` of a frame that bears both stamps."""
        latency_ns = software_ns - hardware_ns
        offset_ns = self._offset_ns
        elapsed_ns = hardware_ns - self._seen_ns
        if offset_ns is not None:
            offset_ns -= -elapsed_ns * DRIFT_PPM // 1_000_000  # upwards: many short gaps must not lose their drift
        if offset_ns is None or elapsed_ns < 0 or not 0 <= latency_ns - offset_ns < _JUMP_NS:
            offset_ns = latency_ns  # quicker than ever, or one of the two clocks was set
        self._offset_ns, self._seen_ns = offset_ns, hardware_ns
        self._last_ns = stamp_ns = min(max(hardware_ns + offset_ns, self._last_ns), software_ns)
        return stamp_ns
