"""What a mission tells those who watch it: the manager's state as a `MissionReport`, cut to what one datagram takes.

Long routes and fences keep their first and last point and lose others evenly; of many logs those nearest to the machine
are told, of those given up the last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, TypeVar

import numpy as np
import pymap3d

from autonomy.crane_job.phases import Phase
from autonomy.localization.plane import Plane
from autonomy.manager.manager import Manager
from autonomy.manager.table import ENDS, EVENTS
from autonomy.manager.world_model import ATTEMPTS
from autonomy.missions.local import bearing_from_yaw
from autonomy.missions.model import ForwardingMission, Point
from can_dbc.mission_datagrams import (
    MAX_CORNERS,
    MAX_FENCES,
    MAX_GIVEN_UP,
    MAX_LANDINGS,
    MAX_LOGS,
    MAX_ROUTE,
    MAX_TARGETS,
    MAX_TEXT,
    Area,
    GivenUp,
    LatLon,
    Lying,
    MissionReport,
    Pile,
    Whereabouts,
)

DIGITS: Final = 8
"""Of a degree: about a millimetre."""
CRANE: Final = {
    Phase.WAIT: "",
    Phase.LOOK: "looks for the log",
    Phase.ABOVE: "moves above the log",
    Phase.DESCEND: "goes down to the log",
    Phase.CLOSE: "grips the log",
    Phase.LIFT: "lifts the log",
    Phase.CARRY: "carries the log",
    Phase.LOWER: "lowers the log",
    Phase.OPEN: "lets the log go",
    Phase.RETREAT: "leaves the load",
    Phase.STOW: "goes over the bunk",
    Phase.DONE: "is done",
    Phase.FAILED: "has given up",
}
T = TypeVar("T")


class Voice:
    """Speaks for one manager and its mission."""

    def __init__(self, manager: Manager, mission: ForwardingMission) -> None:
        self._manager = manager
        self._name = _text(mission.name)
        self._route = tuple(map(_place, _thinned(mission.waypoints, MAX_ROUTE)))
        self._closed = mission.options.laps > 1
        fences = mission.fences[:MAX_FENCES]
        share = MAX_CORNERS // max(1, len(fences))
        self._fences = tuple(
            Area(tuple(map(_place, _thinned(f.corners, share))), f.keep_out, _text(f.name)) for f in fences
        )
        self._landings = tuple(Pile(_place(x.position), _text(x.name)) for x in mission.landings[:MAX_LANDINGS])

    def report(self, now_ns: int, auto: bool, order: int = 0, refusal: str = "") -> MissionReport:
        """How it stands now; ``auto``: where the switch is; ``order`` and ``refusal`` are those of the last order."""
        manager, tally = self._manager, self._manager.tally
        given_up = list(tally.given_up.items())[-MAX_GIVEN_UP:]
        activity = manager.activity
        return MissionReport(
            schema=1,
            name=self._name,
            state=manager.state.name,
            words=_text(manager.words),
            ended=manager.state in ENDS,
            auto=auto,
            single_step=manager.single_step,
            paused="" if manager.state in ENDS else _text(manager.paused),
            waits_for="" if manager.waiting is None else EVENTS[manager.waiting],
            failure=_text(manager.failure),
            order=order,
            refusal=_text(refusal),
            loaded=tally.loaded,
            on_board=tally.on_board,
            on_board_m3=round(tally.board_m3, 3),
            unloaded=tally.unloaded,
            missed=tally.missed,
            given_up=tuple(GivenUp(number, _text(reason)) for number, reason in given_up),
            driven_m=round(manager.ride.driven_m, 1),
            targets=self._targets(),
            crane="" if activity is None else CRANE[activity.phase],
            here=self._here(),
            route=self._route,
            closed=self._closed,
            fences=self._fences,
            landings=self._landings,
            logs=self._logs(now_ns),
        )

    def _targets(self) -> tuple[int, ...]:
        """The logs of the grasp; before there is one, what the machine drives to or stands beside."""
        manager = self._manager
        if manager.activity is None or manager.activity.grasp is None:
            return () if manager.target is None else (manager.target,)
        numbers = (manager.outlook.number_of(log.id) for log in manager.activity.grasp.logs)
        return tuple(number for number in numbers if number is not None)[:MAX_TARGETS]

    def _here(self) -> Whereabouts | None:
        location = self._manager.outlook.location
        if location is None or not location.usable:
            return None
        (place,) = _degrees(self._manager.outlook.plane, [(location.x_m, location.y_m)])
        heading = round(bearing_from_yaw(location.yaw_rad), 2)
        return Whereabouts(place, heading, round(location.sigma_m, 3))

    def _logs(self, now_ns: int) -> tuple[Lying, ...]:
        outlook = self._manager.outlook
        location, logs = outlook.location, list(outlook.field.logs)
        if not logs:  # nor need there be a plane
            return ()
        if len(logs) > MAX_LOGS and location is not None and location.usable:
            here = (location.x_m, location.y_m)
            logs.sort(key=lambda log: math.dist(here, log.center_m[:2]))
        logs = logs[:MAX_LOGS]
        return tuple(
            Lying(
                log.number,
                place,
                round(bearing_from_yaw(math.atan2(log.axis[1], log.axis[0])), 1),
                round(log.length_m, 2),
                round(log.diameter_m, 3),
                round(max(0, now_ns - log.seen_ns) * 1e-9, 1),
                log.misses,
                log.misses >= ATTEMPTS,
            )
            for log, place in zip(logs, _degrees(outlook.plane, [log.center_m[:2] for log in logs]), strict=True)
        )


def _thinned(items: Sequence[T], most: int) -> list[T]:
    """At most so many, evenly, with the first and the last."""
    if len(items) <= most:
        return list(items)
    return [items[round(k * (len(items) - 1) / (most - 1))] for k in range(most)]


def _place(point: Point) -> LatLon:
    return round(point.latitude_deg, DIGITS), round(point.longitude_deg, DIGITS)


def _degrees(plane: Plane, points: Sequence[Sequence[float] | np.ndarray]) -> list[LatLon]:
    """Places of points of the plane; all at once, for one by one they would cost the planner tens of ms."""
    if not points:
        return []
    east, north = np.array(points, dtype=float).T
    origin = (plane.latitude_deg, plane.longitude_deg, plane.altitude_m)
    latitude, longitude, _ = pymap3d.enu2geodetic(east, north, np.zeros_like(east), *origin)
    return [(round(a, DIGITS), round(b, DIGITS)) for a, b in zip(latitude.tolist(), longitude.tolist(), strict=True)]


def _text(text: str) -> str:
    """Cut to what fits, in bytes; what cannot be printed would take many of them."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    if len(plain.encode()) <= MAX_TEXT:
        return plain
    return plain.encode()[: MAX_TEXT - len("…".encode())].decode(errors="ignore") + "…"
