"""Driving of a mission: the route by paper B's law or along a planned path, the drive to a landing and back.

`RouteDriver` wraps the navigator and the active drive, so that the manager only starts, halts and sets stops.
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
from machine.geometry.carrier import turning_radius_m
from machine.profile import Carrier

AHEAD_M: Final = 3.0
"""A path starts this far straight ahead, so that there is room for a bend after it."""
AT_M: Final = 1.0
"""A first waypoint within this distance counts as reached."""
BESIDE_M: Final = 4.2
"""Distance at which the machine passes a landing: the crane places best there."""
BEFORE_M, BEYOND_M = 10.0, 10.0
"""The path past a landing is straight from this far before it to this far beyond."""
ROOMY: Final = 1.5
"""Turning circles are this many times larger than the smallest one, because bends begin and end gently."""
ASTRAY_RAD: Final = 1.4
"""The machine does not turn well onto a first leg whose direction differs by more than this."""
NEAR_M: Final = 10.0
"""A corner this near may be cut: the machine was in its bend when it left the route."""
DIRECTIONS: Final = 12
ALONG_RAD: Final = 0.2
"""A machine within this angle of a landing's log direction places logs well."""
AGAIN_M: Final = 6.0
"""After a landing the machine returns to the route this far before the place where it left it."""

StopOn = Callable[[Callable[[float], Pose], float], float | None]
"""Where to stop along a path: from the crane's base by distance [m] and the path's length [m]; None: nowhere."""

