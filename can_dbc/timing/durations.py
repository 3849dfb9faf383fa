"""A histogram of durations in fixed bins: timing statistics of a real-time loop in constant memory.

Bins are 1 us wide up to 1 ms, 10 us up to 10 ms, 100 us up to 100 ms, and one holds the rest, so a quantile is within
1 us, or within 1 % above 1 ms.  Standard library only.
"""

from __future__ import annotations

from array import array
from typing import Final, Self

_US: Final = 1_000
_FINE_END: Final = 1_000 * _US
_MIDDLE_END: Final = 10_000 * _US
_COARSE_END: Final = 100_000 * _US
_MIDDLE_AT: Final = 1_000
_COARSE_AT: Final = 1_900
_REST: Final = 2_800
BINS: Final = _REST + 1
QUANTILES: Final = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999}


def bin_of(duration_ns: int) -> int:
    """Return the bin of a duration; a negative one counts as 0."""
    if duration_ns < _FINE_END:
        return duration_ns // _US if duration_ns > 0 else 0
    if duration_ns < _MIDDLE_END:
        return _MIDDLE_AT + (duration_ns - _FINE_END) // (10 * _US)
    if duration_ns < _COARSE_END:
        return _COARSE_AT + (duration_ns - _MIDDLE_END) // (100 * _US)
    return _REST


def edge_ns(i: int) -> int:
    """Return the upper edge of bin i; meaningless for the last one (use ``longest_ns``)."""
    if i < _MIDDLE_AT:
        return (i + 1) * _US
    if i < _COARSE_AT:
        return _FINE_END + (i + 1 - _MIDDLE_AT) * 10 * _US
    return _MIDDLE_END + (i + 1 - _COARSE_AT) * 100 * _US


class Durations:
    """A histogram; ``bins`` is an array of `BINS` counts."""

    __slots__ = ("bins", "longest_ns", "total_ns")

    def __init__(self, bins: bytes | None = None, longest_ns: int = 0, total_ns: int = 0) -> None:
        self.bins = array("Q", bytes(8 * BINS) if bins is None else bins)
        self.longest_ns, self.total_ns = longest_ns, total_ns

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        if 0 <= duration_ns < _FINE_END:  # as `bin_of`, without the call: this runs a dozen times per tick
            self.bins[duration_ns // _US] += 1
        else:
            self.bins[bin_of(duration_ns)] += 1
        self.total_ns += duration_ns
        if duration_ns > self.longest_ns:
            self.longest_ns = duration_ns

    @property
    def count(self) -> int:
        """Number of durations."""
        return sum(self.bins)

    def over(self, limit_ns: int) -> int:
        """Count the durations in bins above that of ``limit_ns``."""
        return sum(self.bins[bin_of(limit_ns) + 1 :])

    def periods(self, period_ns: int) -> int:
        """Count the whole periods in the durations: those that a loop skipped if it was late by them."""
        first = bin_of(period_ns)
        within = sum(n * (edge_ns(i - 1) // period_ns) for i, n in enumerate(self.bins[first:_REST], first) if n)
        return within + self.bins[_REST] * (self.longest_ns // period_ns)

    def quantile_ns(self, share: float) -> int:
        """Return the upper edge of the bin at which ``share`` of the durations are reached; 0 if empty."""
        target_count, cumulative_count = share * self.count, 0
        for i, n in enumerate(self.bins):
            cumulative_count += n
            if n and cumulative_count >= target_count:
                return self.longest_ns if i == _REST else min(edge_ns(i), max(self.longest_ns, 0))
        return 0

    def summary(self) -> dict[str, float]:
        """Compute median, p99, p99.9 and longest in microseconds, and the count."""
        quantiles_us = {name: self.quantile_ns(share) / 1000 for name, share in QUANTILES.items()}
        return quantiles_us | {"max_us": self.longest_ns / 1000, "count": self.count}

    def __sub__(self, earlier: Self) -> Durations:
        """Return the durations after ``earlier``, a former state of the same histogram; the longest is a bin's edge."""
        bins = array("Q", [a - b for a, b in zip(self.bins, earlier.bins, strict=True)])
        last = max((i for i, n in enumerate(bins) if n), default=-1)
        longest_ns = 0 if last < 0 else self.longest_ns if last == _REST else min(edge_ns(last), self.longest_ns)
        return Durations(bins.tobytes(), longest_ns, self.total_ns - earlier.total_ns)
