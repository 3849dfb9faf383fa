"""One mission, or the calibration of the individual that drives it, as plain data."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, Final

import msgspec

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, KnownLog, Point
from experiments.common.individuals import calibrated
from experiments.common.mission_trial import run_mission
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from hil.missions.site import site_of

ALONG_M: Final = 0.5
"""Maximum shift of a log along the route on a shuffled field."""
ACROSS_M: Final = 0.25
"""Maximum shift of a log across the route on a shuffled field."""
TURN_DEG: Final = 15.0
"""Maximum turn of a log on a shuffled field."""
SHORT_M: Final = 17.0


def perform(job: Job) -> dict[str, Any]:
    """Run a job of either kind."""
    return calibrated(job) if job.kind == "calibration" else drive(job)


def drive(job: Job) -> dict[str, Any]:
    """Drive one mission.

    ``options``: profile (shipped name), truth, way (method), eyes (detector), file (of the mission), shuffled (whether
    the logs are shifted, with the seed ``field``), short (whether only the first log is loaded), text (of the
    calibrated profile; None: as shipped), limit_s.
    """
    o = job.options
    mission = load_mission(Path(o["file"]), route_wanted=True).mission
    if o.get("short"):
        mission = short(mission)
    if o["shuffled"]:
        mission = shuffled(mission, o["field"])
    shipped = profile_named(o["profile"])
    site = site_of(mission, shipped, o.get("field", job.seed), o["truth"])
    return run_mission(job, mission, site)


def shuffled(mission: ForwardingMission, seed: int) -> ForwardingMission:
    """The same mission with every log shifted and turned; one seed gives one field."""
    rng = random.Random(f"field {seed}")
    first = mission.waypoints[0]
    plane = LocalPlane(first.latitude_deg, first.longitude_deg)
    return msgspec.structs.replace(mission, logs=tuple(_elsewhere(log, plane, rng) for log in mission.logs))


def short(mission: ForwardingMission) -> ForwardingMission:
    """A short version: ``SHORT_M`` of the first leg, the first log, one lap."""
    first, second = mission.waypoints[:2]
    plane = LocalPlane(first.latitude_deg, first.longitude_deg)
    x, y, _ = plane.local(second.latitude_deg, second.longitude_deg)
    share = SHORT_M / math.hypot(x, y)
    lat, lon, _ = plane.geodetic(share * x, share * y)
    options = msgspec.structs.replace(mission.options, laps=1)
    return msgspec.structs.replace(
        mission, waypoints=(first, Point(lat, lon)), logs=mission.logs[:1], fences=(), options=options
    )


def _elsewhere(log: KnownLog, plane: LocalPlane, rng: random.Random) -> KnownLog:
    x, y, _ = plane.local(log.position.latitude_deg, log.position.longitude_deg)
    x, y = x + rng.uniform(-ALONG_M, ALONG_M), y + rng.uniform(-ACROSS_M, ACROSS_M)
    turn = rng.uniform(-TURN_DEG, TURN_DEG)
    bearing = None if log.bearing_deg is None else math.fmod(log.bearing_deg + turn + 360.0, 360.0)
    lat, lon, _ = plane.geodetic(x, y)
    return msgspec.structs.replace(log, position=Point(lat, lon), bearing_deg=bearing)
