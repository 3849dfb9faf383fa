"""One forwarding mission in lockstep with a ground-truth observer: a job in, plain data out.

Shared by the experiments that drive whole missions.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any, Final

import msgspec
from rich.console import Console

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.model import ForwardingMission, KnownLog, Point
from experiments.common.ground_truth_observer import GroundTruthObserver
from experiments.common.individuals import controller_profile
from experiments.common.pool import Job
from experiments.common.recording import recorder_of
from experiments.common.result import ROOT
from experiments.common.worlds import profile_named
from hil.harness.display import Display
from hil.harness.lockstep import Lockstep
from hil.missions.lockstep import MissionRun
from hil.missions.summary import MissionSummary
from machine.loading.profile_file import load_profile
from sim.site.site_file import Site

ALONG_M: Final = 0.5
"""Maximum shift of a log along the route on a shuffled field."""
ACROSS_M: Final = 0.25
"""Maximum shift of a log across the route on a shuffled field."""
TURN_DEG: Final = 15.0
"""Maximum turn of a log on a shuffled field."""
PAPER_B: Final = ROOT / "docs" / "examples" / "paper_b.geojson"
"""Paper B's field with 24 logs, and its route."""
PAPER_B_ANGLED: Final = PAPER_B.with_name("paper_b_angled.geojson")
"""The same with every log at 30 degrees to the path, its far end outward behind a machine that has passed it: so paper
B's logs lie (3.1), for its rotator does not turn and its crane reaches obliquely backwards."""
LANDED_M: Final = 3.0
"""A log this near to the middle of a landing counts as delivered."""


def run_mission(
    job: Job, mission: ForwardingMission, site: Site, attach: Callable[[Lockstep], None] = lambda system: None
) -> dict[str, Any]:
    """Drive a mission on a site; options: profile, truth, text, way (method), eyes (detector), limit_s.

    ``attach`` gets the system before it starts.
    """
    o = job.options
    with controller_profile(o["profile"], o.get("text")) as name:
        profile = load_profile(name)
        plant = site.plant(profile_named(o["profile"]), o["truth"], job.seed)
        try:
            with Display(Console(quiet=True), job.name) as display, recorder_of(job, profile, name) as recorder:
                run = MissionRun(mission, name, profile, plant, recorder, display, o["way"], site, o["eyes"], job.seed)
                attach(run.system)
                observer = GroundTruthObserver(run, profile, LocalPlane(site.latitude_deg, site.longitude_deg))
                summary = run.run(o["limit_s"], "", observer.step)
            evaluation, lying = plant.evaluate(), plant.logs()
            plane = LocalPlane(site.latitude_deg, site.longitude_deg)
            landings = [plane.local(x.position.latitude_deg, x.position.longitude_deg)[:2] for x in mission.landings]
            return {
                **summary_of(summary),
                "logs": [
                    {
                        "place_m": [s.x_m, s.y_m, s.yaw_rad],
                        "size_m": [s.length_m, s.diameter_m],
                        "detected": i in observer.known,
                        "in_bunk": evaluation.logs[i].in_bunk,
                        "lies_m": [[round(v, 3) for v in at] for at in (lying[i].position_m, *lying[i].ends_m)],
                        "landed": not evaluation.logs[i].in_bunk
                        and any(math.dist(lying[i].position_m[:2], at) < LANDED_M for at in landings),
                    }
                    for i, s in enumerate(site.logs)
                ],
                "base": plant.base_pose(),
                "places": site.places,
                "grasps": observer.grasps,
                "path": observer.path,
                "stands": observer.stands,
            }
        finally:
            plant.close()


def summary_of(summary: MissionSummary) -> dict[str, Any]:
    """Return the summary of the run as plain data."""
    return {
        "finished": summary.finished,
        "failure": summary.failure,
        "loaded": summary.loaded,
        "given_up": {str(k): v for k, v in summary.given_up.items()},
        "seconds": summary.seconds,
        "driven_m": round(summary.driven_m, 2),
        "stops": summary.stops,
        "refused": summary.refused,
        "states": [list(s) for s in summary.states],
        "remarks": list(summary.remarks),
    }


def shuffled(mission: ForwardingMission, seed: int) -> ForwardingMission:
    """Shift and turn every log of a mission; one seed gives one field."""
    rng = random.Random(f"field {seed}")
    first = mission.waypoints[0]
    plane = LocalPlane(first.latitude_deg, first.longitude_deg)
    return msgspec.structs.replace(mission, logs=tuple(_elsewhere(log, plane, rng) for log in mission.logs))


def _elsewhere(log: KnownLog, plane: LocalPlane, rng: random.Random) -> KnownLog:
    x, y, _ = plane.local(log.position.latitude_deg, log.position.longitude_deg)
    x, y = x + rng.uniform(-ALONG_M, ALONG_M), y + rng.uniform(-ACROSS_M, ACROSS_M)
    turn = rng.uniform(-TURN_DEG, TURN_DEG)
    bearing = None if log.bearing_deg is None else math.fmod(log.bearing_deg + turn + 360.0, 360.0)
    lat, lon, _ = plane.geodetic(x, y)
    return msgspec.structs.replace(log, position=Point(lat, lon), bearing_deg=bearing)
