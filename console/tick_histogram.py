"""The histograms of the timing page, coarse enough for a plot: counts between 1, 2 and 5 of each decade.  Pure."""

from __future__ import annotations

from typing import Any, Final

from can_dbc.timing.durations import BINS, edge_ns
from can_dbc.timing.page import Timing

EDGES_US: Final = tuple(step * 10**power for power in range(6) for step in (1, 2, 5))[:16]
"""Upper edges 1 us to 100 ms; what is longer is in one more bar."""
SHOWN: Final = {
    "wake": "wake-up latency",
    "tick": "tick, by the clock",
    "cpu": "tick, processor time",
    "sample_to_command": "sample to command",
}


def _bar_of(i: int) -> int:
    edge_us = edge_ns(i) / 1e3
    return next((bar for bar, edge in enumerate(EDGES_US) if edge_us <= edge), len(EDGES_US))


_BARS: Final = tuple(_bar_of(i) if i < BINS - 1 else len(EDGES_US) for i in range(BINS))


def histograms(timing: Timing) -> dict[str, Any]:
    """Edges [us] and for each measured time its counts, median, 99.9 % and longest [us]."""
    found = []
    for name, words in SHOWN.items():
        durations = timing.durations[name]
        counts = [0] * (len(EDGES_US) + 1)
        for i, n in enumerate(durations.bins):
            if n:
                counts[_BARS[i]] += n
        summary = durations.summary()
        found.append({"name": name, "words": words, "counts": counts, **summary})
    return {"edges_us": list(EDGES_US), "period_us": timing.facts.period_ns / 1e3, "of": found}
