"""The controller's modes and what moves it from one to another."""

from __future__ import annotations

from controller.transitions import TRANSITIONS, Event
from machine.status.modes import Mode
from timberhand.reference.markdown import generated, table


def page() -> str:
    """docs/reference/transitions.md."""
    events = [event for event in Event if any(known is event for _, known in TRANSITIONS)]
    rows = (
        (
            f"**{mode.name}**",
            *(f"{TRANSITIONS[mode, event].name}" if (mode, event) in TRANSITIONS else "" for event in events),
        )
        for mode in Mode
    )
    head = generated(
        "Modes and transitions",
        "`controller.transitions.TRANSITIONS`",
        "Rows are modes, columns events; a cell is the mode that follows, and an empty cell changes nothing. Only a\n"
        "person's ARM leads from STANDBY or STOP to ARMED. Valves move in ACTIVE, and while a stop ramps down.",
    )
    return head + "\n" + table(("mode", *(event.name for event in events)), rows) + "\n"
