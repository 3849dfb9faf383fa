"""Tells from the crane scale which logs hang in the grapple.

Acceleration falsifies the reading: a lift that slows down reads too little, and an empty grapple that speeds up reads
too much, because it weighs more than a log.  Only an average over the whole lift is reliable, and even that is some
15 kg off where the lift cylinder's friction is measured with the load: a thin log cannot be told from none beside a
thick one.  So the logs of a grasp count as gripped unless their weight says otherwise by more than `MISSING_COST`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import product
from statistics import fmean, median
from typing import Final

from autonomy.grasp.weight import green_kg
from autonomy.perception.log_list import LogObservation

WINDOW_NS: Final = 2_000_000_000
"""Duration of a lift from start to stop (measured on the plant: at full reach, one second of either half alone reads
110 or 20 kg for 90).
"""
SETTLED_NS: Final = 3_500_000_000
"""The logs are told apart this long after the lift began: the mean no longer has the beginning in it."""
MIN_LOAD_KG: Final = 30.0
"""Least mean reading of a loaded grapple; friction of the lift reads about half."""
MIN_LOAD_SHARE: Final = 0.3
"""Of light logs this share of their weight is enough."""
SCALE_SIGMA_KG: Final = 15.0
"""1-sigma of a mean reading (`controller.crane.load.LoadEstimator`: friction of some 20 kg at 5 m)."""
UNKNOWN_WOOD_SIGMA, KNOWN_WOOD_SIGMA = 0.20, 0.12
"""Relative 1-sigma of a log's expected weight, by size and density: before and after this wood has been weighed."""
MIN_WEIGHED: Final = 3
"""Single logs that must have been lifted before their wood counts as weighed."""
MAX_WEIGHED: Final = 9
MIN_WEIGHABLE_KG: Final = 60.0
"""Lighter logs tell nothing of the wood: the scale's own error is too large."""
MISSING_COST: Final = 6.0
"""How much better (difference of squared deviations in sigmas) the weight must fit without a log of the grasp, ..."""
EXTRA_COST: Final = 12.0
"""... and with a log beside the grasp that nobody meant to grip."""
MAX_JUDGED: Final = 10
"""Logs of one grasp, and beside it, whose combinations are compared."""


class WoodScale:
    """What the wood of this site weighs by the scale, over what is expected of it: learned from single logs."""

    def __init__(self) -> None:
        self._shares: deque[float] = deque(maxlen=MAX_WEIGHED)

    def learn(self, read_kg: float, wood_kg: float) -> None:
        """Learn from a single log of ``wood_kg`` expected weight that was lifted and read ``read_kg``."""
        if wood_kg >= MIN_WEIGHABLE_KG and math.isfinite(read_kg):
            self._shares.append(read_kg / wood_kg)

    @property
    def share(self) -> float:
        """Reading over expected weight; 1 while too little was weighed."""
        return median(self._shares) if len(self._shares) >= MIN_WEIGHED else 1.0

    @property
    def sigma(self) -> float:
        """Relative 1-sigma of an expected weight."""
        return KNOWN_WOOD_SIGMA if len(self._shares) >= MIN_WEIGHED else UNKNOWN_WOOD_SIGMA


def gripped_by_weight(
    read_kg: float, meant_kg: Mapping[int, float], beside_kg: Mapping[int, float], wood: WoodScale
) -> frozenset[int]:
    """Find the logs that a reading is explained by best: those of a grasp, ``meant_kg``, less some, plus some that lie
    beside it; expected weights by number.  At least one log is gripped.
    """
    kg = dict(list({**meant_kg, **beside_kg}.items())[:MAX_JUDGED])
    best, least = frozenset(meant_kg), math.inf
    for chosen in product((True, False), repeat=len(kg)):
        held = frozenset(number for number, inside in zip(kg, chosen, strict=True) if inside)
        if not held:
            continue
        weight_kg = wood.share * sum(kg[number] for number in held)
        # Lengths and diameters are measured log by log: their errors are independent.
        sigma_kg = math.hypot(SCALE_SIGMA_KG, *(wood.sigma * wood.share * kg[number] for number in held))
        off = (read_kg - weight_kg) / sigma_kg
        missing, extra = len(meant_kg.keys() - held), len(held - meant_kg.keys())
        cost = off * off + 2.0 * math.log(sigma_kg) + MISSING_COST * missing + EXTRA_COST * extra
        if cost < least:
            best, least = held, cost
    return best


class LoadDetector:
    """The load of one grasp from the time it closed; ``update`` accepts every report.

    ``beside`` are logs so near to the grasp that the jaws may have closed on them, too.
    """

    def __init__(
        self, logs: Sequence[LogObservation], beside: Sequence[LogObservation] = (), wood: WoodScale | None = None
    ) -> None:
        self._meant_kg = {log.id: green_kg(log) for log in logs}
        self._beside_kg = {log.id: green_kg(log) for log in beside}
        self._wood = wood or WoodScale()
        self._min_load_kg = min(MIN_LOAD_KG, MIN_LOAD_SHARE * sum(self._meant_kg.values()))
        self._readings: deque[tuple[int, float]] = deque()
        self._first_ns: int | None = None

    def update(self, stamp_ns: int, load_kg: float) -> None:
        """Accept a load reading [kg]; NaN without a scale."""
        readings = self._readings
        if math.isfinite(load_kg) and not (readings and readings[-1][0] >= stamp_ns):
            readings.append((stamp_ns, load_kg))
            self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        while readings and readings[-1][0] - readings[0][0] > WINDOW_NS:
            readings.popleft()

    @property
    def read_kg(self) -> float:
        """The mean reading over a long enough time; NaN while there is none."""
        readings = self._readings
        long_enough = len(readings) > 1 and 1.1 * (readings[-1][0] - readings[0][0]) >= WINDOW_NS
        return fmean(kg for _, kg in readings) if long_enough else math.nan

    @property
    def is_empty(self) -> bool:
        """Whether the mean reading is too small for the logs, over a long enough time."""
        return self.read_kg < self._min_load_kg

    @property
    def is_weighed(self) -> bool:
        """Whether the mean reading is that of a load that hangs steadily."""
        readings = self._readings
        return self._first_ns is not None and readings[-1][0] - self._first_ns >= SETTLED_NS

    @property
    def gripped(self) -> frozenset[int]:
        """The numbers of the logs in the grapple by their weight; those of the grasp while it is unknown."""
        if not self.is_weighed or not math.isfinite(self.read_kg) or len(self._meant_kg) + len(self._beside_kg) == 1:
            return frozenset(self._meant_kg)
        return gripped_by_weight(self.read_kg, self._meant_kg, self._beside_kg, self._wood)

    def learn(self) -> None:
        """Learn what this wood weighs, if the load is that of one log and nothing lay beside it."""
        if self.is_weighed and len(self._meant_kg) == 1 and not self._beside_kg:
            self._wood.learn(self.read_kg, sum(self._meant_kg.values()))
