"""The watch on the operator's link: whether a person who supervises the machine still reaches it.

Inputs: the stamps of the heartbeats (WATCH on the operator socket) and of the end of the watch (WATCH_END).  Output:
from when on the link counts as lost.  The first heartbeat begins the watch; without a later one for the profile's
``operator_link_ms`` the link is lost until the next heartbeat, or until the watch ends on purpose.  Several senders
share the one link: it is there while one of them is.  What is stamped no later than what came before, as a repeated
datagram or the slower of two senders, changes nothing.  Without a sender, or with a limit of 0, nothing is watched.  A
tick costs one comparison.
"""

from __future__ import annotations

from typing import Final

from can_dbc.messages.crane import LinkWatch
from machine.profile import Profile

_NEVER_NS: Final = 1 << 61
"""Later than any time, and still an integer that the compiled tick keeps in a register."""


class OperatorLink:
    """``lost_from_ns``: the link is lost at this time and later; ``stamp_ns`` is that of what came last."""

    __slots__ = ("limit_ns", "lost_from_ns", "stamp_ns")

    def __init__(self, profile: Profile) -> None:
        self.limit_ns = profile.timeouts.operator_link_ms * 1_000_000
        self.stamp_ns = 0
        self.lost_from_ns = _NEVER_NS

    def beat(self, stamp_ns: int) -> None:
        """Take a heartbeat that was sent at ``stamp_ns``: its way counts against the link."""
        if self.limit_ns and stamp_ns > self.stamp_ns:
            self.stamp_ns, self.lost_from_ns = stamp_ns, stamp_ns + self.limit_ns

    def end(self, stamp_ns: int) -> None:
        """End the watch as a person did on purpose at ``stamp_ns``."""
        if stamp_ns > self.stamp_ns:
            self.stamp_ns, self.lost_from_ns = stamp_ns, _NEVER_NS

    def state(self, now_ns: int) -> LinkWatch:
        """Tell the state of the link for the state report."""
        if self.lost_from_ns == _NEVER_NS:
            return LinkWatch.OFF
        return LinkWatch.LOST if now_ns >= self.lost_from_ns else LinkWatch.WATCHED
