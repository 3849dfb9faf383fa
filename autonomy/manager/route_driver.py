"""Driving of a mission: the route by paper B's law or along a planned path, the drive to a landing and back.

`RouteDriver` wraps the navigator and the active drive, so that the manager only starts, halts and sets stops.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Final

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.location import Location
from autonomy.manager.checkpoint import RouteRemainder
from autonomy.manager.loading_stops import base_on_path
from autonomy.missions.model import ForwardingMission, Point
from autonomy.navigation.clothoid_path import Path, PathRefused, Point2, drivable_path
from autonomy.navigation.joining_path import dubins_corners
from autonomy.navigation.navigator import Navigator, Phase
from autonomy.navigation.path_drive import PathDrive
from autonomy.navigation.waypoint_drive import Waypoint, WaypointDrive
from autonomy.perception.camera.frame import Pose
from machine.geometry.carrier import turning_radius_m
from machine.profile import Carrier

AHEAD_M: Final = 3.0
"""A path starts this far straight ahead, so that there is room for a bend after it."""
REACHED_M: Final = 1.0
"""A first waypoint within this distance counts as reached."""
LANDING_OFFSET_M: Final = 4.2
"""Distance at which the machine passes a landing: the crane places best there."""
BEFORE_M, BEYOND_M = 10.0, 10.0
"""The path past a landing is straight from this far before it to this far beyond."""
TURN_RADIUS_FACTOR: Final = 1.5
"""Turning circles are this many times larger than the smallest one, because bends begin and end gently."""
MAX_HEADING_ERROR_RAD: Final = 1.4
"""The machine does not turn well onto a first leg whose direction differs by more than this."""
NEAR_M: Final = 10.0
"""A corner this near may be cut: the machine was in its bend when it left the route."""
DIRECTION_COUNT: Final = 12
MAX_LANDING_ANGLE_RAD: Final = 0.2
"""A machine within this angle of a landing's log direction places logs well."""
RETURN_BEFORE_M: Final = 6.0
"""After a landing the machine returns to the route this far before the place where it left it."""

StopFinder = Callable[[Callable[[float], Pose], float], float | None]
"""Where to stop along a path: from the crane's base by distance [m] and the path's length [m]; None: nowhere."""


