"""The ways a mission drives: its route by paper B's law or along a path of ours, and the way to a landing and back.

A `Ride` wraps the navigator and the way under it, so that the manager only says go, halt, and where to stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Final

from autonomy.localization.location import Location
from autonomy.localization.local_plane import Plane
from autonomy.manager.checkpoint import Left
from autonomy.manager.loading_stops import base_on_way
from autonomy.navigation.dubins import turns
from autonomy.missions.model import ForwardingMission, Point
from autonomy.navigation.path_drive import Along
from autonomy.navigation.clothoid_path import Path, PathRefused, Point2, drivable
from autonomy.navigation.navigator import Navigator, Phase
from autonomy.navigation.waypoint_drive import PaperB, Waypoint
from autonomy.perception.camera.frame import Pose
from machine.carrier import turning_radius_m
from machine.profile import Carrier

AHEAD_M: Final = 3.0
"""A path begins so far straight ahead, where there is room for a bend after it."""
AT_M: Final = 1.0
"""A first waypoint that is no farther away is where the machine stands."""
BESIDE_M: Final = 4.2
"""The machine passes a landing at this distance: there the crane lays down best."""
BEFORE_M, BEYOND_M = 10.0, 10.0
"""The way past a landing is straight from so far before it to so far beyond."""
ROOMY: Final = 1.5
"""The machine turns round in circles that are so much wider than its smallest: the bends begin and end gently."""
ASTRAY_RAD: Final = 1.4
"""Onto a first leg that begins so far off its direction the machine does not turn well."""
NEAR_M: Final = 10.0
"""A corner that is so near may be cut: the machine was in its bend when it was left there."""
DIRECTIONS: Final = 12
ALONG_RAD: Final = 0.2
"""A machine that stands so along the logs of a landing lays them well."""
AGAIN_M: Final = 6.0
"""After a landing the machine comes back to its route so far before the place where it left it."""

StopOn = Callable[[Callable[[float], Pose], float], float | None]
"""Where along a way to stop: the crane's base by distance [m], and the way's length [m]; None: nowhere."""


class Ride:
    """The mission's route.  ``faithful`` drives it by paper B's law.

    ``along_m`` is the way driven on it, ``length_m`` all of it; ``driven_m`` is all that was driven.  ``left``: it goes
    on where it was left, after so much way.
    """

    def __init__(
        self,
        carrier: Carrier,
        navigator: Navigator,
        mission: ForwardingMission,
        faithful: bool,
        left: Left | None = None,
        driven_m: float = 0.0,
    ) -> None:
        self.along_m = self.length_m = 0.0
        self.driven_m = driven_m
        self.faithful = faithful
        self._carrier, self._navigator, self._mission = carrier, navigator, mission
        self._speed = mission.options.speed_m_s
        self._way: Along | PaperB | None = None
        self._path: Path | None = None
        self._marks: list[tuple[float, Point2]] = []
        self._haul: Along | None = None
        self._left, self._to_come, self._new = left, 0, True
        self._begun: Left | None = None
        """Where the route was begun that is driven now, if it was left before."""
        self._plane: Plane | None = None
        self._over = left is not None and left.ended
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
        """Plan the route from where the machine stands, all of it or what is left of it; raises PathRefused when it
        cannot be driven.
        """
        left, self._left, self._plane = self._left, None, plane
        self._begun = left
        places = [p for _ in range(self._mission.options.laps) for p in self._mission.waypoints]
        places = places if left is None else places[len(places) - left.to_come :]
        points = _points(plane, places)
        self.along_m, self._last, self._over, self._haul = 0.0, None, False, None
        self._to_come = len(points)
        if self.faithful:
            ways = [Waypoint(p.latitude_deg, p.longitude_deg) for p in places]
            self._way = PaperB(self._carrier, ways, self._speed)
            self.length_m = sum(math.dist(a, b) for a, b in pairwise([(location.x_m, location.y_m), *points]))
            return
        by, back = ([], []) if left is None else (_points(plane, left.by), _points(plane, left.at or ()))
        if back or by or points:
            self._again(location, back, by, points, turn=left is not None or not self._new)
            self._new = False
        else:
            self._over = True

    def renew(self) -> None:
        """The route is to begin once more."""
        self._way, self._path, self._left, self._new = None, None, None, False
        self.along_m, self.length_m, self._over = 0.0, math.inf, False

    def left(self, plane: Plane | None) -> Left | None:
        """Where the route is left now, for one that goes on with it later; None before it was begun."""
        if isinstance(self._way, PaperB):
            return Left(self._to_come - self._way.number, ended=self.ended)
        if self._path is None:
            return self._left
        if self._begun is not None and self.along_m < AT_M:
            return self._begun
        assert plane is not None
        by, rest = self._ahead()
        before, at = (_place(plane, p) for p in self._back())
        return Left(len(rest), (before, at), tuple(_place(plane, p) for p in by), bool(self.ended))

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

    def haul(self, location: Location, landing: Point2, lie_rad: float | None, stop_on: StopOn) -> None:
        """Drive to a landing by the shortest way that passes it with room for the crane, along its logs (``lie_rad``,
        None: anyhow) where there is such a way; PathRefused when none does.
        """
        if self._haul is None:
            ways = list[tuple[float, Path]]()
            if lie_rad is not None:
                ways = self._passing(location, landing, (lie_rad, lie_rad + math.pi), [], stop_on)
                # A way round about may pass the landing before its last leg, and otherwise.
                ways = [w for w in ways if abs(math.remainder(w[1].at(w[0])[2] - lie_rad, math.pi)) < ALONG_RAD]
            # Beside it or too near to it for a plain way: a little ahead, or round about.
            ways = ways or self._passing(location, landing, _ALL_ROUND, [[]], stop_on)
            if not ways:
                raise PathRefused("no way leads past the landing with room to turn; move it or give it more room")
            stop_m, path = min(ways, key=lambda w: w[0])
            self._haul = Along(self._carrier, path, stop_m, self._speed)
        self._drive(self._haul)

    def _passing(
        self,
        location: Location,
        landing: Point2,
        directions: Sequence[float],
        else_: list[list[Point2]],
        stop_on: StopOn,
    ) -> list[tuple[float, Path]]:
        """Ways past a landing in one of these directions; where there are none, those by ``else_``; where there are
        none either, ways round about.
        """
        ways = self._reaching(location, _past(landing, directions), stop_on)
        ways = ways or self._reaching(location, else_, stop_on)
        turned = ([*turn, *p] for p in _past(landing, directions) for turn in self._turned(location, p))
        return ways or self._reaching(location, turned, stop_on)

    def _reaching(self, location: Location, ways: Iterable[list[Point2]], stop_on: StopOn) -> list[tuple[float, Path]]:
        """Of the ways by these points those that can be driven and stopped on, each with where to stop [m].  The
        machine is on them from the first: it does not stop well on one that it has yet to come to.
        """
        found = []
        for points in ways:
            try:
                path = self._as_it_stands(location, points)
            except PathRefused:
                continue
            stop_m = stop_on(lambda s, path=path: self._base(path, s), path.length_m)
            if stop_m is not None:
                found.append((stop_m, path))
        return found

    def rejoin(self, location: Location) -> None:
        """Plan the rest of the route anew, from the landing to where it was left."""
        self._haul = None
        if self._over or self._path is None:
            return
        if self._begun is not None and self.along_m < AT_M:
            assert self._plane is not None
            self._left = self._begun
            self.begin(location, self._plane)
            return
        by, rest = self._ahead()
        self._to_come = len(rest)
        self._again(location, self._back(), by, rest, turn=True)

    def _again(
        self, location: Location, back: Sequence[Point2], by: Sequence[Point2], rest: Sequence[Point2], turn: bool
    ) -> None:
        """The route from where it was left by other places and the rest; where there is no room to come back, as for a
        machine that is there still, by what is ahead of it or past a place that is too near to turn at, and where there
        is none for that either, with a turn before it.
        """
        here = (location.x_m, location.y_m)
        ways = [[*back, *by, *rest]] if back else []
        ways += [[*by, *rest]] if by else []
        ways.append(list(rest))
        past = [list(rest[1:])] if turn and len(rest) > 1 and math.dist(here, rest[0]) < NEAR_M else []
        turned = (
            [*corners, *points] for points in (ways if turn else ()) for corners in self._turned(location, points)
        )
        refused = PathRefused("there is no way")
        for begins, choice in (
            (self._as_it_stands, (*ways, *past)),
            (self._nearly, (*ways, *past)),
            (self._as_it_stands, turned),
            (self._onto, (*ways, *past)),
        ):
            for points in choice:
                try:
                    self._route(location, points, begins)
                    return
                except PathRefused as error:
                    refused = error
        raise refused

    def _turned(self, location: Location, points: Sequence[Point2]) -> Iterator[list[Point2]]:
        """Places to drive by so that the machine comes to the first of these points along their first leg."""
        if not points:
            return
        here, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (here[0] + AHEAD_M * math.cos(yaw), here[1] + AHEAD_M * math.sin(yaw))
        a, b = points[:2] if len(points) > 1 else (here, points[0])
        leg = math.atan2(b[1] - a[1], b[0] - a[0])
        radius_m = ROOMY * turning_radius_m(self._carrier, self._carrier.articulation_limit_rad)
        yield from turns((*ahead, yaw), (*points[0], leg), radius_m)

    def _back(self) -> tuple[Point2, Point2]:
        """Where the route is left, and a bit before."""
        assert self._path is not None
        return self._path.at(self.along_m - AGAIN_M)[:2], self._path.at(self.along_m)[:2]

    def _ahead(self) -> tuple[list[Point2], list[Point2]]:
        """The places that the route still leads to: those that are no waypoints, and then the waypoints."""
        ahead = [point for mark, point in self._marks if mark > self.along_m + AT_M]
        others = len(ahead) - min(len(ahead), self._to_come)
        return ahead[:others], ahead[others:]

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

    def _route(self, location: Location, points: Sequence[Point2], begins: Callable[..., Path]) -> None:
        """The route by these points is what is driven now; ``begins`` makes its path."""
        points = list(points)
        if len(points) > 1 and math.dist((location.x_m, location.y_m), points[0]) < AT_M:
            del points[0]
        self._path = path = begins(location, points)
        self._way, self.length_m, self.along_m = Along(self._carrier, path, None, self._speed), path.length_m, 0.0
        self._marks, low, before = [], 0.0, (location.x_m, location.y_m)
        for point in points:  # bends are shorter than their corners; beyond that it may be the place of another lap
            low, before = path.nearest(*point, low, low + math.dist(before, point) + 2.0 * AHEAD_M), point
            self._marks.append((low, point))

    def _as_it_stands(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points that the machine is on from where it stands."""
        here, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (here[0] + AHEAD_M * math.cos(yaw), here[1] + AHEAD_M * math.sin(yaw))
        return drivable([here, ahead, *points], self._carrier)

    def _nearly(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points whose first leg begins about as the machine stands."""
        path = self._onto(location, points)
        if abs(math.remainder(path.at(0.0)[2] - location.yaw_rad, math.tau)) > ASTRAY_RAD:
            raise PathRefused(
                "the way begins far off the direction in which the machine stands; drive it there by hand"
            )
        return path

    def _onto(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points; the follower turns onto its first leg, beside it at first."""
        return drivable([(location.x_m, location.y_m), *points], self._carrier)

    def _base(self, path: Path, along_m: float) -> Pose:
        wheelbase = self._carrier.front_axle_m + self._carrier.rear_axle_m
        return base_on_way(self._carrier, path.at(along_m)[:3], path.at(along_m - wheelbase)[:2], 0.0)

    def _drive(self, way: Along | PaperB) -> None:
        """Drive on this way, or begin it."""
        if self._navigator.phase in (Phase.PAUSED, Phase.STOPPED) and self._navigator.way is way:
            self._navigator.resume()
        else:
            self._navigator.drive(way)


def _points(plane: Plane, places: Iterable[Point]) -> list[Point2]:
    return [plane.local(p.latitude_deg, p.longitude_deg)[:2] for p in places]


def _place(plane: Plane, point: Point2) -> Point:
    return Point(*plane.geodetic(*point)[:2])


_ALL_ROUND: Final = [2.0 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS)]


def _past(landing: Point2, directions: Iterable[float]) -> Iterator[list[Point2]]:
    """Straight ways past a landing, in these directions and on both of its sides."""
    for angle in directions:
        c, s = math.cos(angle), math.sin(angle)
        for side in (BESIDE_M, -BESIDE_M):
            x, y = landing[0] - side * s, landing[1] + side * c
            yield [(x - BEFORE_M * c, y - BEFORE_M * s), (x + BEYOND_M * c, y + BEYOND_M * s)]
