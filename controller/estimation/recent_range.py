"""The range of a value over the last fraction of a second, in constant time and without memory that grows.

The window is cut into four parts of which each keeps its least and its greatest value, so the range covers between
three quarters of the window and all of it.
"""

from __future__ import annotations

from typing import Final

PARTS: Final = 4


class RecentRange:
    """``low`` and ``high`` of the values of the last ``window_s``."""

    # Attributes of a compiled class hold numbers without an object for each; a list would not.
    __slots__ = (
        "_high_1",
        "_high_2",
        "_high_3",
        "_high_now",
        "_left",
        "_low_1",
        "_low_2",
        "_low_3",
        "_low_now",
        "_older_high",
        "_older_low",
        "_ticks",
        "high",
        "low",
    )

    def __init__(self, window_s: float, period_s: float) -> None:
        self._ticks = max(1, round(window_s / period_s / PARTS))
        self.reset(0.0)

    def reset(self, value: float) -> None:
        """The value has always been this."""
        self._low_now = self._low_1 = self._low_2 = self._low_3 = value
        self._high_now = self._high_1 = self._high_2 = self._high_3 = value
        self._older_low = self._older_high = self.low = self.high = value
        self._left = self._ticks

    def add(self, value: float) -> None:
        """The value of this tick."""
        if self._left == 0:
            self._begin_part(value)
        self._left -= 1
        if value < self._low_now:
            self._low_now = value
        if value > self._high_now:
            self._high_now = value
        self.low = self._low_now if self._low_now < self._older_low else self._older_low
        self.high = self._high_now if self._high_now > self._older_high else self._older_high

    def _begin_part(self, value: float) -> None:
        self._left = self._ticks
        self._low_3, self._low_2, self._low_1, self._low_now = self._low_2, self._low_1, self._low_now, value
        self._high_3, self._high_2, self._high_1, self._high_now = self._high_2, self._high_1, self._high_now, value
        self._older_low = min(self._low_1, self._low_2, self._low_3)
        self._older_high = max(self._high_1, self._high_2, self._high_3)
