"""Detects from the crane scale whether logs hang in the grapple.

Acceleration falsifies the reading: a lift that slows down reads too little, and an empty grapple that speeds up reads
too much, because it weighs more than a log.  Only an average over the whole lift is reliable.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import fmean
from typing import Final

from autonomy.manager.tally import volume_m3
from autonomy.perception.log_list.observation import LogObservation

WINDOW_NS: Final = 2_000_000_000
"""Duration of a lift from start to stop (measured on the plant: at full reach, one second of either half alone reads
110 or 20 kg for 90).
"""
MIN_LOAD_KG: Final = 30.0
"""Least mean reading of a loaded grapple; friction of the lift reads about half."""
MIN_LOAD_SHARE: Final = 0.3
"""Of light logs this share of their weight is enough, ..."""
GREEN_KG_M3: Final = 900.0
"""... with the density of green wood (birch 850 to 950, `docs/reference/machines.md`)."""


class LoadDetector:
    """The load of one grasp from the time it closed; ``update`` accepts every report."""

    def __init__(self, logs: Sequence[LogObservation]) -> None:
        weight_kg = GREEN_KG_M3 * sum(volume_m3(log.length_m, log.diameter_m) for log in logs)
        self._min_load_kg = min(MIN_LOAD_KG, MIN_LOAD_SHARE * weight_kg)
        self._readings: deque[tuple[int, float]] = deque()

    def update(self, stamp_ns: int, load_kg: float) -> None:
        """Accept a load reading [kg]; NaN without a scale."""
        readings = self._readings
        if math.isfinite(load_kg) and not (readings and readings[-1][0] >= stamp_ns):
            readings.append((stamp_ns, load_kg))
        while readings and readings[-1][0] - readings[0][0] > WINDOW_NS:
            readings.popleft()

    @property
    def is_empty(self) -> bool:
        """Whether the mean reading is too small for the logs, over a long enough time."""
        readings = self._readings
        long_enough = len(readings) > 1 and 1.1 * (readings[-1][0] - readings[0][0]) >= WINDOW_NS
        return long_enough and fmean(kg for _, kg in readings) < self._min_load_kg
