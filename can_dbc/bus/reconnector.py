"""Restores a lost bus: tries twice a second until it is back.  Standard library only."""

from __future__ import annotations

from typing import Final

from can_dbc.bus.base import Bus, BusState

FIRST_RETRY_NS: Final = 200_000_000
"""Time from the loss of a link to the first attempt."""
RETRY_PERIOD_NS: Final = 500_000_000
_DOWN: Final = BusState.DOWN


class Reconnector:
    """Watches one bus, for a process that survives the loss of its link."""

    __slots__ = ("_bus", "_try_ns")

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._try_ns = 0

    def watch(self, now_ns: int) -> None:
        """Watch the bus; to be called once per cycle, cheap while the bus is up."""
        if self._bus.stats.state is not _DOWN:
            self._try_ns = 0
        elif not self._try_ns:
            self._try_ns = now_ns + FIRST_RETRY_NS
        elif now_ns >= self._try_ns:
            self._bus.reopen()
            self._try_ns = now_ns + RETRY_PERIOD_NS
