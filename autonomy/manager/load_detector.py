"""Whether something hangs in the grapple, by what the crane's scale feels.

A crane that slows its lift down makes what hangs there light, and one that speeds up makes an empty grapple heavy, for
the grapple itself weighs more than a log: only an average over both says anything.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import fmean
from typing import Final

from autonomy.manager.tally import volume_m3
from autonomy.perception.log_list.observation import LogObservation

FEELING_NS: Final = 2_000_000_000
"""As long as a lift takes from its start to its stop (measured on the plant: at the longest arm one second of either
alone reads 110 or 20 kg for 90).
"""
FELT_KG: Final = 30.0
"""What logs weigh at least on the average; friction of the lift looks like half."""
FELT_SHARE: Final = 0.3
"""Of light logs only so much of their weight, ..."""
GREEN_KG_M3: Final = 900.0
"""... fresh from the stump (birch 850 to 950, `docs/reference/machines.md`)."""


class Scale:
    """One grasp, from when it closed; ``feel`` is told every report."""

    def __init__(self, logs: Sequence[LogObservation]) -> None:
        weight_kg = GREEN_KG_M3 * sum(volume_m3(log.length_m, log.diameter_m) for log in logs)
        self._least_kg = min(FELT_KG, FELT_SHARE * weight_kg)
        self._felt: deque[tuple[int, float]] = deque()

    def feel(self, stamp_ns: int, load_kg: float) -> None:
        """Take in a load [kg], NaN where nobody weighs."""
        felt = self._felt
        if math.isfinite(load_kg) and not (felt and felt[-1][0] >= stamp_ns):
            felt.append((stamp_ns, load_kg))
        while felt and felt[-1][0] - felt[0][0] > FEELING_NS:
            felt.popleft()

    @property
    def light(self) -> bool:
        """Whether too little was felt for such logs, for long enough to say so."""
        felt = self._felt
        long_enough = len(felt) > 1 and 1.1 * (felt[-1][0] - felt[0][0]) >= FEELING_NS
        return long_enough and fmean(kg for _, kg in felt) < self._least_kg
