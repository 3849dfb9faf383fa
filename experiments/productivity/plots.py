"""Plot of the productivity experiment: every grasp, phase by phase, and the shortest possible time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments.productivity.metrics import EXPERT_S, KIND_TITLES, Cycle, cycles
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet

COLOURS: Final = {
    "LOOK": STEEL,
    "ABOVE": OIL,
    "DESCEND": "#5b93b8",
    "CLOSE": MOSS,
    "LIFT": "#87a978",
    "CARRY": TIMBER,
    "LOWER": "#c29a6b",
    "OPEN": "#d9c3a5",
    "RETREAT": "#8a6fae",
}
MAX_SHOWN_COUNT: Final = 30


def draw(outcomes: Mapping[str, Any], grapple_s: float, out: Path) -> None:
    """Write the plot into ``out``."""
    groups = {
        title: [c for name, o in outcomes.items() if name.startswith(f"{kind}/") for c in cycles(o, grapple_s)]
        for kind, title in KIND_TITLES.items()
    }
    groups = {title: some[:MAX_SHOWN_COUNT] for title, some in groups.items() if some}
    with sheet(out / "cycles.png", max(1, len(groups)), width=4.2 * max(1, len(groups)), height=4.2) as axes:
        for axis, (title, some) in zip(np.atleast_1d(axes), groups.items(), strict=False):
            _bars(axis, some, title)


def _bars(axis: Any, some: Sequence[Cycle], title: str) -> None:
    named: set[str] = set()
    for row, cycle in enumerate(some):
        begin = 0.0
        for name, seconds in cycle.phases:
            label = None if name in named or name not in COLOURS else name.lower()
            named.add(name)
            axis.barh(row, seconds, left=begin, color=COLOURS.get(name, "#dddddd"), height=0.75, label=label)
            begin += seconds
        axis.plot([cycle.shortest_s] * 2, [row - 0.4, row + 0.4], color="black", lw=1.6)
        if not cycle.good:
            axis.plot(begin + 0.8, row, "x", color=RUST, ms=5)
    axis.axvspan(*EXPERT_S, color=MOSS, alpha=0.12, lw=0)
    axis.set(title=title, xlabel="time [s]", ylabel="grasp", ylim=(len(some) - 0.4, -0.6))
    if named:
        axis.legend(fontsize=7, loc="lower right")
