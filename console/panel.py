"""Which panel a page shows: its data go to that page alone, twice a second, and cost nothing while nobody looks.

A page says ``panel NAME`` on its websocket; any other text is not for this module.
"""

from __future__ import annotations

import re
from typing import Any, Final

from console.can_tap import CanTap
from console.state import CraneState

PERIOD_MS: Final = 500
_CHOICE: Final = re.compile(r"panel ([a-z]{1,12})")


class Panel:
    """The panel that one page shows."""

    def __init__(self) -> None:
        self.shown = ""
        self._due_ms = 0

    def choose(self, text: str) -> bool:
        """A message of the page; whether it named a panel."""
        found = _CHOICE.fullmatch(text)
        if found is None:
            return False
        self.shown, self._due_ms = found[1], 0
        return True

    def due(self, now_ms: int) -> bool:
        """Whether the panel's data are to be sent now."""
        if not self.shown or now_ms < self._due_ms:
            return False
        self._due_ms = now_ms + PERIOD_MS
        return True


def panel_data(shown: str, tap: CanTap, crane_state: CraneState) -> dict[str, Any]:
    """The data of the panel that is shown."""
    match shown:
        case "can":
            return {"can": tap.tables()}
        case "ticks":
            return {"ticks": crane_state.histograms()}
        case "faults":
            return {"fault": crane_state.fault_watch.card()}
    return {}


def panels_of(tap: CanTap, timed: bool, faults: bool) -> list[str]:
    """The panels that this console can fill."""
    there = {"error": True, "camera": True, "timeline": True, "can": bool(tap.buses), "ticks": timed, "faults": faults}
    return [name for name, so in there.items() if so]
