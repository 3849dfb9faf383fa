"""One mission, or the calibration of the individual that drives it, as plain data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import msgspec

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, Point
from experiments.common.individuals import calibrated
from experiments.common.mission_trial import run_mission, shuffled
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from hil.missions.site import site_of

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
