"""Analysis of a decaying oscillation: frequency from zero crossings, damping from peaks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple


class Ringing(NamedTuple):
    """Frequency [Hz], damping ratio, first peak-to-peak value in the unit of the signal, number of half swings."""

    hz: float
    zeta: float
    peak_to_peak: float
    half_swings: int


def ringing(values: Sequence[float], step_s: float, floor: float, rest: float | None = None) -> Ringing:
    """The oscillation of ``values`` about ``rest`` (default: the mean of the last quarter).

    Half swings smaller than ``floor`` and all later ones are ignored.  Fewer than three half swings: all NaN.
    """
    tail = values[3 * len(values) // 4 :]
    middle = sum(tail) / len(tail) if rest is None else rest
    y = [v - middle for v in values]
    crossings = [i + a / (a - b) for i, (a, b) in enumerate(pairwise(y)) if (a < 0.0) != (b < 0.0)]
    peaks: list[float] = []
    for start, end in pairwise(crossings):
        peak = max(abs(v) for v in y[math.ceil(start) : math.floor(end) + 1])
        if peak < floor:
            break
        peaks.append(peak)
    n = len(peaks)
    if n < 3:
        return Ringing(math.nan, math.nan, math.nan, n)
    half_s = (crossings[n] - crossings[0]) / n * step_s
    logs, mean_i = [math.log(p) for p in peaks], (n - 1) / 2
    slope = sum((i - mean_i) * v for i, v in enumerate(logs)) / sum((i - mean_i) ** 2 for i in range(n))
    decrement = -slope  # per half swing: pi zeta / sqrt(1 - zeta^2)
    zeta = decrement / math.hypot(math.pi, decrement)
    return Ringing(0.5 / half_s, zeta, peaks[0] + peaks[1], n)
