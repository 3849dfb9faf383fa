"""Gets a lost bus back: tried anew twice a second for as long as it takes.  Standard library alone."""

from __future__ import annotations

from typing import Final

from can_dbc.bus.base import Bus, BusState

GONE_NS: Final = 200_000_000
"""A link is down for this long before it is tried anew."""
RETRY_NS: Final = 500_000_000


class LostLink:
    """Watches one bus; every process that shall outlive its link has one."""

    __slots__ = ("_bus", "_try_ns")

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._try_ns = 0

    def watch(self, now_ns: int) -> None:
        """Call it once a cycle; cheap while the bus is there."""
        if self._bus.stats.state is not BusState.DOWN:
            self._try_ns = 0
        elif not self._try_ns:
            self._try_ns = now_ns + GONE_NS
        elif now_ns >= self._try_ns:
            self._bus.reopen()
            self._try_ns = now_ns + RETRY_NS
