"""Which logs a mission wants, and which landing a load goes to.

Logs of other assortments than the mission's are left.  Without sorting, a load goes to the landing nearest to where the
machine sets out.  With sorting, a load only holds what one landing accepts: the first log on board decides, and logs of
other landings are left until the load is unloaded; then the route is driven again for them.  A round in which nothing
was loaded is the last.  Landings are identified by their index in the mission, from 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from autonomy.missions.model import ForwardingMission
from autonomy.navigation.clothoid_path import Point2


class Sorting:
    """Sorting of one mission.

    ``landing`` is the landing of the load on board, None while undecided; ``served`` are the landings for which logs
    were loaded in this round of the route; ``rounds`` counts finished rounds.
    """

    def __init__(self, mission: ForwardingMission) -> None:
        self.landing: int | None = None
        self.served: set[int] = set()
        self.rounds = 0
        self._only = frozenset(mission.options.assortments)
        self._landings = mission.landings
        self._sorts = mission.options.sort_by_assortment and bool(mission.landings)

    def landing_of(self, assortment: str) -> int | None:
        """Choose the landing of an assortment when sorting: the first that names it, else the first that names none,
        else None.
        """
        named = (i for i, at in enumerate(self._landings) if assortment in at.assortments)
        takes_all = (i for i, at in enumerate(self._landings) if not at.assortments)
        return next(named, next(takes_all, None))

    def wants(self, assortment: str, landing: int | None = None) -> bool:
        """Tell whether such a log belongs to the load on board; ``landing`` is where the load goes while undecided."""
        if self._only and assortment not in self._only:
            return False
        if not self._sorts:
            return True
        goes_to = self.landing_of(assortment)
        bound = landing if self.landing is None else self.landing
        return goes_to is not None and bound in (None, goes_to)

    def may_share_grasp(self, assortment: str, first: str) -> bool:
        """Tell whether such a log may share a grasp with ``first``."""
        return self.wants(assortment, self.landing_of(first) if self._sorts else None)

    def book_loaded(self, assortments: Iterable[str]) -> None:
        """Book assortments that came on board, in order."""
        if not self._sorts:
            return
        if self.landing is None:
            self.landing = next((at for a in assortments if (at := self.landing_of(a)) is not None), None)
        if self.landing is not None:
            self.served.add(self.landing)

    def restore(self, landing: int | None, served: Iterable[int], rounds: int) -> None:
        """Restore the state of a checkpoint."""
        self.landing, self.served, self.rounds = landing, set(served), rounds

    def choose_landing(self, landings: list[Point2], here: Point2) -> int:
        """Decide the landing of the load: as decided before, else the nearest."""
        if self.landing is None:
            self.landing = min(range(len(landings)), key=lambda i: math.dist(landings[i], here))
        return self.landing

    def book_unloaded(self) -> None:
        """Book that the bunk is empty; the landing of the next load is undecided."""
        self.landing = None

    def needs_another_round(self, lying: Iterable[str]) -> bool:
        """Tell whether the route is driven again for logs of these assortments that are left.

        A log that fits the only load of the round cannot be reached from this route.
        """
        if not self._sorts:
            return False
        passed = {self.landing_of(a) for a in lying if not self._only or a in self._only} - {None}
        return bool(self.served) and bool(passed if len(self.served) > 1 else passed - self.served)

    def start_round(self) -> None:
        """Start the next round of the route."""
        self.served, self.rounds = set(), self.rounds + 1

    def landing_name(self, landing: int | None) -> str:
        """Return the name of a landing; empty with a single landing."""
        if landing is None or len(self._landings) < 2:
            return ""
        return self._landings[landing].name or f"landing {landing + 1}"
