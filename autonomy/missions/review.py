"""Review of a mission for a machine: length, duration, and warnings about what will be difficult."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from autonomy.missions.area import path_distance_m
from autonomy.missions.local_frame import LocalFrame, site_frame
from autonomy.missions.model import ForwardingMission, MissionError
from autonomy.missions.validation import MAX_SITE_DISTANCE_M, SWAPPED_HINT, Finding, area_of, legs, swapped_m
from machine.geometry.carrier import turning_radius_m
from machine.geometry.kinematics import max_reach_m
from machine.profile import Carrier, Profile

MIN_SWITCH_M: Final = 3.0
"""Least distance at which the next waypoint is selected (docs/reference/machines.md section 7.2: 3 to 4 m, else
R tan(turn / 2)).
"""
LOG_S: Final = 25.0
"""Duration in which an expert loads one log from the ground into the bunk (docs/reference/machines.md section 10)."""
SWAPPED_SHARE: Final = 0.5
"""A far mission whose axes look swapped is at most this share of its distance from the site with its axes exchanged."""
SHARPEST_RAD: Final = math.radians(150.0)
MAX_SHOWN: Final = 5


@dataclass(frozen=True, slots=True)
class Corner:
    """A bend of the route: its waypoint, its turn [rad], and how far before it the machine starts to turn [m]."""

    waypoint: int
    turn_rad: float
    switch_m: float


@dataclass(frozen=True, slots=True)
class Review:
    """Figures of a mission on a machine; lengths over all laps."""

    length_m: float
    drive_s: float
    logs: int
    crane_s: float
    corners: tuple[Corner, ...]
    warnings: tuple[Finding, ...]

    @property
    def total_s(self) -> float:
        """Duration of driving and loading."""
        return self.drive_s + self.crane_s


def review(mission: ForwardingMission, profile: Profile) -> Review:
    """Review a validated mission for a machine with a carrier.

    Raises:
        MissionError: the machine has no carrier.
    """
    carrier = profile.carrier
    if carrier is None:
        raise MissionError(
            "mission.stationary-machine", f"{profile.name} does not drive; choose a machine with a carrier"
        )
    frame = site_frame(mission)
    at = frame.points_enu(mission.waypoints)[:, :2]
    route_legs = legs(mission)
    laps = mission.options.laps
    lengths = [float(np.linalg.norm(at[j] - at[i])) for i, j in route_legs]
    closing = lengths[-1] if laps > 1 and len(route_legs) == len(at) else 0.0
    length = laps * sum(lengths) - closing
    speed = mission.options.speed_m_s or carrier.cruise_speed_m_s
    radius = turning_radius_m(carrier, carrier.articulation_limit_rad)
    corners = _corners(at, route_legs, radius)
    logs = _wanted(mission)
    warnings = [
        *_site(mission, carrier),
        *_speed(mission, carrier),
        *_tight(corners, route_legs, lengths, radius),
        *_room(mission, frame, carrier),
        *_logs(mission, frame, at, route_legs, profile),
        *_unlisted(mission),
    ]
    return Review(length, length / speed, logs, LOG_S * logs, corners, tuple(warnings))


def _wanted(mission: ForwardingMission) -> int:
    """Count the known logs to collect; when searching as in paper B, the places are filled again for every lap."""
    collected_assortments = mission.options.assortments
    logs = sum(1 for log in mission.logs if not collected_assortments or log.assortment in collected_assortments)
    if mission.options.logs == "search":
        logs *= mission.options.laps
    limit = mission.options.logs_wanted
    if limit is None:
        return logs
    return min(logs, limit) if logs else limit


def _corners(at: np.ndarray, route_legs: list[tuple[int, int]], radius_m: float) -> tuple[Corner, ...]:
    """List the corner at every waypoint between two legs."""
    corners = []
    follows = list(pairwise(route_legs))
    if len(route_legs) > 1 and route_legs[-1][1] == route_legs[0][0]:
        follows.append((route_legs[-1], route_legs[0]))
    for (a, b), (_, c) in follows:
        leg_before, leg_after = at[b] - at[a], at[c] - at[b]
        turn = abs(
            math.atan2(leg_before[0] * leg_after[1] - leg_before[1] * leg_after[0], float(leg_before @ leg_after))
        )
        switch = radius_m * math.tan(0.5 * turn) if turn < SHARPEST_RAD else math.inf
        corners.append(Corner(b, turn, max(switch, MIN_SWITCH_M)))
    return tuple(corners)


def _site(mission: ForwardingMission, carrier: Carrier) -> list[Finding]:
    origin = LocalFrame(carrier.site_lat_deg, carrier.site_lon_deg)
    away = float(np.linalg.norm(origin.points_enu(mission.waypoints[:1])))
    if away <= MAX_SITE_DISTANCE_M:
        return []
    far, first = f"it is {away / 1000:.0f} km from the site in the machine's profile", ("waypoint", 0)
    other = swapped_m(origin, mission.waypoints[0])
    if other < SWAPPED_SHARE * away:
        return [Finding(first, "mission.swapped-axes", f"{far}, exchanged {other / 1000:.0f} km; {SWAPPED_HINT}")]
    return [Finding(first, "mission.far-from-site", far)]


def _speed(mission: ForwardingMission, carrier: Carrier) -> list[Finding]:
    speed, height = mission.options.speed_m_s, mission.options.transport_height_m
    findings = []
    if speed is not None and speed > carrier.speed_limit_m_s:
        sentence = f"speed_m_s is {speed:g}; the machine drives at most {carrier.speed_limit_m_s:g} m/s"
        findings.append(Finding(None, "mission.speed-limit", sentence))
    if height is not None and height > carrier.arm_travel_m:
        sentence = f"transport_height_m is {height:g}; the swing arms lift {carrier.arm_travel_m:g} m"
        findings.append(Finding(None, "mission.height-limit", sentence))
    return findings


def _tight(
    corners: tuple[Corner, ...], route_legs: list[tuple[int, int]], lengths: list[float], radius_m: float
) -> list[Finding]:
    """Find corners that the machine cannot drive as drawn: too sharp, or with legs too short for the bends."""
    findings = []
    room = {corner.waypoint: corner.switch_m for corner in corners if math.isfinite(corner.switch_m)}
    for corner in corners:
        if math.isinf(corner.switch_m):
            findings.append(
                Finding(
                    ("waypoint", corner.waypoint),
                    "mission.turn-on-the-spot",
                    f"waypoint {corner.waypoint + 1}: the route turns by {math.degrees(corner.turn_rad):.0f} degrees "
                    f"on the spot; the machine's smallest circle has a radius of {radius_m:.1f} m, so draw a loop",
                )
            )
    for (i, j), length in zip(route_legs, lengths, strict=True):
        needed = room.get(i, 0.0) + room.get(j, 0.0)
        if length < needed:
            findings.append(
                Finding(
                    ("waypoint", j),
                    "mission.short-leg",
                    f"leg {i + 1} to {j + 1} is {length:.1f} m long and its corners need {needed:.1f} m at a turning "
                    f"radius of {radius_m:.1f} m; the machine will cut or overshoot them",
                )
            )
    return _few(findings)


def _room(mission: ForwardingMission, frame: LocalFrame, carrier: Carrier) -> list[Finding]:
    """Find waypoints so close to the fence that a wheel would leave it."""
    if not mission.fences:
        return [Finding(None, "mission.no-fence", "there is no fence; add one to keep the machine inside an area")]
    area = area_of(mission, frame)
    half = 0.5 * (carrier.track_width_m + carrier.wheel_width_m)
    at = frame.points_enu(mission.waypoints)[:, :2]
    rings = (*area.keep_in, *area.keep_out)
    near = np.min([path_distance_m(np.vstack([ring, ring[:1]]), at) for ring in rings], axis=0)
    return _few(
        [
            Finding(
                ("waypoint", i),
                "mission.close-to-fence",
                f"waypoint {i + 1} is {near[i]:.1f} m from the fence; the machine is {2 * half:.1f} m wide",
            )
            for i in np.flatnonzero(near < half).tolist()
        ]
    )


def _logs(
    mission: ForwardingMission, frame: LocalFrame, at: np.ndarray, route_legs: list[tuple[int, int]], profile: Profile
) -> list[Finding]:
    """Find logs that the crane cannot reach from the route, or that lie on the route."""
    if not mission.logs or not len(at) or profile.carrier is None:
        return []
    path = at[[route_legs[0][0], *(j for _, j in route_legs)]] if route_legs else at
    away = path_distance_m(path, frame.points_enu([log.position for log in mission.logs])[:, :2])
    reach = max_reach_m(profile)
    half = 0.5 * (profile.carrier.track_width_m + profile.carrier.wheel_width_m)
    far = [
        Finding(
            ("log", i),
            "mission.log-out-of-reach",
            f"log {i + 1} lies {away[i]:.1f} m from the route; the crane reaches {reach:.1f} m",
        )
        for i in np.flatnonzero(away > reach).tolist()
    ]
    known = np.array([(log.sigma_m or 0.0) < half for log in mission.logs])
    on_route = np.flatnonzero((away < half) & known).tolist()
    under = [
        Finding(("log", i), "mission.log-on-route", f"log {i + 1} lies on the route; the wheels would roll over it")
        for i in on_route
    ]
    return [*_few(far), *_few(under)]


def _unlisted(mission: ForwardingMission) -> list[Finding]:
    """Find assortments to collect that no listed log has."""
    listed = {log.assortment for log in mission.logs}
    return _few(
        [
            Finding(None, "mission.unlisted-assortment", f'no log is "{name}", which is to be collected')
            for name in mission.options.assortments
            if name not in listed
        ]
    )


def _few(warnings: list[Finding]) -> list[Finding]:
    """Return the first few of many warnings of one kind."""
    more = len(warnings) - MAX_SHOWN
    if more <= 0:
        return warnings
    return [*warnings[:MAX_SHOWN], Finding(None, warnings[-1].code, f"and {more} more like the last")]
