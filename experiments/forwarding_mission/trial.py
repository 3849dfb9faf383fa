"""One mission with a judge beside the machine, or the calibration of the individual that drives it: plain data."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, Final

import msgspec

from autonomy.localization.local_plane import Plane
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, KnownLog, Point
from experiments.common.individuals import calibrated
from experiments.common.mission_trial import run_mission
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from hil.missions.site import site_of

ALONG_M: Final = 0.5
"""In other missions than the first each log lies so far off its place along the route, at most, ..."""
ACROSS_M: Final = 0.25
"""... so far across it, ..."""
TURN_DEG: Final = 15.0
"""... and turned by so much."""
SHORT_M: Final = 17.0


def perform(job: Job) -> dict[str, Any]:
    """A job of either kind."""
    return calibrated(job) if job.kind == "calibration" else driven(job)


def driven(job: Job) -> dict[str, Any]:
    """One mission.

    ``options``: profile (shipped name), truth, way, eyes, file (of the mission), shuffled (whether the logs lie
    otherwise than in it, as the seed ``field`` says), short (whether only the first log is asked for), text (of the
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
    """The same mission with every log a little elsewhere; one seed, one field."""
    rng = random.Random(f"field {seed}")
    first = mission.waypoints[0]
    plane = Plane(first.latitude_deg, first.longitude_deg)
    return msgspec.structs.replace(mission, logs=tuple(_elsewhere(log, plane, rng) for log in mission.logs))


def short(mission: ForwardingMission) -> ForwardingMission:
    """Its first steps: ``SHORT_M`` of the first leg, the first log, one lap."""
    first, second = mission.waypoints[:2]
    plane = Plane(first.latitude_deg, first.longitude_deg)
    x, y, _ = plane.local(second.latitude_deg, second.longitude_deg)
    share = SHORT_M / math.hypot(x, y)
    lat, lon, _ = plane.geodetic(share * x, share * y)
    options = msgspec.structs.replace(mission.options, laps=1)
    return msgspec.structs.replace(
        mission, waypoints=(first, Point(lat, lon)), logs=mission.logs[:1], fences=(), options=options
    )


def _elsewhere(log: KnownLog, plane: Plane, rng: random.Random) -> KnownLog:
    x, y, _ = plane.local(log.position.latitude_deg, log.position.longitude_deg)
    x, y = x + rng.uniform(-ALONG_M, ALONG_M), y + rng.uniform(-ACROSS_M, ACROSS_M)
    turn = rng.uniform(-TURN_DEG, TURN_DEG)
    bearing = None if log.bearing_deg is None else math.fmod(log.bearing_deg + turn + 360.0, 360.0)
    lat, lon, _ = plane.geodetic(x, y)
    return msgspec.structs.replace(log, position=Point(lat, lon), bearing_deg=bearing)
