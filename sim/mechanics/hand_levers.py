"""The hand levers on the valve block and in the cab: they move a machine whose controller is silent.

A pulled lever acts for 0.3 s; holding it takes repeated pulls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from sim.errors import PlantError

LEVER_HOLD_NS: Final = 300_000_000
DRIVE: Final = "drive"


class HandLevers:
    """Levers of the functions, and ``DRIVE`` on a machine that drives.  Positions are -1..1."""

    def __init__(self, functions: Sequence[str], drives: bool) -> None:
        self.names = (*functions, DRIVE) if drives else tuple(functions)
        self._until_ns = dict.fromkeys(self.names, 0)
        self._at = dict.fromkeys(self.names, 0.0)

    def pull(self, name: str, value: float, now_ns: int) -> None:
        """Hold a lever at ``value`` for LEVER_HOLD_NS.

        Raises:
            PlantError: there is no such lever, or the position is outside -1..1.
        """
        if name not in self._at:
            raise PlantError("lever.unknown", f"there is no lever {name!r}; use one of {', '.join(self.names)}")
        if not math.isfinite(value) or abs(value) > 1.0:
            raise PlantError("lever.out-of-range", f"lever position {value} is outside -1..1")
        self._at[name], self._until_ns[name] = value, now_ns + LEVER_HOLD_NS

    def held(self, now_ns: int) -> dict[str, float]:
        """Return the levers that are out of neutral now."""
        return {n: v for n, v in self._at.items() if v and now_ns < self._until_ns[n]}
