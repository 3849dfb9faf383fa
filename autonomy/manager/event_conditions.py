"""Whether what a state waits for has come about, or it takes too long.

The table says which events a state reacts to; here is what tells each of them.  To ask for one that ends a job of the
crane takes that job's outcome into account, so an event is asked for once a turn.
"""

from __future__ import annotations

from typing import Final

from autonomy.manager.load_bookkeeping import Cargo
from autonomy.manager.crane_executor import Hand
from autonomy.manager.route_driver import Ride
from autonomy.manager.transition_table import Event, Rule
from autonomy.manager.target_log import Target
from autonomy.manager.world_model import Outlook

SECOND: Final = 1_000_000_000
SETTLED_NS: Final = 400_000_000
"""What stands or is at its height has been so for this long."""
HOLD_NS: Final = 3 * SECOND
"""Paper B's hold time: so long the log is watched at standstill."""
PROGRESS_M: Final = 0.2


class Events:
    """Those of the machine and of the logs, in the state that began last; the operator's are the manager's."""

    def __init__(self, outlook: Outlook, ride: Ride, cargo: Cargo, target: Target, hand: Hand) -> None:
        self._outlook, self._ride, self._cargo, self._target, self._hand = outlook, ride, cargo, target, hand
        self._height_m = self._progress_m = 0.0
        self._since_ns = self._settled_ns = self._progress_ns = 0

    def begin(self, now_ns: int, height_m: float) -> None:
        """A state begins, or begins anew; the swing arms are to be at this height."""
        self._since_ns, self._settled_ns, self._progress_ns = now_ns, 0, now_ns
        self._height_m, self._progress_m = height_m, self._ride.driven_m

    def has(self, event: Event, now_ns: int) -> bool:
        """Whether an event has come about."""
        match event:
            case Event.AT_HEIGHT:
                return self._settled(self._outlook.at_height(self._height_m), now_ns)
            case Event.STANDING:
                return self._settled(self._outlook.stands(), now_ns)
            case Event.ARRIVED:
                return self._settled(self._ride.arrived, now_ns)
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
                looked = self._outlook.list_ns > self._since_ns
                return looked and self._target.is_takable() == (event is Event.VALID)
            case Event.COLLECTED:
                return self._hand.collected(now_ns)
            case Event.MISSED:
                return self._hand.missed(self._target.number)
            case Event.LOADED:
                return self._cargo.loaded and (self._cargo.full or self._ride.ended)
            case Event.EMPTY:
                return self._emptied(now_ns)
            case Event.STOWED:
                return self._hand.stowed()
            case Event.ROUND_END:
                return self._ride.ended and self._cargo.another_round
            case Event.ROUTE_END:
                return self._ride.ended or self._cargo.enough
        return False

    def late(self, rule: Rule, now_ns: int) -> bool:
        """Whether a state takes too long: driving counts from the last progress."""
        if self._ride.driven_m > self._progress_m + PROGRESS_M:
            self._progress_m, self._progress_ns = self._ride.driven_m, now_ns
        begun = max(self._since_ns, self._progress_ns) if rule.drives else self._since_ns
        return now_ns - begun > rule.patience_s * SECOND

    def _settled(self, so: bool, now_ns: int) -> bool:
        """Whether something has been so for ``SETTLED_NS``."""
        self._settled_ns = (self._settled_ns or now_ns) if so else 0
        return so and now_ns - self._settled_ns >= SETTLED_NS

    def _emptied(self, now_ns: int) -> bool:
        """Whether nothing is left in the bunk; while there is, the next grasp begins."""
        if self._hand.unloaded():
            self._since_ns = now_ns
        if self._hand.trouble or self._hand.job is not None or self._outlook.counted_ns <= self._since_ns:
            return False
        if self._outlook.in_bunk:
            self._hand.unload()
            return False
        self._cargo.emptied(now_ns, self._ride.driven_m)
        return True
