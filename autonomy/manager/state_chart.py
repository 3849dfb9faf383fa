"""The tables as pictures and words for the documentation: a page whose charts are Mermaid state diagrams."""

from __future__ import annotations

from collections import defaultdict
from typing import Final

from autonomy.manager.transition_table import ENDS, EVENTS, OURS, PAPER_B, RULES, Height, State, Table

TITLES: Final = {"Paper B's way (its Fig. 8)": PAPER_B, "Our way": OURS}
INTRODUCTION: Final = (
    "What the forwarder does next is written in tables (`autonomy/manager/transition_table.py`); this page is made from them by "
    "`timberhand mission states --docs docs`. What is not in a table cannot happen. A state that takes longer than its "
    "patience ends the mission with its sentence, unless the table knows a way on. A controller that stops, faults or "
    "falls silent pauses every state; when it is armed again the state begins anew."
)


def page() -> str:
    """The whole page, Markdown."""
    parts = ["# The activity manager", "", INTRODUCTION, ""]
    for title, table in TITLES.items():
        parts += [f"## {title}", "", "```mermaid", diagram(table), "```", ""]
    parts += ["## States", "", *states(), "", "## Events", "", *events(), ""]
    return "\n".join(parts)


def diagram(table: Table) -> str:
    """A state diagram; events that lead from one state to another stand together."""
    arrows: dict[tuple[State, State], list[str]] = defaultdict(list)
    for (begin, event), end in sorted(table.items()):
        arrows[begin, end].append(event.name.lower().replace("_", " "))
    lines = ["stateDiagram-v2", f"    [*] --> {State.IDLE.name}"]
    lines += [f"    {a.name} --> {b.name} : {', '.join(names)}" for (a, b), names in arrows.items()]
    lines += [f"    {end.name} --> [*]" for end in sorted(ENDS & set(table.values()))]
    return "\n".join(lines)


def states() -> list[str]:
    """A table of all states."""
    rows = ["| state | the machine | frame | patience | when it is over |", "|---|---|---|---|---|"]
    heights = {Height.KEEP: "as it is", Height.TRANSPORT: "transport", Height.LOADING: "loading"}
    for state, rule in RULES.items():
        waits = rule.patience_s == float("inf")
        patience = "–" if waits else f"{rule.patience_s:.0f} s" + (" without progress" if rule.drives else "")
        rows.append(f"| {state.name} | {rule.words} | {heights[rule.height]} | {patience} | {rule.trouble or '–'} |")
    return rows


def events() -> list[str]:
    """A table of all events."""
    return ["| event | meaning |", "|---|---|", *(f"| {e.name} | {words} |" for e, words in EVENTS.items())]
