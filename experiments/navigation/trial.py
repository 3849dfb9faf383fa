"""One drive of the whole machine in lockstep: from a start along the waypoints, by one of the two methods.

The planner is the autonomy's own: localizer, navigator and path, fed with the controller's reports.  The outcome holds
the ground truth of the plant and the machine's own estimates, ten times a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.location import Location
from autonomy.navigation.joining_path import joining_path
from autonomy.navigation.navigator import Navigator, Phase
from autonomy.navigation.path_drive import PathDrive
from autonomy.navigation.waypoint_drive import Waypoint, WaypointDrive
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.common.carrier_driver import CarrierDriver, Drive
from experiments.common.pool import Job
from experiments.common.recording import recorder_of
from experiments.common.worlds import CarrierPose, place, profile_named
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from machine.loading.profile_file import profile_hash
from machine.profile import Profile
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


class NavigationPlanner(CarrierDriver):
    """Drives along the points, and stores the samples."""

    def __init__(self, profile: Profile, plane: LocalPlane, points: Sequence[tuple[float, float]], way: str) -> None:
        assert profile.carrier is not None
        super().__init__(profile.carrier, plane, Navigator(profile.carrier, profile_hash(profile)))
        self.rows: list[list[float]] = []
        self._plane, self._points, self._kind = plane, points, way
        self.begin: CarrierPose = (math.nan,) * 3
        self._count = 0
        self.truth: Any = None
        """The plant's carrier, for the samples only."""

    def begin_drive(self, location: Location) -> Drive:
        """Return the drive from a location along the points."""
        position = (location.x_m, location.y_m)
        self.begin = (*position, location.yaw_rad)
        if self._kind == "faithful":
            geodetic_points = [self._plane.geodetic(*point)[:2] for point in self._points]
            return WaypointDrive(self.carrier, [Waypoint(*geodetic_point) for geodetic_point in geodetic_points])
        return PathDrive(self.carrier, joining_path(position, location.yaw_rad, self._points, self.carrier))

    def sample(self, now_ns: int, location: Location) -> None:
        """Store every second sample of the drive."""
        self._count += 1
        if self.drive is None or self._count % KEEP_EVERY:
            return
        c = self.truth
        x, y, _ = c.front_axle()
        steer = self.drive.steer if isinstance(self.drive, PathDrive) else None
        goal = self.drive.number if isinstance(self.drive, WaypointDrive) else -1
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
