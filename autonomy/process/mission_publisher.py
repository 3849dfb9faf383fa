"""The mission report: the manager's state, limited to the size of one datagram.

Long routes and fences are thinned evenly and keep their first and last point.  Of many mapped logs the nearest ones are
reported, of the given-up ones the last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from math import cos, sin
from typing import Final, Protocol, TypeVar

import numpy as np
import pymap3d

from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from autonomy.localization.local_plane import LocalPlane
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.transition_table import EVENT_DESCRIPTIONS, FINAL_STATES
from autonomy.manager.world_model import MAX_ATTEMPTS
from autonomy.missions.local_frame import bearing_from_yaw
from autonomy.missions.model import ForwardingMission, Point
from can_dbc.messages.mission import (
    MAX_CORNERS,
    MAX_FENCES,
    MAX_GIVEN_UP,
    MAX_GRASP_LOGS,
    MAX_LANDINGS,
    MAX_LOGS,
    MAX_REASON_CHARS,
    MAX_ROUTE_POINTS,
    MAX_TARGETS,
    MAX_TEXT_CHARS,
    AbandonedLog,
    ChosenGrasp,
    Fence,
    KnownLog,
    Landing,
    LatLon,
    MachinePose,
    MissionReport,
)
from machine.geometry.grapple import grapple_yaw
from machine.profile import Profile

DEGREE_DECIMALS: Final = 8
"""Decimal places of a degree: about a millimetre."""
CRANE_PHASES: Final = {
    Phase.WAIT: "",
    Phase.LOOK: "detects the log",
    Phase.ABOVE: "moves above the log",
    Phase.DESCEND: "descends to the log",
    Phase.CLOSE: "grips the log",
    Phase.LIFT: "lifts the log",
    Phase.CARRY: "carries the log",
    Phase.LOWER: "lowers the log",
    Phase.OPEN: "releases the log",
    Phase.RETREAT: "retreats from the load",
    Phase.STOW: "moves over the bunk",
    Phase.DONE: "is done",
    Phase.FAILED: "has failed",
}
T = TypeVar("T")


class MissionPublisher:
    """Makes the reports of one manager and its mission."""

    def __init__(self, manager: ActivityManager, mission: ForwardingMission) -> None:
        self._manager = manager
        self._name = short_text(mission.name)
        self._route = tuple(map(_place, _thinned(mission.waypoints, MAX_ROUTE_POINTS)))
        self._closed = mission.options.laps > 1
        fences = mission.fences[:MAX_FENCES]
        share = MAX_CORNERS // max(1, len(fences))
        self._fences = tuple(
            Fence(tuple(map(_place, _thinned(f.corners, share))), f.keep_out, short_text(f.name)) for f in fences
        )
        self._landings = tuple(Landing(_place(x.position), short_text(x.name)) for x in mission.landings[:MAX_LANDINGS])

    def report(
        self, now_ns: int, auto: bool, order: int = 0, refusal: str = "", refusal_code: str = ""
    ) -> MissionReport:
        """Make the report; ``order``, ``refusal`` and ``refusal_code`` are those of the last command."""
        manager, tally = self._manager, self._manager.tally
        given_up = list(tally.given_up.items())[-MAX_GIVEN_UP:]
        activity = manager.activity
        return MissionReport(
            schema=1,
            name=self._name,
            state=manager.state.name,
            words=short_text(manager.description),
            ended=manager.state in FINAL_STATES,
            auto=auto,
            single_step=manager.single_step,
            paused="" if manager.state in FINAL_STATES else short_text(manager.paused),
            waits_for="" if manager.pending_event is None else EVENT_DESCRIPTIONS[manager.pending_event],
            failure=short_text(manager.failure),
            order=order,
            refusal=short_text(refusal),
            refusal_code=refusal_code,
            loaded=tally.loaded,
            on_board=tally.on_board,
            on_board_m3=round(tally.board_m3, 3),
            unloaded=tally.unloaded,
            missed=tally.missed,
            given_up=tuple(AbandonedLog(number, short_text(reason)) for number, reason in given_up),
            driven_m=round(manager.route.driven_m, 1),
            targets=self._targets(),
            crane="" if activity is None else CRANE_PHASES[activity.phase],
            here=self._here(),
            route=self._route,
            closed=self._closed,
            fences=self._fences,
            landings=self._landings,
            logs=self._logs(now_ns),
        )

    def _targets(self) -> tuple[int, ...]:
        """Return the logs of the grasp; without one, the log that the machine drives to."""
        manager = self._manager
        if manager.activity is None or manager.activity.grasp is None:
            return () if manager.target is None else (manager.target,)
        numbers = (manager.world.map_number(log.id) for log in manager.activity.grasp.logs)
        return tuple(number for number in numbers if number is not None)[:MAX_TARGETS]

    def _here(self) -> MachinePose | None:
        location = self._manager.world.location
        if location is None or not location.usable:
            return None
        (position,) = _degrees(self._manager.world.plane, [(location.x_m, location.y_m)])
        heading = round(bearing_from_yaw(location.yaw_rad), 2)
        return MachinePose(position, heading, round(location.sigma_m, 3))

    def _logs(self, now_ns: int) -> tuple[KnownLog, ...]:
        world = self._manager.world
        location, logs = world.location, list(world.log_map.logs)
        if not logs:  # there may be no plane yet
            return ()
        if len(logs) > MAX_LOGS and location is not None and location.usable:
            position_m = (location.x_m, location.y_m)
            logs.sort(key=lambda log: math.dist(position_m, log.center_m[:2]))
        logs = logs[:MAX_LOGS]
        return tuple(
            KnownLog(
                log.number,
                position,
                round(bearing_from_yaw(math.atan2(log.axis[1], log.axis[0])), 1),
                round(log.length_m, 2),
                round(log.diameter_m, 3),
                round(max(0, now_ns - log.seen_ns) * 1e-9, 1),
                log.misses,
                log.misses >= MAX_ATTEMPTS,
            )
            for log, position in zip(logs, _degrees(world.plane, [log.center_m[:2] for log in logs]), strict=True)
        )


def _thinned(items: Sequence[T], limit: int) -> list[T]:
    """Return at most ``limit`` items, evenly spaced, with the first and the last."""
    if len(items) <= limit:
        return list(items)
    return [items[round(k * (len(items) - 1) / (limit - 1))] for k in range(limit)]


def _place(point: Point) -> LatLon:
    return round(point.latitude_deg, DEGREE_DECIMALS), round(point.longitude_deg, DEGREE_DECIMALS)


def _degrees(plane: LocalPlane, points: Sequence[Sequence[float] | np.ndarray]) -> list[LatLon]:
    """Compute the WGS84 positions of points of the plane; converted together, because single conversions would take
    tens of ms.
    """
    if not points:
        return []
    east, north = np.array(points, dtype=float).T
    origin = (plane.latitude_deg, plane.longitude_deg, plane.altitude_m)
    latitude, longitude, _ = pymap3d.enu2geodetic(east, north, np.zeros_like(east), *origin)
    return [
        (round(a, DEGREE_DECIMALS), round(b, DEGREE_DECIMALS))
        for a, b in zip(latitude.tolist(), longitude.tolist(), strict=True)
    ]


def short_text(text: str) -> str:
    """Limit the text to the field's bytes; unprintable characters become spaces."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    if len(plain.encode()) <= MAX_TEXT_CHARS:
        return plain
    return plain.encode()[: MAX_TEXT_CHARS - len("…".encode())].decode(errors="ignore") + "…"


