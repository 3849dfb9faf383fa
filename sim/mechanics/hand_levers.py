"""The hand levers on the valve block and in the cab: they move a machine whose controller is silent.

A pulled lever acts for 0.3 s and must be pulled again, as a hand that holds it would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

LEVER_HOLD_NS: Final = 300_000_000
DRIVE: Final = "drive"


class HandLevers:
    """Levers of the functions, and ``DRIVE`` where the machine can drive.  Positions are -1..1."""

    def __init__(self, functions: Sequence[str], drives: bool) -> None:
        self.names = (*functions, DRIVE) if drives else tuple(functions)
        self._until_ns = dict.fromkeys(self.names, 0)
        self._at = dict.fromkeys(self.names, 0.0)

    def pull(self, name: str, value: float, now_ns: int) -> None:
        """Hold a lever at ``value`` from now on; ValueError for a lever or a position that does not exist."""
        if name not in self._at:
            raise ValueError(f"no lever is called {name!r}; there are {', '.join(self.names)}")
        if not math.isfinite(value) or abs(value) > 1.0:
            raise ValueError(f"a lever stands between -1 and 1, not at {value}")
        self._at[name], self._until_ns[name] = value, now_ns + LEVER_HOLD_NS

    def held(self, now_ns: int) -> dict[str, float]:
        """The levers that are out of neutral now."""
        return {n: v for n, v in self._at.items() if v and now_ns < self._until_ns[n]}
