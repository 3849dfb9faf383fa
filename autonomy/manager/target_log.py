"""The log that the machine drives to: where to stop for it, and whether the crane's base has passed it."""

from __future__ import annotations

from typing import Final

from autonomy.manager.load_bookkeeping import LoadBookkeeping
from autonomy.manager.log_map import MappedLog
from autonomy.manager.route_driver import RouteDriver
from autonomy.manager.world_model import BRAKING_M, CLEARING_M, WorldModel

COMMIT_M: Final = 2.5
"""A stop no farther ahead than this is final."""
PLANNING_PERIOD_NS: Final = 200_000_000
"""Period at which the next stop is planned."""
AVERAGED_HITS: Final = 2
"""Observations after which a log's position counts as averaged."""


class TargetLog:
    """``number`` is the map's, None without a target; ``stop_m`` is where to stop for it along the route."""

    def __init__(self, world: WorldModel, route: RouteDriver, load: LoadBookkeeping) -> None:
        self.number: int | None = None
        self.stop_m = 0.0
        self._world, self._route, self._load = world, route, load
        self._was_inside = False
        self._weighed_ns = 0
        self.clearing: int | None = None
        """Map number of the log that is taken out of the way of the wheels; None without one."""
        self._stopped_for: set[int] = set()

    @property
    def log(self) -> MappedLog | None:
        """The mapped target; None without one, or when it is no longer mapped."""
        return None if self.number is None else self._world.log_map.get(self.number)

    def clear(self) -> None:
        """Drop the target and search for another one."""
        self.number, self.clearing, self._was_inside = None, None, False

    @property
    def is_ahead(self) -> bool:
        """Whether the front camera can see the target; it cannot see beside the machine."""
        return self.number is not None and not self._world.is_in_circle(self.log)

    def restart_average(self) -> None:
        """Restart the average of the target's position."""
        assert self.number is not None
        self._world.log_map.restart_average(self.number)

    def is_near(self, now_ns: int) -> bool:
        """Tell whether to stop for a log: paper B stops for the nearest one, ours when the best stop is close.  With a
        full bunk the machine does not stop.
        """
        if self._load.full:
            return False
        if self._route.as_paper_b:
            log = self._world.nearest_candidate()
            self.number = None if log is None else log.number
            return log is not None
        if now_ns - self._weighed_ns < PLANNING_PERIOD_NS:
            return False
        self._weighed_ns = now_ns
        along = self._route.along_m
        stop = self._world.next_stop(self._route.base_at, along, self._route.length_m)
        if stop is None or stop.along_m > along + COMMIT_M:
            return False
        self.stop_m, self.number = stop.along_m, stop.numbers[0]
        return True

    def is_in_the_way(self) -> bool:
        """Tell whether to stop for a log before a wheel, because the crane can load it; once for each log."""
        log = self._world.log_before_wheel(BRAKING_M + CLEARING_M)
        if log is None or log.number in self._stopped_for or self._load.full or not self._world.can_clear(log):
            return False
        self._stopped_for.add(log.number)
        self.number = self.clearing = log.number
        return True

    @property
    def averaged(self) -> bool:
        """Whether the target was observed often enough."""
        log = self.log
        return log is not None and log.hits >= AVERAGED_HITS

    def came_inside(self) -> bool:
        """Tell whether the crane's base is, or was, in the circle round the target."""
        self._was_inside = self._was_inside or self._world.is_in_circle(self.log)
        return self._was_inside

    def is_past(self) -> bool:
        """Tell whether the crane's base has left the circle on the far side."""
        return self._world.has_passed(self.log)

    def is_graspable(self) -> bool:
        """Tell whether a log can be grasped from here: for paper B only the target, for ours any log in the list."""
        if self.clearing is not None and not self._load.full:
            log = self._world.log_map.get(self.clearing)
            if log is not None and self._world.list_number(log.number) is not None and self._world.can_clear(log):
                self.number = log.number
                return True
            self.clearing = None
        graspable_logs = (
            [] if self._load.full else self._world.graspable(self.number if self._route.as_paper_b else None)
        )
        if graspable_logs:
            self.number = graspable_logs[0].number
        return bool(graspable_logs)

    def record_unreachable(self) -> None:
        """Count a failure for a log that proves out of reach, so that the machine does not stop for it forever."""
        if self.number is not None and not self._load.full:
            self._world.record_miss(self.number)
