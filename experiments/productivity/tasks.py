"""The tasks: route, landing and logs for one machine and seed."""

from __future__ import annotations

import dataclasses
import math
import random
from typing import Final

from msgspec.structs import replace

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.model import ForwardingMission, Landing, Point
from experiments.common.worlds import wood_of
from machine.profile import Profile
from sim.scenes.arrangements import LogSampler, arrangement
from sim.site.site_file import Site
from sim.wood.log_shape import LogSpec
from sim.wood.stacking import upon

BEFORE_M: Final = 10.0
"""Route before the first log."""
SINGLE_APART_M: Final = 2.5
PILE_APART_M: Final = 6.0
ASIDE_M: Final = (2.9, 3.9)
"""Distance from the route to the middle of a single log."""
PILE_ASIDE_M: Final = 3.7
AFTER_M: Final = 9.0
LENGTH_M: Final = (1.9, 2.1)
DIAMETER_M: Final = (0.20, 0.30)
"""Paper B's birch logs of 2 m by 25 cm (assumed spread)."""
LOGS_PER_ROW: Final = 5
STAKE_M: Final = 0.15
"""Gap between the outermost logs of a row and the stakes."""
LANDING_M: Final = (14.0, 14.0)
"""Landing relative to the end of the route: ahead, left."""
KINDS: Final = {
    "singles": "single logs along the route",
    "piles": "mini-piles of paper A's sizes beside the route",
    "landing": "a full bunk, unloaded at a landing",
}


def task(kind: str, profile: Profile, truth: str, seed: int, amount: int) -> tuple[ForwardingMission, Site]:
    """A mission and its site; ``amount``: single logs, piles, or logs in the bunk."""
    carrier = profile.carrier
    assert carrier is not None
    plane = LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg)
    front_m = carrier.front_axle_m
    rng = random.Random(f"{kind} {seed}")
    build = {"singles": _singles, "piles": _piles, "landing": _bunk}[kind]
    logs, end_m = build(profile, truth, seed, rng, amount)
    way = tuple(Point(*plane.geodetic(front_m + x, 0.0)[:2]) for x in (0.0, end_m))
    landings: tuple[Landing, ...] = ()
    if kind == "landing":
        ahead, left = LANDING_M
        landings = (Landing(Point(*plane.geodetic(front_m + end_m + ahead, left)[:2])),)
    mission = ForwardingMission(KINDS[kind], way, landings=landings)
    return mission, Site(carrier.site_lat_deg, carrier.site_lon_deg, tuple(logs))


def _singles(profile: Profile, truth: str, seed: int, rng: random.Random, amount: int) -> tuple[list[LogSpec], float]:
    """Right and left of the route in turn, up to 25 degrees askew, as on paper B's field."""
    logs: list[LogSpec] = []
    for i in range(amount):
        x = profile.carrier.front_axle_m + BEFORE_M + i * SINGLE_APART_M  # type: ignore[union-attr]
        y = (1 if i % 2 else -1) * rng.uniform(*ASIDE_M)
        logs += _at(profile, truth, seed + i, "single", 1, (x, y), math.radians(rng.uniform(-25.0, 25.0)), rng)
    return logs, BEFORE_M + amount * SINGLE_APART_M + AFTER_M


def _piles(profile: Profile, truth: str, seed: int, rng: random.Random, amount: int) -> tuple[list[LogSpec], float]:
    """Two to six logs each, as paper A's configurations 6, 7 and 10 to 12, right and left in turn."""
    logs: list[LogSpec] = []
    for i in range(amount):
        x = profile.carrier.front_axle_m + BEFORE_M + i * PILE_APART_M  # type: ignore[union-attr]
        y = (1 if i % 2 else -1) * PILE_ASIDE_M
        count = 2 + (i + 1) % 5
        logs += _at(profile, truth, seed + i, "pile", count, (x, y), math.radians(rng.uniform(-10.0, 10.0)), rng)
    return logs, BEFORE_M + amount * PILE_APART_M + AFTER_M


def _bunk(profile: Profile, truth: str, seed: int, rng: random.Random, amount: int) -> tuple[list[LogSpec], float]:
    """Rows as the crane lays them: side by side with room for the grapple, each row in the gaps of the one below."""
    wood = replace(wood_of(profile.name, truth), length_m=LENGTH_M, diameter_m=DIAMETER_M)
    lumber, half = LogSampler(wood, seed), 0.5 * (profile.bunk.width_m - DIAMETER_M[1]) - STAKE_M
    logs: list[LogSpec] = []
    while len(logs) < amount:
        row, inside = divmod(len(logs), LOGS_PER_ROW)
        across = half * (2.0 * inside / (LOGS_PER_ROW - 1) - 1.0) + (0.0 if row % 2 else 1.0) * half / (
            LOGS_PER_ROW - 1
        )
        log = lumber.log(rng.uniform(-0.05, 0.05), 0.0, rng.uniform(-0.05, 0.05))
        logs.append(upon(dataclasses.replace(log, in_bunk=True, y_m=min(across, half)), logs))
    return logs, BEFORE_M


def _at(
    profile: Profile, truth: str, seed: int, kind: str, count: int, at: tuple[float, float], yaw: float,
    rng: random.Random,
) -> tuple[LogSpec, ...]:  # fmt: skip
    wood = replace(wood_of(profile.name, truth), length_m=LENGTH_M, diameter_m=DIAMETER_M)
    return arrangement(kind, profile, wood, seed, count, at=at, yaw_rad=yaw + rng.choice((0.0, math.pi)))
