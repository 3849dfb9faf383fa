"""Conditions of the manager's events, and the timeouts of its states.

The transition table says which events a state reacts to.  Testing an event that ends a crane job books the result of
that job, so each event is tested once per step.
"""

from __future__ import annotations

from typing import Final

from autonomy.manager.crane_executor import CraneExecutor
from autonomy.manager.load_bookkeeping import LOOKS, LoadBookkeeping
from autonomy.manager.route_driver import RouteDriver
from autonomy.manager.target_log import TargetLog
from autonomy.manager.transition_table import Event, Rule
from autonomy.manager.world_model import WorldModel

SECOND_NS: Final = 1_000_000_000
SETTLED_NS: Final = 400_000_000
"""Standstill and heights must hold for this long."""
HOLD_NS: Final = 3 * SECOND_NS
"""Paper B's hold time: the log is observed at standstill for this long."""
PROGRESS_M: Final = 0.2
"""Distance that counts as progress of a driving state."""


class EventConditions:
    """Conditions of machine and logs in the current state; operator events belong to the manager."""

    def __init__(
        self, world: WorldModel, route: RouteDriver, load: LoadBookkeeping, target: TargetLog, crane: CraneExecutor
    ) -> None:
        self._world, self._route, self._load, self._target, self._crane = world, route, load, target, crane
        self._height_m = self._progress_m = 0.0
        self._since_ns = self._settled_ns = self._progress_ns = 0

    def begin(self, now_ns: int, height_m: float) -> None:
        """Enter a state, or enter it again; ``height_m`` is the requested height of the swing arms."""
        self._since_ns, self._settled_ns, self._progress_ns = now_ns, 0, now_ns
        self._height_m, self._progress_m = height_m, self._route.driven_m

    def has(self, event: Event, now_ns: int) -> bool:
        """Tell whether an event has occurred."""
        match event:
            case Event.AT_HEIGHT:
                return self._settled(self._world.is_at_height(self._height_m), now_ns)
            case Event.STANDING:
                return self._settled(self._world.is_standing(), now_ns)
            case Event.ARRIVED:
                return self._settled(self._route.arrived, now_ns)
            case Event.LOG_NEAR:
                return self._target.is_near(now_ns)
            case Event.AVERAGED:
                return self._target.averaged and now_ns - self._since_ns > HOLD_NS
            case Event.GONE:
                return self._target.log is None
            case Event.INSIDE:
                return self._target.came_inside()
            case Event.OUTSIDE:
                return self._target.is_past()
            case Event.VALID | Event.INVALID:
                detected = self._world.list_ns > self._since_ns
                return detected and self._target.is_graspable() == (event is Event.VALID)
            case Event.COLLECTED:
                return self._crane.collected(now_ns)
            case Event.MISSED:
                return self._crane.missed(now_ns, self._target.number)
            case Event.LOADED:
                return self._load.loaded and (self._load.full or self._route.ended)
            case Event.EMPTY:
                return self._emptied(now_ns)
            case Event.STOWED:
                return self._crane.stowed()
            case Event.ROUND_END:
                return self._route.ended and self._load.needs_another_round
            case Event.IN_THE_WAY:
                return self._target.is_in_the_way()
            case Event.ROUTE_END:
                return self._route.ended or self._load.has_enough
        return False

    def late(self, rule: Rule, now_ns: int) -> bool:
        """Tell whether a state has timed out; for driving states the time counts from the last progress."""
        if self._route.driven_m > self._progress_m + PROGRESS_M:
            self._progress_m, self._progress_ns = self._route.driven_m, now_ns
        begin_ns = max(self._since_ns, self._progress_ns) if rule.drives else self._since_ns
        return now_ns - begin_ns > rule.timeout_s * SECOND_NS

    def _settled(self, so: bool, now_ns: int) -> bool:
        """Tell whether a condition has held for ``SETTLED_NS``."""
        self._settled_ns = (self._settled_ns or now_ns) if so else 0
        return so and now_ns - self._settled_ns >= SETTLED_NS

    def _emptied(self, now_ns: int) -> bool:
        """Tell whether the bunk is empty; start the next grasp while it is not."""
        if self._crane.unloaded():
            self._since_ns = now_ns
        if self._crane.failure or self._crane.job is not None or self._world.counted_ns <= self._since_ns:
            return False
        if self._world.in_bunk:
            self._crane.unload_bunk()
            return False
        if self._world.empty_looks < LOOKS:
            return False
        self._load.book_empty(now_ns, self._route.driven_m)
        return True
