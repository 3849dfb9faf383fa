"""The transition tables as a documentation page: Mermaid state diagrams and tables of states and events."""

from __future__ import annotations

from collections import defaultdict
from typing import Final

from autonomy.manager.transition_table import (
    EVENT_DESCRIPTIONS,
    FINAL_STATES,
    OURS,
    PAPER_B,
    RULES,
    Height,
    State,
    Table,
)

TITLES: Final = {"Paper B (its Fig. 8)": PAPER_B, "Ours": OURS}
INTRODUCTION: Final = (
    "The tables in `autonomy/manager/transition_table.py` define what the forwarder does next. `timberhand mission "
    "states --docs docs` generates this page from them. A transition that is not in a table cannot happen. A state "
    "that exceeds its timeout fails the mission with its reason, unless the table has a transition for the timeout. "
    "When the controller stops, faults or falls silent, every state pauses; once it is armed again, the state is "
    "entered again."
)


def page() -> str:
    """Return the whole page as Markdown."""
    parts = ["# The activity manager", "", INTRODUCTION, ""]
    for title, table in TITLES.items():
        parts += [f"## {title}", "", "```mermaid", diagram(table), "```", ""]
    parts += ["## States", "", *states(), "", "## Events", "", *events(), ""]
    return "\n".join(parts)


def diagram(table: Table) -> str:
    """Draw a Mermaid state diagram; events between the same two states share an arrow."""
    arrows: dict[tuple[State, State], list[str]] = defaultdict(list)
    for (begin, event), end in sorted(table.items()):
        arrows[begin, end].append(event.name.lower().replace("_", " "))
    lines = ["stateDiagram-v2", f"    [*] --> {State.IDLE.name}"]
    lines += [f"    {a.name} --> {b.name} : {', '.join(names)}" for (a, b), names in arrows.items()]
    lines += [f"    {end.name} --> [*]" for end in sorted(FINAL_STATES & set(table.values()))]
    return "\n".join(lines)


def states() -> list[str]:
    """Return the table of states."""
    rows = ["| state | the machine | frame | timeout | reason after the timeout |", "|---|---|---|---|---|"]
    heights = {Height.KEEP: "as it is", Height.TRANSPORT: "transport", Height.LOADING: "loading"}
    for state, rule in RULES.items():
        timeout = "–" if rule.timeout_s == float("inf") else f"{rule.timeout_s:.0f} s"
        timeout += " without progress" if rule.drives else ""
        cells = (state.name, rule.description, heights[rule.height], timeout, rule.timeout_reason or "–")
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def events() -> list[str]:
    """Return the table of events."""
    return [
        "| event | meaning |",
        "|---|---|",
        *(f"| {e.name} | {description} |" for e, description in EVENT_DESCRIPTIONS.items()),
    ]
