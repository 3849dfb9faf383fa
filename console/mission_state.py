"""The page's state of a mission and its vehicle; pure, like `console.state`.

Map data are in metres east and north of one origin (`machine.geometry.map_projection`), angles in radians
counter-clockwise from east.  A mission report is accepted when it is for this machine and newer than the last one; it
is shown with its age.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import KnownLog, LatLon, MissionReport, decode_mission
from can_dbc.messages.vehicle import VEHICLE_INPUTS, Driving, VehicleReport
from machine.geometry.carrier import axis_from_antenna
from machine.geometry.map_projection import MapProjection, Metres
from machine.profile import Profile

MISSION_TIMEOUT_NS: Final = 2_000_000_000
"""Without a mission report for this long the planner is shown as disconnected; it reports twice a second."""
VEHICLE_TIMEOUT_NS: Final = 500_000_000
"""Without a vehicle report for this long the vehicle is shown as disconnected; it reports 20 times a second."""
MAX_FUTURE_NS: Final = 1_000_000_000
TRAIL_M: Final = 0.25
TRAIL_POINTS: Final = 8_000
"""Two kilometres of track."""
FIXES: Final = {
    0: "no position",
    1: "GNSS fix",
    2: "DGNSS fix",
    3: "precise GNSS",
    4: "RTK fixed",
    5: "RTK float",
    6: "estimated",
}
"""GNSS methods of PGN 129029."""
DRIVING: Final = {Driving.STANDING: "standing", Driving.DRIVING: "driving", Driving.BRAKING: "braking"}
INPUT_NAMES: Final = dict(
    zip(
        VEHICLE_INPUTS,
        (
            "vehicle state",
            "front arms",
            "rear arms",
            "position",
            "heading",
            "turn rate",
            "position quality",
            "articulation",
        ),
        strict=True,
    )
)


def describe_carrier(profile: Profile) -> dict[str, Any] | None:
    """Return dimensions for map and 3-D view [m, rad], and how much of its track is kept; None if stationary."""
    c = profile.carrier
    if c is None:
        return None
    names = (
        "front_axle_m",
        "rear_axle_m",
        "track_width_m",
        "wheel_radius_m",
        "wheel_width_m",
        "crane_base_m",
        "crane_yaw_rad",
        "arm_drop_low_m",
        "arm_travel_m",
        "arm_transport_m",
        "tilt_limit_rad",
    )
    return {name: getattr(c, name) for name in names} | {"trail_points": TRAIL_POINTS}


class MissionState:
    """Accepts mission and vehicle reports and returns the page's state of them."""

    def __init__(
        self, profile: Profile, profile_hash: int, key: bytes | None = None, ground: MapProjection | None = None
    ) -> None:
        """Share the projection ``ground`` where one is given, as the views of one recording do."""
        self.report_count = 0
        """Accepted mission reports: the mission is sent to the page when this has changed."""
        self.answer = (0, "", "")
        """Number of the planner's last command or upload, why it was refused, and the code."""
        self.trail: deque[Metres] = deque(maxlen=TRAIL_POINTS)
        """Track of the articulation axis."""
        self._carrier = profile.carrier
        self._hash, self._key = profile_hash, key
        self._ground = ground or MapProjection()
        self._mission: MissionReport | None = None
        self._stamp_ns = self._report_ns = self._received_ns = self._placed_ns = 0
        self._vehicle: VehicleReport | None = None
        self._place: dict[str, float] | None = None

    def on_mission(self, datagram: bytes, now_ns: int) -> bool:
        """Accept a datagram; False when it is not a newer report of this machine's mission."""
        try:
            profile_hash, stamp_ns, report = decode_mission(datagram, self._key)
        except DatagramRefused:
            return False
        if profile_hash != self._hash or not self._stamp_ns < stamp_ns <= now_ns + MAX_FUTURE_NS:
            return False
        self._mission, self._stamp_ns, self._report_ns = report, stamp_ns, now_ns
        self.answer = (report.order, report.refusal, report.refusal_code)
        self.report_count += 1
        return True

    def on_vehicle(self, report: VehicleReport, now_ns: int) -> None:
        """Accept a vehicle report."""
        self._vehicle, self._received_ns = report, now_ns
        pose = self._placed(report)
        if pose is None:
            return
        self._place, self._placed_ns = pose, now_ns
        position_m = (pose["x_m"], pose["y_m"])
        if not self.trail or math.dist(position_m, self.trail[-1]) >= TRAIL_M:
            self.trail.append(position_m)

    @property
    def stamp_ns(self) -> int:
        """When the planner made the newest mission report, 0 before the first."""
        return self._stamp_ns

    @property
    def place(self) -> dict[str, float] | None:
        """Where the vehicle was last known to be; None before that and for a stationary machine."""
        return self._place

    @property
    def report(self) -> MissionReport:
        """The newest mission report; there must have been one."""
        assert self._mission is not None
        return self._mission

    def alive(self, now_ns: int) -> bool:
        """Tell whether the planner is connected."""
        return self._mission is not None and now_ns - self._report_ns < MISSION_TIMEOUT_NS

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return the part of every page state: the vehicle, and the age of the mission report."""
        age_s = None if self._mission is None else round((now_ns - self._report_ns) * 1e-9, 1)
        return {"mission_age_s": age_s, "mission_alive": self.alive(now_ns), "vehicle": self._vehicle_state(now_ns)}

    def mission(self) -> dict[str, Any] | None:
        """Return the newest mission report; None before the first."""
        m = self._mission
        if m is None:
            return None
        same = (
            "name",
            "state",
            "words",
            "ended",
            "auto",
            "single_step",
            "paused",
            "waits_for",
            "failure",
            "refusal",
            "loaded",
            "on_board",
            "on_board_m3",
            "unloaded",
            "missed",
            "driven_m",
            "targets",
            "crane",
            "closed",
        )
        return {name: getattr(m, name) for name in same} | {
            "given_up": [{"log": g.log, "reason": g.reason} for g in m.given_up],
            "sigma_m": None if m.here is None else m.here.sigma_m,
            "route": [self._metres(p) for p in m.route],
            "fences": [
                {"corners": [self._metres(p) for p in f.corners], "keep_out": f.keep_out, "name": f.name}
                for f in m.fences
            ],
            "landings": [{"at": self._metres(x.place), "name": x.name} for x in m.landings],
            "logs": [self._log(log) for log in m.logs],
        }

    def _log(self, log: KnownLog) -> dict[str, Any]:
        return {
            "number": log.number,
            "at": self._metres(log.place),
            "yaw_rad": round(math.radians(90.0 - log.bearing_deg), 4),
            "length_m": log.length_m,
            "diameter_m": log.diameter_m,
            "age_s": log.age_s,
            "misses": log.misses,
            "given_up": log.given_up,
        }

    def _metres(self, place: LatLon) -> Metres:
        return self._ground.metres(*place)

    def _placed(self, r: VehicleReport) -> dict[str, float] | None:
        """Compute the articulation axis and the directions of both halves; None unless all of it is known."""
        known = (r.latitude_deg, r.longitude_deg, r.heading_rad, r.articulation_rad)
        if self._carrier is None or not all(map(math.isfinite, known)):
            return None
        east, north = self._ground.metres(r.latitude_deg, r.longitude_deg)
        yaw = 0.5 * math.pi - r.heading_rad
        x, y = axis_from_antenna(self._carrier, (east, north), r.heading_rad)
        return {
            "x_m": round(x, 3),
            "y_m": round(y, 3),
            "front_rad": round(math.remainder(yaw, math.tau), 4),
            "rear_rad": round(math.remainder(yaw - r.articulation_rad, math.tau), 4),
        }

    def _vehicle_state(self, now_ns: int) -> dict[str, Any] | None:
        r = self._vehicle
        if r is None:
            return None
        return {
            "age_s": round((now_ns - self._received_ns) * 1e-9, 1),
            "alive": now_ns - self._received_ns < VEHICLE_TIMEOUT_NS,
            "place": self._place,
            "place_alive": self._place is not None and now_ns - self._placed_ns < VEHICLE_TIMEOUT_NS,
            "driving": DRIVING.get(Driving(r.driving), "?") if r.driving in set(Driving) else "?",
            "speed_m_s": _number(r.speed_m_s),
            "heading_deg": _number(math.degrees(r.heading_rad)),
            "articulation_deg": _number(math.degrees(r.articulation_rad)),
            "roll_deg": _number(math.degrees(r.roll_rad)),
            "pitch_deg": _number(math.degrees(r.pitch_rad)),
            "heights_m": [_number(h) for h in r.heights_m],
            "fix": FIXES.get(r.fix, f"method {r.fix}"),
            "satellites": r.satellites,
            "sigma_m": _number(r.sigma_m),
            "stale": [INPUT_NAMES[name] for bit, name in enumerate(VEHICLE_INPUTS) if r.stale_mask >> bit & 1],
            "refused": r.refused,
        }


def _number(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
