"""Logs that fell off the machine, told by a camera that only looks ahead.

Such a camera sees neither the bunk nor what falls beside it.  But it has seen the ground before the machine drove over
it: a log that lies where the loaded bunk has been, and that was not mapped when the machine stood there, was not there.
On the next lap it is seen, and it came from the load.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.manager.log_map import MappedLog
from autonomy.perception.camera.frame import Pose
from machine.profile import Bunk

STEP_M: Final = 0.5
"""The bunk's place is kept every so often on the way, ..."""
MAX_PLACES: Final = 4000
"""... for the last two kilometres."""
BESIDE_M: Final = 0.9
"""A log that falls over the stakes comes to rest at most this far beside them: its own length stands in the way of
rolling on.  Logs to be loaded lie farther out: the machine's wheels must pass between them."""
BEHIND_M: Final = 1.2
MIN_HITS: Final = 4
"""Pictures that must show a log: this often in its place, it is no shadow."""


@dataclass(frozen=True, slots=True)
class _Place:
    """The middle and direction (2,) of the bunk in the plane, and the first number that no log had then."""

    middle_m: np.ndarray
    along: np.ndarray
    next_number: int


class FallenLogs:
    """Where the loaded bunk has been; call `passes` on the way, and `fallen` with the logs on the map."""

    def __init__(self, bunk: Bunk) -> None:
        self._bunk = bunk
        self._half_m = (0.5 * bunk.length_m + BEHIND_M, 0.5 * bunk.width_m + BESIDE_M)
        self._places: deque[_Place] = deque(maxlen=MAX_PLACES)
        self._known: set[int] = set()
        """Logs that were told as fallen."""

    def passes(self, base: Pose, next_number: int) -> None:
        """The loaded machine is here; ``next_number`` is the first one that no mapped log has."""
        x, y = self._bunk.center_m
        middle = base.to_base(np.array([x, y, 0.0]))[:2]
        if self._places and math.dist(middle, self._places[-1].middle_m) < STEP_M:
            return
        c, s = math.cos(self._bunk.yaw_rad), math.sin(self._bunk.yaw_rad)
        along = (base.rotation @ np.array([c, s, 0.0]))[:2]
        self._places.append(_Place(middle, along / np.linalg.norm(along), next_number))

    def fallen(self, logs: Iterable[MappedLog]) -> list[MappedLog]:
        """The logs that have fallen off, each once."""
        found = [log for log in logs if log.hits >= MIN_HITS and log.number not in self._known and self._fell(log)]
        self._known |= {log.number for log in found}
        return found

    def forget(self) -> None:
        """The bunk is empty."""
        self._places.clear()

    def _fell(self, log: MappedLog) -> bool:
        return any(log.number >= place.next_number and self._is_near(place, log) for place in self._places)

    def _is_near(self, place: _Place, log: MappedLog) -> bool:
        off = log.center_m[:2] - place.middle_m
        along = float(off @ place.along)
        return abs(along) < self._half_m[0] and math.sqrt(max(0.0, float(off @ off) - along**2)) < self._half_m[1]