class Ride:
    """Drives the mission's route.

    ``faithful`` selects paper B's law.  ``along_m`` is the distance driven on the route, ``length_m`` its length,
    ``driven_m`` the total distance driven.  ``left`` is the rest of the route from a checkpoint.
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
        """The checkpoint's rest of the route while that is being driven."""
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
        """Whether the machine stands at the requested stop."""
        return self._navigator.phase is Phase.ARRIVED and self._navigator.stands

    def begin(self, location: Location, plane: Plane) -> None:
        """Plan the route, or what is left of it, from the machine's location.

        Raises:
            PathRefused: it cannot be driven.
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
        """Restart the route from its first waypoint."""
        self._way, self._path, self._left, self._new = None, None, None, False
        self.along_m, self.length_m, self._over = 0.0, math.inf, False

    def left(self, plane: Plane | None) -> Left | None:
        """The rest of the route for a checkpoint; None before the route was begun."""
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
        """Drive on; stop at a distance along the route [m], or at its end (None)."""
        assert self._way is not None
        self._haul = None
        if isinstance(self._way, Along):
            self._way.stop_at(self.length_m if stop_m is None else stop_m)
        self._drive(self._way)

    def halt(self) -> None:
        """Stop smoothly."""
        self._navigator.pause()

    def haul(self, location: Location, landing: Point2, lie_rad: float | None, stop_on: StopOn) -> None:
        """Drive to a landing along the shortest path that passes it with room for the crane.

        ``lie_rad`` is the log direction there; a path along it is preferred (None: any direction).

        Raises:
            PathRefused: no path passes the landing.
        """
        if self._haul is None:
            ways = list[tuple[float, Path]]()
            if lie_rad is not None:
                ways = self._passing(location, landing, (lie_rad, lie_rad + math.pi), [], stop_on)
                # A detour may pass the landing before its last leg, in another direction.
                ways = [w for w in ways if abs(math.remainder(w[1].at(w[0])[2] - lie_rad, math.pi)) < ALONG_RAD]
            # Beside the landing or too near for a plain path: drive a little ahead, or make a detour.
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
        """Paths past a landing in these directions; else the paths by ``else_``; else paths with a turn first."""
        ways = self._reaching(location, _past(landing, directions), stop_on)
        ways = ways or self._reaching(location, else_, stop_on)
        turned = ([*turn, *p] for p in _past(landing, directions) for turn in self._turned(location, p))
        return ways or self._reaching(location, turned, stop_on)

    def _reaching(self, location: Location, ways: Iterable[list[Point2]], stop_on: StopOn) -> list[tuple[float, Path]]:
        """The drivable paths by these points from which the landing is reached, each with its stop [m].  Every path
        starts at the machine: stopping is inaccurate before the machine is on its path.
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
        """Plan the rest of the route from the landing back to where the route was left."""
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
        """Plan the route back to where it was left, by extra places and the remaining waypoints.

        Without room to return, skip the place where it was left, then a place too near to turn at; without room for
        that, try all of them with a turn first.
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
        """Corner points that lead the machine to the first of these points in the direction of their first leg."""
        if not points:
            return
        here, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (here[0] + AHEAD_M * math.cos(yaw), here[1] + AHEAD_M * math.sin(yaw))
        a, b = points[:2] if len(points) > 1 else (here, points[0])
        leg = math.atan2(b[1] - a[1], b[0] - a[0])
        radius_m = ROOMY * turning_radius_m(self._carrier, self._carrier.articulation_limit_rad)
        yield from turns((*ahead, yaw), (*points[0], leg), radius_m)

    def _back(self) -> tuple[Point2, Point2]:
        """A point shortly before the place where the route is left, and that place."""
        assert self._path is not None
        return self._path.at(self.along_m - AGAIN_M)[:2], self._path.at(self.along_m)[:2]

    def _ahead(self) -> tuple[list[Point2], list[Point2]]:
        """The points still ahead: extra places first, then waypoints."""
        ahead = [point for mark, point in self._marks if mark > self.along_m + AT_M]
        others = len(ahead) - min(len(ahead), self._to_come)
        return ahead[:others], ahead[others:]

    def moved(self, location: Location) -> None:
        """Update the driven distance."""
        here = (location.x_m, location.y_m)
        way_m = 0.0 if self._last is None else math.dist(here, self._last)
        self._last, self.driven_m = here, self.driven_m + way_m
        if not isinstance(self._way, Along):
            self.along_m += way_m
        elif self._way.steer is not None:
            self.along_m = self._way.steer.s_m

    def base_at(self, along_m: float) -> Pose:
        """The crane's base at a distance along the route, with the frame at its lowest."""
        assert self._path is not None
        return self._base(self._path, along_m)

    def _route(self, location: Location, points: Sequence[Point2], begins: Callable[..., Path]) -> None:
        """Make the path by these points the active route; ``begins`` plans it."""
        points = list(points)
        if len(points) > 1 and math.dist((location.x_m, location.y_m), points[0]) < AT_M:
            del points[0]
        self._path = path = begins(location, points)
        self._way, self.length_m, self.along_m = Along(self._carrier, path, None, self._speed), path.length_m, 0.0
        self._marks, low, before = [], 0.0, (location.x_m, location.y_m)
        for point in points:  # bends are shorter than their corners; farther on it may be the same place of another lap
            low, before = path.nearest(*point, low, low + math.dist(before, point) + 2.0 * AHEAD_M), point
            self._marks.append((low, point))

    def _as_it_stands(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points that starts in the machine's own direction."""
        here, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (here[0] + AHEAD_M * math.cos(yaw), here[1] + AHEAD_M * math.sin(yaw))
        return drivable([here, ahead, *points], self._carrier)

    def _nearly(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points whose first leg roughly has the machine's direction."""
        path = self._onto(location, points)
        if abs(math.remainder(path.at(0.0)[2] - location.yaw_rad, math.tau)) > ASTRAY_RAD:
            raise PathRefused(
                "the path starts too far off the direction in which the machine stands; drive it there by hand"
            )
        return path

    def _onto(self, location: Location, points: Sequence[Point2]) -> Path:
        """A path by these points; the follower steers onto its first leg."""
        return drivable([(location.x_m, location.y_m), *points], self._carrier)

    def _base(self, path: Path, along_m: float) -> Pose:
        wheelbase = self._carrier.front_axle_m + self._carrier.rear_axle_m
        return base_on_way(self._carrier, path.at(along_m)[:3], path.at(along_m - wheelbase)[:2], 0.0)

    def _drive(self, way: Along | PaperB) -> None:
        """Start this drive, or resume it."""
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
    """Straight lines past a landing in these directions, on both of its sides."""
    for angle in directions:
        c, s = math.cos(angle), math.sin(angle)
        for side in (BESIDE_M, -BESIDE_M):
            x, y = landing[0] - side * s, landing[1] + side * c
            yield [(x - BEFORE_M * c, y - BEFORE_M * s), (x + BEYOND_M * c, y + BEYOND_M * s)]
