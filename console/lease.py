"""The control lease: which one page may command the machine now.  Pure.

A page takes it on purpose, and keeps it while it shows signs of life; without one for `LEASE_NS` nobody has it.
Whoever takes it from another names the page that has it, so that a click on an outdated display takes nothing.
"""

from __future__ import annotations

from typing import Final

LEASE_NS: Final = 4_000_000_000
"""So long the lease outlives its page: enough to go from one page of the console to another."""


class ControlLease:
    """Pages are known by their numbers; 0 is no page."""

    def __init__(self) -> None:
        self._page = 0
        self._heard_ns = 0

    def holder(self, now_ns: int) -> int:
        """The page that has the lease."""
        if self._page and now_ns - self._heard_ns >= LEASE_NS:
            self._page = 0
        return self._page

    def take(self, page: int, over: int, now_ns: int) -> bool:
        """``page`` takes the lease, from nobody or from the page ``over``; whether it has it now."""
        holder = self.holder(now_ns)
        if holder not in (0, page, over):
            return False
        self._page, self._heard_ns = page, now_ns
        return True

    def renew(self, page: int, now_ns: int) -> None:
        """A sign of life of a page; it revives no lease that has ended."""
        if page and self.holder(now_ns) == page:
            self._heard_ns = now_ns

    def give_back(self, page: int, now_ns: int) -> None:
        """The page does not need it any more."""
        if self.holder(now_ns) == page:
            self._page = 0
