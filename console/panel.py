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
        """Take a message of the page; tell whether it named a panel."""
        match = _CHOICE.fullmatch(text)
        if match is None:
            return False
        self.shown, self._due_ms = match[1], 0
        return True

    def due(self, now_ms: int) -> bool:
        """Tell whether the panel's data are to be sent now."""
        if not self.shown or now_ms < self._due_ms:
            return False
        self._due_ms = now_ms + PERIOD_MS
        return True


def panel_data(shown: str, tap: CanTap, crane_state: CraneState) -> dict[str, Any]:
    """Return the data of the panel that is shown."""
    match shown:
        case "can":
            return {"can": tap.tables()}
        case "ticks":
            return {"ticks": crane_state.histograms()}
        case "faults":
            return {"fault": crane_state.fault_watch.card()}
    return {}


def panels_of(tap: CanTap, timed: bool, faults: bool) -> list[str]:
    """List the panels that this console can fill."""
    available = {
        "error": True,
        "camera": True,
        "timeline": True,
        "can": bool(tap.buses),
        "ticks": timed,
        "faults": faults,
    }
    return [name for name, so in available.items() if so]
