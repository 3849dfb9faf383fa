"""Delay compensation: what was commanded within the last delay, which a joint or the articulation cannot show yet."""

from __future__ import annotations

from array import array


class DelayCompensation:
    """Travel in flight: the commands of the last delay, which the joint cannot show yet; fixed size."""

    __slots__ = ("_at", "_line", "travel")

    def __init__(self, delay_s: float, period_s: float) -> None:
        self._line = array("d", [0.0] * max(1, round(delay_s / period_s)))
        self.reset()

    def reset(self) -> None:
        """Nothing is in flight."""
        self._at = 0
        self.travel = 0.0
        for i in range(len(self._line)):
            self._line[i] = 0.0

    def add(self, travel: float) -> None:
        """Add one tick's commanded travel; the oldest leaves."""
        line, at = self._line, self._at
        self.travel += travel - line[at]
        line[at] = travel
        self._at = at + 1 if at + 1 < len(line) else 0
