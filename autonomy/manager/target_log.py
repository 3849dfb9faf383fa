"""The log that the machine is about: what it stops for and where, whether the crane's foot comes by, what it takes."""

from __future__ import annotations

from typing import Final

from autonomy.manager.load_bookkeeping import Cargo
from autonomy.manager.log_map import FieldLog
from autonomy.manager.route_driver import Ride
from autonomy.manager.world_model import Outlook

COMMIT_M: Final = 2.5
"""A stop that is no further ahead is driven to."""
WEIGH_NS: Final = 200_000_000
"""The next stop is thought over so often."""
HITS: Final = 2
"""So often a log is seen before its place counts as averaged."""


class Target:
    """``number`` is the field's, None while there is no target; ``stop_m``: where to stop for it, along the route."""

    def __init__(self, outlook: Outlook, ride: Ride, cargo: Cargo) -> None:
        self.number: int | None = None
        self.stop_m = 0.0
        self._outlook, self._ride, self._cargo = outlook, ride, cargo
        self._was_inside = False
        self._weighed_ns = 0

    @property
    def log(self) -> FieldLog | None:
        """As it is known now; None when it is not, or no longer."""
        return None if self.number is None else self._outlook.field.get(self.number)

    def search(self) -> None:
        """For another."""
        self.number, self._was_inside = None, False

    @property
    def lies_ahead(self) -> bool:
        """Whether it may be looked at: one beside the machine is out of the front camera's sight."""
        return self.number is not None and not self._outlook.in_circle(self.log)

    def look_again(self) -> None:
        """Know its place by what is seen from now on alone."""
        assert self.number is not None
        self._outlook.field.anew(self.number)

    def is_near(self, now_ns: int) -> bool:
        """Paper B stops for the nearest log; we, where the best place to stop is just ahead; full, for none."""
        if self._cargo.full:
            return False
        if self._ride.faithful:
            log = self._outlook.near()
            self.number = None if log is None else log.number
            return log is not None
        if now_ns - self._weighed_ns < WEIGH_NS:
            return False
        self._weighed_ns = now_ns
        along = self._ride.along_m
        stop = self._outlook.stop_ahead(self._ride.base_at, along, self._ride.length_m)
        if stop is None or stop.along_m > along + COMMIT_M:
            return False
        self.stop_m, self.number = stop.along_m, stop.numbers[0]
        return True

    @property
    def averaged(self) -> bool:
        """Whether it was seen often enough for a place."""
        log = self.log
        return log is not None and log.hits >= HITS

    def came_inside(self) -> bool:
        """Whether the crane's foot is in the circle round it, or was."""
        self._was_inside = self._was_inside or self._outlook.in_circle(self.log)
        return self._was_inside

    def is_past(self) -> bool:
        """Whether the crane's foot has left the circle."""
        return self._outlook.past(self.log)

    def is_takable(self) -> bool:
        """Whether a log can be taken from here: paper B checks its target, we all that are seen."""
        found = [] if self._cargo.full else self._outlook.takable(self.number if self._ride.faithful else None)
        if found:
            self.number = found[0].number
        return bool(found)

    def not_takable(self) -> None:
        """It looked better from afar: not again and again."""
        if self.number is not None and not self._cargo.full:
            self._outlook.missed(self.number)
