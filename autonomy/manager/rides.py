"""The ways a mission drives: its route by paper B's law or along a path of ours, and the way to a landing and back.

A `Ride` wraps the navigator and the way under it, so that the manager only says go, halt, and where to stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Final

from autonomy.localization.estimate import Location
from autonomy.localization.plane import Plane
from autonomy.manager.stops import base_on_way
from autonomy.missions.model import ForwardingMission
from autonomy.navigation.along import Along
from autonomy.navigation.curves import Path, PathRefused, Point2, drivable
from autonomy.navigation.navigator import Navigator, Phase
from autonomy.navigation.waypoints import PaperB, Waypoint
from autonomy.perception.frame import Pose
from machine.profile import Carrier

AHEAD_M: Final = 3.0
"""A path begins so far straight ahead, where there is room for a bend after it."""
AT_M: Final = 1.0
"""A first waypoint that is no farther away is where the machine stands."""
BESIDE_M: Final = 4.2
"""The machine passes a landing at this distance: there the crane lays down best."""
BEFORE_M, BEYOND_M = 10.0, 10.0
"""The way past a landing is straight from so far before it to so far beyond."""
DIRECTIONS: Final = 12
AGAIN_M: Final = 6.0
"""After a landing the machine comes back to its route so far before the place where it left it."""

StopOn = Callable[[Callable[[float], Pose], float], float | None]
"""Where along a way to stop: the crane's base by distance [m], and the way's length [m]; None: nowhere."""


class Ride:
    """The mission's route.  ``faithful`` drives it by paper B's law.

    ``along_m`` is the way driven on it, ``length_m`` all of it; ``driven_m`` is all that was driven.
    """

    def __init__(self, carrier: Carrier, navigator: Navigator, mission: ForwardingMission, faithful: bool) -> None:
        self.along_m = self.length_m = self.driven_m = 0.0
        self.faithful = faithful
        self._carrier, self._navigator, self._mission = carrier, navigator, mission
        self._speed = mission.options.speed_m_s
        self._way: Along | PaperB | None = None
        self._path: Path | None = None
        self._marks: list[tuple[float, Point2]] = []
        self._haul: Along | None = None
        self._over = False
        self._last: Point2 | None = None

    @property
    def ended(self) -> bool:
        """Whether the end of the route is reached."""
        if self._haul is None and self._navigator.phase is Phase.ARRIVED:
            self._over = self._over or self.faithful or self.along_m > self.length_m - 0.5
        return self._over

    @property
    def arrived(self) -> bool:
        """Whether the machine has come to a halt where it was told to."""
        return self._navigator.phase is Phase.ARRIVED and self._navigator.stands

    def begin(self, location: Location, plane: Plane) -> None:
        """Plan the route from where the machine stands; raises PathRefused when it cannot be driven."""
        places = [p for _ in range(self._mission.options.laps) for p in self._mission.waypoints]
        points = [plane.local(p.latitude_deg, p.longitude_deg)[:2] for p in places]
        self.along_m, self._last = 0.0, None
        if self.faithful:
            ways = [Waypoint(p.latitude_deg, p.longitude_deg) for p in places]
            self._way = PaperB(self._carrier, ways, self._speed)
            self.length_m = sum(math.dist(a, b) for a, b in pairwise([(location.x_m, location.y_m), *points]))
            return
        self._route(location, points)

    def go(self, stop_m: float | None = None) -> None:
        """Drive on, and stop at a distance along the route [m], or (None) at its end."""
        assert self._way is not None
        self._haul = None
        if isinstance(self._way, Along):
            self._way.stop_at(self.length_m if stop_m is None else stop_m)
        self._drive(self._way)

    def halt(self) -> None:
        """Stand as soon as is smooth."""
        self._navigator.pause()

    def haul(self, location: Location, landing: Point2, stop_on: StopOn) -> None:
        """Drive to a landing by the shortest way that passes it with room for the crane; PathRefused when none does."""
        if self._haul is None:
            ways = []
            for points in _past(landing):
                try:
                    path = self._from(location, points)
                except PathRefused:
                    continue
                stop_m = stop_on(lambda s, path=path: self._base(path, s), path.length_m)
                if stop_m is not None:
                    ways.append((stop_m, path))
            if not ways:
                raise PathRefused("no way leads past the landing with room to turn; move it or give it more room")
            stop_m, path = min(ways, key=lambda w: w[0])
            self._haul = Along(self._carrier, path, stop_m, self._speed)
        self._drive(self._haul)

    def rejoin(self, location: Location) -> None:
        """Plan the rest of the route anew, from the landing to where it was left."""
        self._haul = None
        if self._over or self._path is None:
            return
        rest = [point for mark, point in self._marks if mark > self.along_m + AT_M]
        left = [self._path.at(self.along_m - AGAIN_M)[:2], self._path.at(self.along_m)[:2]]
        try:
            self._route(location, [*left, *rest])
        except PathRefused:
            self._route(location, rest)

    def moved(self, location: Location) -> None:
        """Keep account of the way that was driven."""
        here = (location.x_m, location.y_m)
        way_m = 0.0 if self._last is None else math.dist(here, self._last)
        self._last, self.driven_m = here, self.driven_m + way_m
        if not isinstance(self._way, Along):
            self.along_m += way_m
        elif self._way.steer is not None:
            self.along_m = self._way.steer.s_m

    def base_at(self, along_m: float) -> Pose:
        """The crane's base at a distance along the route of ours, the frame at its lowest."""
        assert self._path is not None
        return self._base(self._path, along_m)

    def _route(self, location: Location, points: Sequence[Point2]) -> None:
        """The route by these points is what is driven now."""
        points = list(points)
        if len(points) > 1 and math.dist((location.x_m, location.y_m), points[0]) < AT_M:
            del points[0]
        self._path = path = self._from(location, points)
        self._way, self.length_m, self.along_m = Along(self._carrier, path, None, self._speed), path.length_m, 0.0
        self._marks, low = [], 0.0
        for point in points:
            low = path.nearest(*point, low)
            self._marks.append((low, point))

    def _from(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points that begins as the machine stands."""
        here, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (here[0] + AHEAD_M * math.cos(yaw), here[1] + AHEAD_M * math.sin(yaw))
        try:
            return drivable([here, ahead, *points], self._carrier)
        except PathRefused:  # too little room for a bend: then the follower turns onto the first leg
            return drivable([here, *points], self._carrier)

    def _base(self, path: Path, along_m: float) -> Pose:
        wheelbase = self._carrier.front_axle_m + self._carrier.rear_axle_m
        return base_on_way(self._carrier, path.at(along_m)[:3], path.at(along_m - wheelbase)[:2], 0.0)

    def _drive(self, way: Along | PaperB) -> None:
        """Drive on this way, or begin it."""
        if self._navigator.phase in (Phase.PAUSED, Phase.STOPPED) and self._navigator.way is way:
            self._navigator.resume()
        else:
            self._navigator.drive(way)


def _past(landing: Point2) -> Iterator[list[Point2]]:
    """Straight ways past a landing, in every direction and on both of its sides."""
    for k in range(DIRECTIONS):
        angle = 2.0 * math.pi * k / DIRECTIONS
        c, s = math.cos(angle), math.sin(angle)
        for side in (BESIDE_M, -BESIDE_M):
            x, y = landing[0] - side * s, landing[1] + side * c
            yield [(x - BEFORE_M * c, y - BEFORE_M * s), (x + BEYOND_M * c, y + BEYOND_M * s)]
