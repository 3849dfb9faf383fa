"""Arrangements of logs: how many there are and where they are released.

Positions are world positions (palms: the crane's base frame; a carrier starts at the origin, heading +x).  Logs are
released slightly above their final place; ``sim.wood.logs.LogBodies`` lets them come to rest before time 0.  Equal
profile, seed and count give equal scenes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice, pairwise
from typing import Final

import numpy as np

from machine.profile import Profile
from sim.errors import PlantError
from sim.truth.wood import Wood
from sim.wood.log_shape import LogSpec
from sim.wood.stacking import GAP_M, beside, distances, footprint_gap, spine, upon

MAX_TRY_COUNT: Final = 100
KINDS: Final = {
    "single": (1, 1),
    "separate": (1, 99),
    "parallel": (2, 6),
    "skewed": (2, 2),
    "crossed": (2, 4),
    "pile": (2, 6),
    "row": (1, 99),
    "bunk": (1, 99),
}
"""Arrangements and the least and greatest number of their logs."""
PILE_ROWS: Final = {2: (2,), 3: (2, 1), 4: (3, 1), 5: (3, 2), 6: (3, 2, 1)}
ROUTE_BEND_M: Final = 6.5
"""Radius of the bends in which a machine rounds the corners of its route."""
ROUTE_CLEAR_M: Final = 1.8  # half a machine and a margin: least distance of a log from the route
ROUTE_START_M: Final = 6.0
OVERFILL_M: Final = 0.5  # filling height above the bunk's stakes; the load sinks as it comes to rest
CONFIGURATIONS: Final = {
    1: ("single", 1),
    2: ("parallel", 2),
    3: ("crossed", 2),
    4: ("parallel", 3),
    5: ("skewed", 2),
    6: ("pile", 2),
    7: ("pile", 3),
    8: ("separate", 2),
    9: ("crossed", 3),
    10: ("pile", 4),
    11: ("pile", 5),
    12: ("pile", 6),
}
"""Paper A's twelve configurations as (kind, logs).  Its pictures are not in the text; these are a reconstruction from
its sentences: 1 single and 2 parallel; the top log of 3 and 9 is the target; all logs of 2, 4, 5, 6, 7 and more than
one of 10, 11, 12 are lifted together; mini-piles of up to six logs.
"""


class LogSampler:
    """Draws logs.  Places and sizes come from one random stream, shapes from another: a new property moves no log."""

    def __init__(self, wood: Wood, seed: int) -> None:
        self.wood = wood
        self.rng, self._shapes = random.Random(f"scene {seed}"), random.Random(f"shapes {seed}")

    def density(self) -> float:
        """Draw the density [kg/m^3] of one log."""
        spread = self.wood.density_spread * max(-2.0, min(2.0, self.rng.gauss(0.0, 1.0)))
        return self.wood.density_kg_m3 * (1.0 + spread)

    def log(self, x_m: float, y_m: float, yaw_rad: float, density: float | None = None) -> LogSpec:
        """Draw a log of random size and shape, butt at a random end, bowing to a random side."""
        w, rng, shapes = self.wood, self.rng, self._shapes
        return LogSpec(
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad + math.pi * shapes.getrandbits(1),
            length_m=rng.uniform(*w.length_m),
            diameter_m=rng.uniform(*w.diameter_m),
            density_kg_m3=self.density() if density is None else density,
            taper_m_m=shapes.uniform(*w.taper_m_m),
            sweep=shapes.triangular(0.0, w.sweep_max, 0.2 * w.sweep_max),
            z_m=GAP_M,
            roll_rad=shapes.choice((-1, 1)) * math.pi / 2,
        )


def random_scene(
    profile: Profile, wood: Wood, seed: int, logs: int, at: tuple[float, float] | None = None
) -> tuple[LogSpec, ...]:
    """Draw ``logs`` logs inside the profile's pick area, or an area of its size about ``at``, apart from each other.

    Their sizes are those of papers A and B (docs/reference/machines.md section 9).

    Raises:
        PlantError: the pick area has no room for so many logs.
    """
    sampler, half = LogSampler(wood, seed), profile.workspace.pick_half_size_m
    cx, cy = _pick_center(profile) if at is None else at
    placed_specs: list[LogSpec] = []
    failed = 0
    while len(placed_specs) < logs and failed < MAX_TRY_COUNT:
        density, rng = sampler.density(), sampler.rng
        x, y, yaw = cx + rng.uniform(-half, half), cy + rng.uniform(-half, half), rng.uniform(-math.pi / 2, math.pi / 2)
        spec = sampler.log(x, y, yaw, density)
        if all(footprint_gap(spec, other) > 0.1 for other in placed_specs):
            placed_specs.append(spec)
            failed = 0
        else:
            failed += 1
    if len(placed_specs) < logs:
        raise PlantError(
            "scene.pick-area-full",
            f"the pick area has no room for {logs} separate logs; request fewer logs or enlarge pick_half_size_m",
        )
    return tuple(placed_specs)


def arrangement(
    kind: str,
    profile: Profile,
    wood: Wood,
    seed: int,
    logs: int,
    *,
    at: tuple[float, float] | None = None,
    yaw_rad: float | None = None,
    route: Sequence[tuple[float, float]] = ((0.0, 0.0), (40.0, 0.0)),
) -> tuple[LogSpec, ...]:
    """Draw a scene of a kind in KINDS about ``at`` (default: pick area's middle), axis at ``yaw_rad`` (default random).

    single: one log; separate: as ``random_scene``; parallel: side by side; skewed: side by side, 15 to 30 deg apart;
    crossed: the last across the others; pile: rows upon rows; row: single logs beside ``route`` (waypoints [m]), on
    either side; bunk: in the bunk, filled row by row.

    Raises:
        PlantError: unknown kind, a count outside the kind's range, or no room.
    """
    if kind not in KINDS:
        raise PlantError("scene.unknown-kind", f"scene {kind!r} is unknown; use one of {', '.join(KINDS)}")
    low, high = KINDS[kind]
    if not low <= logs <= high:
        raise PlantError(
            "scene.log-count", f"scene {kind!r} consists of {low} to {high} logs, not {logs}; request another number"
        )
    if kind == "separate":
        return random_scene(profile, wood, seed, logs, at)
    sampler = LogSampler(wood, seed)
    if kind in ("row", "bunk"):
        return _row(sampler, logs, route) if kind == "row" else _bunk(sampler, logs, profile)
    yaw = sampler.rng.uniform(-math.pi / 2, math.pi / 2) if yaw_rad is None else yaw_rad
    specs = BUILDERS[kind](sampler, logs)
    x, y = _pick_center(profile) if at is None else at
    return tuple(_moved(spec, x, y, yaw) for spec in specs)


def configuration(
    number: int,
    profile: Profile,
    wood: Wood,
    seed: int,
    *,
    at: tuple[float, float] | None = None,
    yaw_rad: float | None = None,
) -> tuple[LogSpec, ...]:
    """Draw one of paper A's configurations, 1 to 12 (see CONFIGURATIONS), with random logs.

    Raises:
        PlantError: there is no configuration of this number.
    """
    if number not in CONFIGURATIONS:
        raise PlantError(
            "scene.unknown-configuration", f"paper A has no configuration {number}; use 1 to {len(CONFIGURATIONS)}"
        )
    kind, logs = CONFIGURATIONS[number]
    return arrangement(kind, profile, wood, seed, logs, at=at, yaw_rad=yaw_rad)


def _pick_center(profile: Profile) -> tuple[float, float]:
    """Return the middle of the pick area in the world, for the machine at its start."""
    (x, y), c = profile.workspace.pick_center_m, profile.carrier
    if c is None:
        return x, y
    cos, sin = math.cos(c.crane_yaw_rad), math.sin(c.crane_yaw_rad)
    return c.crane_base_m[0] + cos * x - sin * y, c.crane_base_m[1] + sin * x + cos * y


def _moved(s: LogSpec, x: float, y: float, yaw: float) -> LogSpec:
    c, k = math.cos(yaw), math.sin(yaw)
    return replace(s, x_m=x + c * s.x_m - k * s.y_m, y_m=y + k * s.x_m + c * s.y_m, yaw_rad=s.yaw_rad + yaw)


def _drawn(sampler: LogSampler, logs: int, yaws: Callable[[], float]) -> list[LogSpec]:
    return [sampler.log(sampler.rng.uniform(-0.2, 0.2), 0.0, yaws()) for _ in range(logs)]


def _rows(counts: Sequence[int], logs: Sequence[LogSpec]) -> list[LogSpec]:
    """Stack rows of logs along x, side by side in y, each row on top of and centred over the one below it."""
    following = iter(logs)
    out: list[LogSpec] = []
    middle = 0.0
    for count in counts:
        row: list[LogSpec] = []
        for spec in islice(following, count):
            row.append(beside(replace(spec, y_m=row[-1].y_m if row else 0.0), row))
        shift = middle - (row[0].y_m + row[-1].y_m) / 2
        for spec in row:
            out.append(upon(replace(spec, y_m=spec.y_m + shift), out))
    return out


def _parallel(sampler: LogSampler, logs: int) -> list[LogSpec]:
    return _rows((logs,), _drawn(sampler, logs, lambda: sampler.rng.uniform(-0.03, 0.03)))


def _pile(sampler: LogSampler, logs: int) -> list[LogSpec]:
    """Pile logs, the thickest below: a thick log on thin ones rolls off, and the pile falls apart."""
    drawn = _drawn(sampler, logs, lambda: sampler.rng.uniform(-0.08, 0.08))
    return _rows(PILE_ROWS[logs], sorted(drawn, key=lambda log: -log.diameter_m))


def _skewed(sampler: LogSampler, logs: int) -> list[LogSpec]:
    turns = iter([0.0, math.radians(sampler.rng.uniform(15.0, 30.0))])
    return _rows((logs,), _drawn(sampler, logs, lambda: next(turns)))


def _crossed(sampler: LogSampler, logs: int) -> list[LogSpec]:
    """Lay parallel logs half a metre apart and one across them, turned by 40 to 90 deg."""
    rng, lower = sampler.rng, []
    for i in range(logs - 1):
        lower.append(sampler.log(rng.uniform(-0.2, 0.2), 0.7 * (i - (logs - 2) / 2), rng.uniform(-0.05, 0.05)))
    turn = rng.choice((-1.0, 1.0)) * math.radians(rng.uniform(40.0, 90.0))
    return [*lower, upon(sampler.log(rng.uniform(-0.2, 0.2), 0.0, turn), lower)]


def _row(sampler: LogSampler, logs: int, route: Sequence[tuple[float, float]]) -> tuple[LogSpec, ...]:
    rng = sampler.rng
    legs = list(pairwise(route))
    total = sum(math.dist(a, b) for a, b in legs)
    spacing = (total - ROUTE_START_M) / logs
    placed_specs: list[LogSpec] = []
    for i in range(logs):
        for _ in range(MAX_TRY_COUNT):
            leg_distance_m = ROUTE_START_M + spacing * (i + rng.uniform(0.2, 0.8))
            side, offset_m, yaw = rng.choice((-1.0, 1.0)), rng.uniform(2.4, 4.4), rng.uniform(-math.pi / 2, math.pi / 2)
            for a, b in legs:
                if leg_distance_m <= math.dist(a, b):
                    break
                leg_distance_m -= math.dist(a, b)
            along = math.atan2(b[1] - a[1], b[0] - a[0])
            x = a[0] + leg_distance_m * math.cos(along) - side * offset_m * math.sin(along)
            y = a[1] + leg_distance_m * math.sin(along) + side * offset_m * math.cos(along)
            spec = sampler.log(x, y, yaw + along)
            if _off_route(spec, route) and all(footprint_gap(spec, other) > 0.3 for other in placed_specs):
                placed_specs.append(spec)
                break
        else:
            raise PlantError(
                "scene.route-too-short",
                f"the route of {total:.0f} m has no room for {logs} logs; request fewer logs or lengthen the route",
            )
    return tuple(placed_specs)


def _off_route(s: LogSpec, route: Sequence[tuple[float, float]]) -> bool:
    flat = np.array([1.0, 1.0, 0.0])
    path_points = np.array([(*point, 0.0) for point in _driven(route)])
    return float(np.min(distances(spine(s)[0] * flat, path_points))) > ROUTE_CLEAR_M + s.diameter_m / 2


def _driven(route: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Round the corners of the route, each as widely as its legs allow."""
    out = [route[0]]
    for before, corner, after in zip(route, route[1:], route[2:], strict=False):
        into = math.atan2(corner[1] - before[1], corner[0] - before[0])
        turn = math.remainder(math.atan2(after[1] - corner[1], after[0] - corner[0]) - into, math.tau)
        reach = min(math.dist(before, corner), math.dist(corner, after)) / 2.0
        cut = min(ROUTE_BEND_M * math.tan(min(abs(turn), 3.0) / 2.0), reach)
        if cut < 0.1:
            out.append(corner)
            continue
        radius = math.copysign(cut / math.tan(min(abs(turn), 3.0) / 2.0), turn)
        x, y = corner[0] - cut * math.cos(into), corner[1] - cut * math.sin(into)
        for share in np.linspace(0.0, 1.0, 9):
            bent = into + share * turn
            out.append((x + radius * (math.sin(bent) - math.sin(into)), y - radius * (math.cos(bent) - math.cos(into))))
    return [*out, route[-1]]


def _bunk(sampler: LogSampler, logs: int, profile: Profile) -> tuple[LogSpec, ...]:
    """Lay logs along the bunk, from stake to stake, row upon row."""
    rng, stake = sampler.rng, profile.bunk.width_m / 2 - 0.01
    out: list[LogSpec] = []
    edge = -stake
    while len(out) < logs:
        fresh = sampler.log(rng.uniform(-0.05, 0.05), 0.0, rng.uniform(-0.01, 0.01))
        across, radius = [y for _, y, _ in fresh.spine()], fresh.radius(-0.5)
        width = max(across) - min(across) + 2 * radius
        if edge + width > stake:
            edge = -stake
        out.append(upon(replace(fresh, in_bunk=True, y_m=edge + radius - min(across)), out))
        edge += width + GAP_M
        if out[-1].z_m + 2 * radius > profile.bunk.stake_height_m + OVERFILL_M:
            raise PlantError(
                "scene.bunk-full",
                f"the bunk has no room for {logs} logs; it is full with {len(out) - 1}: request fewer logs",
            )
    return tuple(out)


BUILDERS: Final = {"single": _parallel, "parallel": _parallel, "skewed": _skewed, "crossed": _crossed, "pile": _pile}
