"""Ratios of interleaved rounds: their median, its confidence interval, and what that says about a limit."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Final

CONFIDENCE: Final = 0.95


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """The interval that holds the true median with `CONFIDENCE`, between two of the sorted values (sign test).

    No assumption on the distribution, so that single disturbed rounds do not widen it; fewer than six values bound
    nothing and give an infinite interval.
    """
    ordered, n = sorted(values), len(values)
    cut, below = -1, 0.0
    while 2 * (below + math.comb(n, cut + 1) / 2**n) <= 1 - CONFIDENCE:
        cut += 1
        below += math.comb(n, cut) / 2**n
    return (ordered[cut], ordered[n - 1 - cut]) if cut >= 0 else (0.0, math.inf)


def verdict(interval: tuple[float, float], at_least: float) -> str:
    """Whether a ratio reaches a limit: "reached", "missed", or "inconclusive" where the interval holds the limit."""
    if interval[0] >= at_least:
        return "reached"
    return "missed" if interval[1] < at_least else "inconclusive"


def compared(slow: Sequence[float], fast: Sequence[float], at_least: float) -> dict[str, object]:
    """The ratio of two series of the same rounds: median, interval (None without an upper bound), and verdict."""
    ratios = [a / b for a, b in zip(slow, fast, strict=True)]
    low, high = median_interval(ratios)
    return {
        "ratio": round(statistics.median(ratios), 3),
        "low": round(low, 3),
        "high": round(high, 3) if math.isfinite(high) else None,
        "at_least": at_least,
        "verdict": verdict((low, high), at_least),
    }
