"""One drive of the whole machine in lockstep: from a start along the waypoints, by one of the two methods.

The planner is the autonomy's own: localizer, navigator and path, fed with the controller's reports.  The outcome holds
the ground truth of the plant and the machine's own estimates, ten times a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.localizer import Localizer
from autonomy.localization.location import Location, Status
from autonomy.navigation.joining_path import joining_path
from autonomy.navigation.navigator import Navigator, Phase
from autonomy.navigation.path_drive import PathDrive
from autonomy.navigation.waypoint_drive import Waypoint, WaypointDrive
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import VehicleReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.common.pool import Job
from experiments.common.recording import recorder_of
from experiments.common.worlds import CarrierPose, place, profile_named
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from machine.loading.profile_file import profile_hash
from machine.profile import Profile
from machine.status.modes import Mode
from recorder.recorder import Recorder
from sim.plant import Plant

LIMIT_NS: Final = 1_200_000_000_000
REST_NS: Final = 1_000_000_000
KEEP_EVERY: Final = 2
"""Every second report is stored."""
COLUMNS: Final = (
    "t_s",
    "x_m",
    "y_m",
    "yaw_rad",
    "bend_rad",
    "speed_m_s",
    "seen_x_m",
    "seen_y_m",
    "seen_yaw_rad",
    "sigma_m",
    "s_m",
    "off_m",
    "goal",
    "wanted_rad",
    "roll_rad",
)


class NavigationPlanner:
    """Waits until the machine is armed and located, drives, and stores the samples."""

    def __init__(self, profile: Profile, plane: LocalPlane, points: Sequence[tuple[float, float]], way: str) -> None:
        assert profile.carrier is not None
        self.rows: list[list[float]] = []
        self.navigator = Navigator(profile.carrier, profile_hash(profile))
        self.localizer = Localizer(profile.carrier, plane)
        self.way: PathDrive | WaypointDrive | None = None
        self.location: Location | None = None
        self._carrier, self._plane, self._points, self._kind = profile.carrier, plane, points, way
        self.begin: CarrierPose = (math.nan,) * 3
        self._fresh: VehicleReport | None = None
        self._armed = False
        self._count = 0
        self.truth: Any = None
        """The plant's carrier, for the samples only."""

    def receive(self, report: VehicleReport) -> None:
        """Receive a report of the vehicle."""
        self._fresh = report

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        """Return the setpoint to send now."""
        vehicle, self._fresh = self._fresh, None
        if report is not None:
            self._armed = report.mode in (Mode.ARMED, Mode.ACTIVE)
        if vehicle is None:
            return None
        self.location = location = self.localizer.step(vehicle)
        if self.way is None and location.status is Status.TRACKING and self._armed:
            self.way = self._begin(location)
            self.navigator.drive(self.way)
        setpoint = self.navigator.step(now_ns, vehicle, location)
        self._keep(now_ns, location)
        return None if setpoint is None else encode(setpoint)

    @property
    def over(self) -> bool:
        """Whether the drive has ended."""
        return self.navigator.phase in (Phase.ARRIVED, Phase.STOPPED)

    def _begin(self, location: Location) -> PathDrive | WaypointDrive:
        position = (location.x_m, location.y_m)
        self.begin = (*position, location.yaw_rad)
        if self._kind == "faithful":
            geodetic_points = [self._plane.geodetic(*point)[:2] for point in self._points]
            return WaypointDrive(self._carrier, [Waypoint(*geodetic_point) for geodetic_point in geodetic_points])
        return PathDrive(self._carrier, joining_path(position, location.yaw_rad, self._points, self._carrier))

    def _keep(self, now_ns: int, location: Location) -> None:
        self._count += 1
        if self.way is None or self._count % KEEP_EVERY:
            return
        c = self.truth
        x, y, _ = c.front_axle()
        steer = self.way.steer if isinstance(self.way, PathDrive) else None
        goal = self.way.number if isinstance(self.way, WaypointDrive) else -1
        own = (steer.s_m, steer.off_m) if steer else (math.nan, math.nan)
        target_articulation_rad = steer.articulation_rad if steer else math.nan
        self.rows.append(
            [
                (now_ns - START_NS) * 1e-9,
                x,
                y,
                c.heading_rad,
                c.articulation_rad,
                c.speed_m_s,
                location.x_m,
                location.y_m,
                location.yaw_rad,
                location.sigma_m if location.usable else math.nan,
                *own,
                goal,
                target_articulation_rad,
                c.roll_rad,
            ]
        )


def perform(job: Job) -> dict[str, Any]:
    """Make one drive; ``options``: profile, truth, terrain, way, pose (x, y, yaw of the front axle), points."""
    profile = profile_named(job.options["profile"])
    with recorder_of(job, profile, profile_path(job.options["profile"])) as recorder:
        return _driven(job, profile, recorder)


def _driven(job: Job, profile: Profile, recorder: Recorder | None) -> dict[str, Any]:
    o = job.options
    carrier = profile.carrier
    assert carrier is not None
    settings = Settings(profile, profile_hash(profile), profile.rate_hz)
    plant = Plant(profile, job.seed, o["truth"], scene=(), terrain=o["terrain"])
    try:
        place(plant, o["pose"])
        plane = LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg, o.get("altitude_m", 0.0))
        planner = NavigationPlanner(profile, plane, [(x, y) for x, y in o["points"]], o["way"])
        planner.truth = plant.world.carrier
        operator = Operator(profile_hash(profile), lambda *_: None)
        observer = Observer(recorder, [], [planner.receive])
        system = Lockstep(settings, build_guard(profile_path(o["profile"])), plant, planner, operator, observer)
        while not planner.over and not operator.gave_up and system.now_ns < START_NS + LIMIT_NS:
            system.advance()
        ended_ns, phase = system.now_ns, planner.navigator.phase
        while system.now_ns < ended_ns + REST_NS:
            system.advance()
        body = plant.world.carrier
        assert body is not None
        at = body.front_axle()
        return {
            "rows": [[round(v, 5) if math.isfinite(v) else None for v in row] for row in planner.rows],
            "arrived": phase is Phase.ARRIVED,
            "reason": planner.navigator.reason,
            "stops": operator.stops,
            "begin": list(planner.begin),
            "rest_m": [at[0], at[1]],
            "rejected": planner.localizer.rejected,
            "seconds": (ended_ns - START_NS) * 1e-9,
        }
    finally:
        plant.close()