class RouteDriver:
    """Drives the mission's route.

    ``as_paper_b`` selects paper B's law.  ``along_m`` is the distance driven on the route, ``length_m`` its length,
    ``driven_m`` the total distance driven.  ``left`` is the rest of the route from a checkpoint.
    """

    def __init__(
        self,
        carrier: Carrier,
        navigator: Navigator,
        mission: ForwardingMission,
        as_paper_b: bool,
        left: RouteRemainder | None = None,
        driven_m: float = 0.0,
    ) -> None:
        self.along_m = self.length_m = 0.0
        self.driven_m = driven_m
        self.as_paper_b = as_paper_b
        self._carrier, self._navigator, self._mission = carrier, navigator, mission
        self._speed = mission.options.speed_m_s
        self._active: PathDrive | WaypointDrive | None = None
        self._path: Path | None = None
        self._marks: list[tuple[float, Point2]] = []
        self._landing_drive: PathDrive | None = None
        self._left, self._to_come, self._new = left, 0, True
        self._begun: RouteRemainder | None = None
        """The checkpoint's rest of the route while that is being driven."""
        self._plane: LocalPlane | None = None
        self._ended = left is not None and left.ended
        self._last: Point2 | None = None

    @property
    def ended(self) -> bool:
        """Whether the end of the route is reached."""
        if self._landing_drive is None and self._navigator.phase is Phase.ARRIVED:
            self._ended = self._ended or self.as_paper_b or self.along_m > self.length_m - 0.5
        return self._ended

    @property
    def arrived(self) -> bool:
        """Whether the machine stands at the requested stop."""
        return self._navigator.phase is Phase.ARRIVED and self._navigator.is_standing

    def begin(self, location: Location, plane: LocalPlane) -> None:
        """Plan the route, or what is left of it, from the machine's location.

        Raises:
            PathRefused: it cannot be driven.
        """
        left, self._left, self._plane = self._left, None, plane
        self._begun = left
        places = [p for _ in range(self._mission.options.laps) for p in self._mission.waypoints]
        places = places if left is None else places[len(places) - left.to_come :]
        points = _points(plane, places)
        self.along_m, self._last, self._ended, self._landing_drive = 0.0, None, False, None
        self._to_come = len(points)
        by, back = ([], []) if left is None else (_points(plane, left.by), _points(plane, left.at or ()))
        if not points and (self.as_paper_b or not (back or by)):
            self._left, self._ended = RouteRemainder(0, ended=True), True
            return
        if self.as_paper_b:
            candidates = [Waypoint(p.latitude_deg, p.longitude_deg) for p in places]
            self._active = WaypointDrive(self._carrier, candidates, self._speed)
            self.length_m = sum(math.dist(a, b) for a, b in pairwise([(location.x_m, location.y_m), *points]))
            return
        self._plan_return(location, back, by, points, turn=left is not None or not self._new)
        self._new = False

    def restart(self) -> None:
        """Restart the route from its first waypoint."""
        self._active, self._path, self._left, self._new = None, None, None, False
        self.along_m, self.length_m, self._ended = 0.0, math.inf, False

    def remainder(self, plane: LocalPlane | None) -> RouteRemainder | None:
        """Return the rest of the route for a checkpoint; None before the route was begun."""
        if isinstance(self._active, WaypointDrive):
            return RouteRemainder(self._to_come - self._active.number, ended=self.ended)
        if self._path is None:
            return self._left
        if self._begun is not None and self.along_m < REACHED_M:
            return self._begun
        assert plane is not None
        by, rest = self._points_ahead()
        before, at = (_position(plane, p) for p in self._return_points())
        return RouteRemainder(len(rest), (before, at), tuple(_position(plane, p) for p in by), bool(self.ended))

    def drive_on(self, stop_m: float | None = None) -> None:
        """Drive on; stop at a distance along the route [m], or at its end (None)."""
        assert self._active is not None
        self._landing_drive = None
        if isinstance(self._active, PathDrive):
            self._active.stop_at(self.length_m if stop_m is None else stop_m)
        self._drive(self._active)

    def halt(self) -> None:
        """Stop smoothly."""
        self._navigator.pause()

    def drive_to_landing(
        self, location: Location, landing: Point2, log_direction_rad: float | None, stop_on: StopFinder
    ) -> None:
        """Drive to a landing along the shortest path that passes it with room for the crane.

        ``log_direction_rad`` is the log direction there; a path along it is preferred (None: any direction).

        Raises:
            PathRefused: no path passes the landing.
        """
        if self._landing_drive is None:
            candidates = list[tuple[float, Path]]()
            if log_direction_rad is not None:
                candidates = self._paths_past(
                    location, landing, (log_direction_rad, log_direction_rad + math.pi), [], stop_on
                )
                # A detour may pass the landing before its last leg, in another direction.
                candidates = [
                    w
                    for w in candidates
                    if abs(math.remainder(w[1].at(w[0])[2] - log_direction_rad, math.pi)) < MAX_LANDING_ANGLE_RAD
                ]
            # Beside the landing or too near for a plain path: drive a little ahead, or make a detour.
            candidates = candidates or self._paths_past(location, landing, _ALL_ROUND, [[]], stop_on)
            if not candidates:
                raise PathRefused(
                    "path.landing", "no path leads past the landing with room to turn; move it or give it more room"
                )
            stop_m, path = min(candidates, key=lambda w: w[0])
            self._landing_drive = PathDrive(self._carrier, path, stop_m, self._speed)
        self._drive(self._landing_drive)

    def _paths_past(
        self,
        location: Location,
        landing: Point2,
        directions: Sequence[float],
        else_: list[list[Point2]],
        stop_on: StopFinder,
    ) -> list[tuple[float, Path]]:
        """Find paths past a landing in these directions; else the paths by ``else_``; else paths with a turn first."""
        candidates = self._drivable_paths(location, _lines_past(landing, directions), stop_on)
        candidates = candidates or self._drivable_paths(location, else_, stop_on)
        turned = ([*turn, *p] for p in _lines_past(landing, directions) for turn in self._turn_first(location, p))
        return candidates or self._drivable_paths(location, turned, stop_on)

    def _drivable_paths(
        self, location: Location, candidates: Iterable[list[Point2]], stop_on: StopFinder
    ) -> list[tuple[float, Path]]:
        """Find the drivable paths by these points from which the landing is reached, each with its stop [m].  Every
        path starts at the machine: stopping is inaccurate before the machine is on its path.
        """
        drivable_paths = []
        for points in candidates:
            try:
                path = self._ahead_path(location, points)
            except PathRefused:
                continue
            stop_m = stop_on(partial(self._base, path), path.length_m)
            if stop_m is not None:
                drivable_paths.append((stop_m, path))
        return drivable_paths

    def rejoin(self, location: Location) -> None:
        """Plan the rest of the route from the landing back to where the route was left."""
        self._landing_drive = None
        if self._ended or self._path is None:
            return
        if self._begun is not None and self.along_m < REACHED_M:
            assert self._plane is not None
            self._left = self._begun
            self.begin(location, self._plane)
            return
        by, rest = self._points_ahead()
        self._to_come = len(rest)
        self._plan_return(location, self._return_points(), by, rest, turn=True)

    def _plan_return(
        self, location: Location, back: Sequence[Point2], by: Sequence[Point2], rest: Sequence[Point2], turn: bool
    ) -> None:
        """Plan the route back to where it was left, by extra places and the remaining waypoints.

        Without room to return, skip the place where it was left, then a place too near to turn at; without room for
        that, try all of them with a turn first.
        """
        position_m = (location.x_m, location.y_m)
        candidates = [[*back, *by, *rest]] if back else []
        candidates += [[*by, *rest]] if by else []
        candidates.append(list(rest))
        past = [list(rest[1:])] if turn and len(rest) > 1 and math.dist(position_m, rest[0]) < NEAR_M else []
        turned = (
            [*corners, *points]
            for points in (candidates if turn else ())
            for corners in self._turn_first(location, points)
        )
        refused = PathRefused("path.none", "there is no drivable path")
        for plan, choice in (
            (self._ahead_path, (*candidates, *past)),
            (self._aligned_path, (*candidates, *past)),
            (self._ahead_path, turned),
            (self._direct_path, (*candidates, *past)),
        ):
            for points in choice:
                try:
                    self._route(location, points, plan)
                    return
                except PathRefused as error:
                    refused = error
        raise refused

    def _turn_first(self, location: Location, points: Sequence[Point2]) -> Iterator[list[Point2]]:
        """Yield corner points that lead the machine to the first of these points in their first leg's direction."""
        if not points:
            return
        position_m, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (position_m[0] + AHEAD_M * math.cos(yaw), position_m[1] + AHEAD_M * math.sin(yaw))
        a, b = points[:2] if len(points) > 1 else (position_m, points[0])
        leg = math.atan2(b[1] - a[1], b[0] - a[0])
        radius_m = TURN_RADIUS_FACTOR * turning_radius_m(self._carrier, self._carrier.articulation_limit_rad)
        yield from dubins_corners((*ahead, yaw), (*points[0], leg), radius_m)

    def _return_points(self) -> tuple[Point2, Point2]:
        """Return a point shortly before the place where the route is left, and that place."""
        assert self._path is not None
        return self._path.at(self.along_m - RETURN_BEFORE_M)[:2], self._path.at(self.along_m)[:2]

    def _points_ahead(self) -> tuple[list[Point2], list[Point2]]:
        """Return the points still ahead: extra places first, then waypoints."""
        ahead = [point for mark, point in self._marks if mark > self.along_m + REACHED_M]
        others = len(ahead) - min(len(ahead), self._to_come)
        return ahead[:others], ahead[others:]

    def update_distance(self, location: Location) -> None:
        """Update the driven distance."""
        position_m = (location.x_m, location.y_m)
        distance_m = 0.0 if self._last is None else math.dist(position_m, self._last)
        self._last, self.driven_m = position_m, self.driven_m + distance_m
        if not isinstance(self._active, PathDrive):
            self.along_m += distance_m
        elif self._active.steer is not None:
            self.along_m = self._active.steer.s_m

    def base_at(self, along_m: float) -> Pose:
        """Compute the crane's base at a distance along the route, with the frame at its lowest."""
        assert self._path is not None
        return self._base(self._path, along_m)

    def _route(self, location: Location, points: Sequence[Point2], plan: Callable[..., Path]) -> None:
        """Make the path by these points the active route; ``plan`` plans it."""
        points = list(points)
        if len(points) > 1 and math.dist((location.x_m, location.y_m), points[0]) < REACHED_M:
            del points[0]
        self._path = path = plan(location, points)
        self._active, self.length_m, self.along_m = (
            PathDrive(self._carrier, path, None, self._speed),
            path.length_m,
            0.0,
        )
        self._marks, low, before = [], 0.0, (location.x_m, location.y_m)
        for point in points:  # bends are shorter than their corners; farther on it may be the same place of another lap
            low, before = path.nearest(*point, low, low + math.dist(before, point) + 2.0 * AHEAD_M), point
            self._marks.append((low, point))

    def _ahead_path(self, location: Location, points: Sequence[Point2]) -> Path:
        """Plan a path by these points that starts in the machine's own direction."""
        position_m, yaw = (location.x_m, location.y_m), location.yaw_rad
        ahead = (position_m[0] + AHEAD_M * math.cos(yaw), position_m[1] + AHEAD_M * math.sin(yaw))
        return drivable_path([position_m, ahead, *points], self._carrier)

    def _aligned_path(self, location: Location, points: Sequence[Point2]) -> Path:
        """Plan a path by these points whose first leg roughly has the machine's direction."""
        path = self._direct_path(location, points)
        if abs(math.remainder(path.at(0.0)[2] - location.yaw_rad, math.tau)) > MAX_HEADING_ERROR_RAD:
            raise PathRefused(
                "path.heading",
                "the path starts too far off the direction in which the machine stands; drive it there by hand",
            )
        return path

    def _direct_path(self, location: Location, points: Sequence[Point2]) -> Path:
        """Plan a path by these points; the follower steers onto its first leg."""
        return drivable_path([(location.x_m, location.y_m), *points], self._carrier)

    def _base(self, path: Path, along_m: float) -> Pose:
        wheelbase = self._carrier.front_axle_m + self._carrier.rear_axle_m
        return base_on_path(self._carrier, path.at(along_m)[:3], path.at(along_m - wheelbase)[:2], 0.0)

    def _drive(self, drive: PathDrive | WaypointDrive) -> None:
        """Start this drive, or resume it."""
        if self._navigator.phase in (Phase.PAUSED, Phase.STOPPED) and self._navigator.active is drive:
            self._navigator.resume()
        else:
            self._navigator.drive(drive)


def _points(plane: LocalPlane, places: Iterable[Point]) -> list[Point2]:
    return [plane.local(p.latitude_deg, p.longitude_deg)[:2] for p in places]


def _position(plane: LocalPlane, point: Point2) -> Point:
    return Point(*plane.geodetic(*point)[:2])


_ALL_ROUND: Final = [2.0 * math.pi * k / DIRECTION_COUNT for k in range(DIRECTION_COUNT)]


def _lines_past(landing: Point2, directions: Iterable[float]) -> Iterator[list[Point2]]:
    """Yield straight lines past a landing in these directions, on both of its sides."""
    for angle in directions:
        c, s = math.cos(angle), math.sin(angle)
        for side in (LANDING_OFFSET_M, -LANDING_OFFSET_M):
            x, y = landing[0] - side * s, landing[1] + side * c
            yield [(x - BEFORE_M * c, y - BEFORE_M * s), (x + BEYOND_M * c, y + BEYOND_M * s)]