# -- The chosen grasp of a crane job as it is shown to a person.

SHOWN_PHASES: Final = (Phase.ABOVE, Phase.DESCEND, Phase.CLOSE)
"""From the choice until the jaws have closed; afterwards the logs are no longer where the grasp was planned."""


class CraneJobState(Protocol):
    """`autonomy.crane_job.activity.Activity`."""

    phase: Phase

    @property
    def profile(self) -> Profile: ...

    @property
    def grasp(self) -> Grasp | None: ...


def chosen_grasp(activity: CraneJobState | None) -> ChosenGrasp | None:
    """Return the grasp of a crane job, None without one or when it is over; of None no crane job runs."""
    if activity is None or activity.grasp is None or activity.phase not in SHOWN_PHASES:
        return None
    profile, grasp, pose = activity.profile, activity.grasp, activity.grasp.pose
    theta = pose.slew_rad + profile.kinematics.theta1_offset_rad
    x_m, y_m, z_m = (round(float(v), 4) for v in (pose.r_m * cos(theta), pose.r_m * sin(theta), pose.z_m))
    return ChosenGrasp(
        1,
        (x_m, y_m, z_m),
        round(float(grapple_yaw(profile, (pose.slew_rad, 0.0, 0.0, pose.ext_m, pose.rot_rad))), 4),
        tuple(log.id for log in grasp.logs[:MAX_GRASP_LOGS]),
        grasp.reason[:MAX_REASON_CHARS],
    )
