"""The pages that watch the machine: which heartbeats go on to the controller, and when the watch ends.  Pure.

An open page that may command answers the state that it receives several times a second; each answer is a heartbeat of
its browser, stamped with the time at which that state left.  So a cut network ends the heartbeats although this server
runs on, and answers that waited in a slow one are as old as they are.  A page that is closed on purpose says so; it
ends the watch unless another page is open, or has fallen silent so lately that its loss is still to be seen.
"""

from __future__ import annotations

import re
from collections import deque
from typing import Final

from can_dbc.messages.crane import WATCH_PERIOD_NS

MIN_BEAT_NS: Final = WATCH_PERIOD_NS * 3 // 4
"""However many pages are open, the controller gets no more heartbeats than about one page's."""
CLOSED_PAGES: Final = 16
FRESH_NS: Final = 1_000_000_000
_PAGE: Final = re.compile(r"[0-9a-z-]{1,32}")
_ANSWER: Final = re.compile(r"([0-9a-z-]{1,32}) ([0-9]{1,15})")
"""The name that a page gave itself, and the ``sent_ms`` of the state that it answers."""


class PageWatch:
    """``limit_ns``: so long a silent page counts as open; 0: the profile watches no link."""

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._heard_ns: dict[str, int] = {}
        self._closed: deque[str] = deque(maxlen=CLOSED_PAGES)
        self._beat_ns = -MIN_BEAT_NS

    def beat(self, answer: str, now_ns: int) -> int | None:
        """The answer of a page: the stamp of the heartbeat that is to be sent to the controller now, None for none.

        Nothing counts that is older than the limit, or was on its way while its page closed.
        """
        found = _ANSWER.fullmatch(answer)
        if found is None:
            return None
        page, left_ns = found[1], int(found[2]) * 1_000_000
        if page in self._closed or not 0 <= now_ns - left_ns < self._limit_ns:
            return None
        self._forget(now_ns)
        self._heard_ns[page] = now_ns
        if left_ns - self._beat_ns < MIN_BEAT_NS:
            return None
        self._beat_ns = left_ns
        return left_ns

    def is_fresh(self, answer: str, now_ns: int) -> bool:
        """Whether this is a page's answer to a state that left less than `FRESH_NS` ago."""
        found = _ANSWER.fullmatch(answer)
        return found is not None and 0 <= now_ns - int(found[2]) * 1_000_000 < FRESH_NS

    def end(self, page: str, now_ns: int) -> bool:
        """A page closes on purpose; whether the watch ends with it."""
        if not self._limit_ns or not _PAGE.fullmatch(page):
            return False
        self._forget(now_ns)
        self._heard_ns.pop(page, None)
        self._closed.append(page)
        return not self._heard_ns

    def _forget(self, now_ns: int) -> None:
        """Pages that have been silent for the limit: the controller has held by now, or another page watches."""
        for page in [p for p, heard_ns in self._heard_ns.items() if now_ns - heard_ns >= self._limit_ns]:
            del self._heard_ns[page]
