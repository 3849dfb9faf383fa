"""A mission in a world that nobody has seen: drawn route, ground and wood, and the machine's own cameras."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, Final

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.model import ForwardingMission, Point
from experiments.common.mission_trial import run_mission
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from experiments.generalization.matrix import ground_of
from hil.missions.site import site_of
from machine.profile import Carrier

MISSION: Final = "mission"
"""Kind of a job."""
LIMIT_S: Final = 3600.0
LEG_M: Final = 20.0
MOST_TURN_DEG: Final = 35.0


def driven(job: Job, truth: Path, text: str) -> dict[str, Any]:
    """Drive the mission of a job with the calibrated profile ``text``; the places of its logs are not in it.

    Options: profile, truth (its number chooses the ground), logs (their number).
    """
    o = job.options
    profile = profile_named(o["profile"])
    assert profile.carrier is not None, "a mission is for a machine that drives"
    mission = drawn_mission(profile.carrier, job.seed)
    site = site_of(mission, profile, job.seed, str(truth), o["logs"], ground_of(o["truth"]))
    options = o | {"truth": str(truth), "text": text, "way": "ours", "eyes": "ours", "limit_s": LIMIT_S}
    found = run_mission(Job(job.name, MISSION, job.seed, options), mission, site)
    return {
        "ground": ground_of(o["truth"]),
        "logs": len(found["logs"]),
        "believed": found["loaded"],
        "in_bunk": sum(log["in_bunk"] for log in found["logs"]),
        "given_up": len(found["given_up"]),
        **{key: found[key] for key in ("finished", "failure", "stops", "refused", "seconds", "driven_m", "remarks")},
    }


def drawn_mission(carrier: Carrier, seed: int) -> ForwardingMission:
    """A route of two legs with a turn between them; nothing is said of the logs."""
    rng = random.Random(f"unseen route {seed}")
    plane = LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg)
    turn = math.radians(rng.uniform(-MOST_TURN_DEG, MOST_TURN_DEG))
    ends = ((0.0, 0.0), (LEG_M, 0.0), (LEG_M * (1.0 + math.cos(turn)), LEG_M * math.sin(turn)))
    return ForwardingMission("unseen", tuple(Point(*plane.geodetic(*at)[:2]) for at in ends))
