"""Which logs a mission wants, and to which of its landings a load of them goes.

What is not of the mission's assortments stays lying.  Without sorting a load goes to the landing that is nearest when
the machine sets out.  With sorting a load holds what one landing takes: the first log aboard decides which, and until
it is unloaded there logs of the others stay lying; then the route is driven anew for them.  A round in which nothing
was loaded is the last.  Landings are known by their places in the mission, from 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from autonomy.missions.model import ForwardingMission
from autonomy.navigation.clothoid_path import Point2


class Sorting:
    """Of one mission.  ``landing`` is where the load on board goes, None while that is open; ``served`` are the
    landings for which something was loaded in this round of the route, ``rounds`` those that are over.
    """

    def __init__(self, mission: ForwardingMission) -> None:
        self.landing: int | None = None
        self.served: set[int] = set()
        self.rounds = 0
        self._only = frozenset(mission.options.assortments)
        self._landings = mission.landings
        self._sorts = mission.options.sort_by_assortment and bool(mission.landings)

    @property
    def chooses(self) -> bool:
        """Whether there may be logs that stay lying."""
        return self._sorts or bool(self._only)

    def taker(self, assortment: str) -> int | None:
        """The landing that an assortment goes to when it is sorted: the first that names it, else the first that names
        none; None where no landing takes it.
        """
        named = (i for i, at in enumerate(self._landings) if assortment in at.assortments)
        takes_all = (i for i, at in enumerate(self._landings) if not at.assortments)
        return next(named, next(takes_all, None))

    def wants(self, assortment: str, landing: int | None = None) -> bool:
        """Whether such a log is to come into the load on board; ``landing``: where that would go if it is open."""
        if self._only and assortment not in self._only:
            return False
        if not self._sorts:
            return True
        goes_to = self.taker(assortment)
        bound = landing if self.landing is None else self.landing
        return goes_to is not None and bound in (None, goes_to)

    def together(self, assortment: str, first: str) -> bool:
        """Whether such a log may come up in one grasp with a first one."""
        return self.wants(assortment, self.taker(first) if self._sorts else None)

    def took(self, assortments: Iterable[str]) -> None:
        """Logs that have come aboard, the first one first."""
        if not self._sorts:
            return
        if self.landing is None:
            self.landing = next((at for a in assortments if (at := self.taker(a)) is not None), None)
        if self.landing is not None:
            self.served.add(self.landing)

    def goes_on(self, landing: int | None, served: Iterable[int], rounds: int) -> None:
        """As it was when the mission was left."""
        self.landing, self.served, self.rounds = landing, set(served), rounds

    def sets_out(self, landings: list[Point2], here: Point2) -> int:
        """The landing that the load is brought to from here: as it was decided, else the nearest."""
        if self.landing is None:
            self.landing = min(range(len(landings)), key=lambda i: math.dist(landings[i], here))
        return self.landing

    def unloaded(self) -> None:
        """Nothing is on board any more; the next load is open."""
        self.landing = None

    def anew(self, lying: Iterable[str]) -> bool:
        """Whether the route is to be driven once more, for logs of these assortments that lie about.

        A log that would have fitted the only load of the round lies where this route does not lead to it.
        """
        if not self._sorts:
            return False
        passed = {self.taker(a) for a in lying if not self._only or a in self._only} - {None}
        return bool(self.served) and bool(passed if len(self.served) > 1 else passed - self.served)

    def begins_anew(self) -> None:
        """The route is driven once more."""
        self.served, self.rounds = set(), self.rounds + 1

    def called(self, landing: int | None) -> str:
        """A landing as people call it; empty where there is one alone."""
        if landing is None or len(self._landings) < 2:
            return ""
        return self._landings[landing].name or f"landing {landing + 1}"
