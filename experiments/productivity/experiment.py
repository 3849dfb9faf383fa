"""The productivity experiment: single logs, piles, and unloading at a landing."""

from __future__ import annotations

import dataclasses
import math
import random

# -- The tasks: route, landing and logs for one machine and seed.
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec.structs import replace
from rich.console import Console

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.model import ForwardingMission, Landing, Point
from experiments.common import pool
from experiments.common.mission_trial import run_mission
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, print_failures
from experiments.common.workers import Trial
from experiments.common.worlds import carrier_profile, profile_named, wood_of
from experiments.productivity.metrics import (
    CONCLUSION,
    EXPERT_S,
    INTRODUCTION,
    KIND_TITLES,
    METRICS,
    Cycle,
    cycles,
    gather,
    sections,
)
from machine.profile import Profile
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet
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
    """Make a mission and its site; ``amount``: single logs, piles, or logs in the bunk."""
    carrier = profile.carrier
    assert carrier is not None
    plane = LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg)
    front_m = carrier.front_axle_m
    rng = random.Random(f"{kind} {seed}")
    build = {"singles": _singles, "piles": _piles, "landing": _bunk}[kind]
    logs, end_m = build(profile, truth, seed, rng, amount)
    route = tuple(Point(*plane.geodetic(front_m + x, 0.0)[:2]) for x in (0.0, end_m))
    landings: tuple[Landing, ...] = ()
    if kind == "landing":
        ahead, left = LANDING_M
        landings = (Landing(Point(*plane.geodetic(front_m + end_m + ahead, left)[:2])),)
    mission = ForwardingMission(KINDS[kind], route, landings=landings)
    return mission, Site(carrier.site_lat_deg, carrier.site_lon_deg, tuple(logs))


def _singles(profile: Profile, truth: str, seed: int, rng: random.Random, amount: int) -> tuple[list[LogSpec], float]:
    """Place single logs right and left of the route in turn, up to 25 degrees askew, as on paper B's field."""
    logs: list[LogSpec] = []
    for i in range(amount):
        x = profile.carrier.front_axle_m + BEFORE_M + i * SINGLE_APART_M  # type: ignore[union-attr]
        y = (1 if i % 2 else -1) * rng.uniform(*ASIDE_M)
        logs += _at(profile, truth, seed + i, "single", 1, (x, y), math.radians(rng.uniform(-25.0, 25.0)), rng)
    return logs, BEFORE_M + amount * SINGLE_APART_M + AFTER_M


def _piles(profile: Profile, truth: str, seed: int, rng: random.Random, amount: int) -> tuple[list[LogSpec], float]:
    """Place piles of two to six logs, as paper A's configurations 6, 7 and 10 to 12, right and left in turn."""
    logs: list[LogSpec] = []
    for i in range(amount):
        x = profile.carrier.front_axle_m + BEFORE_M + i * PILE_APART_M  # type: ignore[union-attr]
        y = (1 if i % 2 else -1) * PILE_ASIDE_M
        count = 2 + (i + 1) % 5
        logs += _at(profile, truth, seed + i, "pile", count, (x, y), math.radians(rng.uniform(-10.0, 10.0)), rng)
    return logs, BEFORE_M + amount * PILE_APART_M + AFTER_M


def _bunk(profile: Profile, truth: str, seed: int, rng: random.Random, amount: int) -> tuple[list[LogSpec], float]:
    """Fill the bunk in rows as the crane lays them: side by side with room for the grapple, each row in the gaps of the
    one below.
    """
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
    profile: Profile,
    truth: str,
    seed: int,
    kind: str,
    count: int,
    at: tuple[float, float],
    yaw: float,
    rng: random.Random,
) -> tuple[LogSpec, ...]:
    wood = replace(wood_of(profile.name, truth), length_m=LENGTH_M, diameter_m=DIAMETER_M)
    return arrangement(kind, profile, wood, seed, count, at=at, yaw_rad=yaw + rng.choice((0.0, math.pi)))


# -- One task of the whole machine in lockstep, as plain data.


def perform(job: Job) -> dict[str, Any]:
    """Run a task; ``options``: profile, truth, amount, way, limit_s; the kind of the job is that of the task."""
    o = job.options
    mission, site = task(job.kind, profile_named(o["profile"]), o["truth"], job.seed, o["amount"])
    return run_mission(job, mission, site)


# -- The productivity experiment


TRIALS: Final = 1
"""Runs of each task."""
AMOUNTS: Final = {"singles": 12, "piles": 5, "landing": 24}
"""Number of single logs, piles, and logs in the bunk."""
QUICK: Final = {"singles": 1}
FIRST_SEED: Final = 70_000
SEEDS_PER_RUN: Final = 1000
LIMIT_S: Final = 3600.0


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    name = carrier_profile(options.profile)
    check_truth(name, options.truth)
    grapple = profile_named(name).grapple
    grapple_s = grapple.close_time_s + grapple.open_time_s
    trials = 1 if options.quick else options.trials or TRIALS
    jobs = plan(options, name, trials)
    with checkpoint(options, (), [name], options.truth, LOCKSTEP_SOURCES) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "runs", console)
        result = make_result(
            "productivity",
            METRICS,
            gather(outcomes, grapple_s),
            profile=name,
            seed=options.seed,
            trials=trials,
            more={"truth": options.truth, "eyes": "perfect"},
        )
        draw(outcomes, grapple_s, options.out)
        print_failures(outcomes, console)
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Productivity", CONCLUSION, INTRODUCTION, sections())


def failed(trial: Trial) -> bool:
    """Tell whether a run did not end: a campaign keeps its recording."""
    return not trial.outcome["finished"]


def plan(options: Options, profile: str, trials: int) -> list[Job]:
    """Plan every run, named KIND/NUMBER, the longest first."""
    first_seed = FIRST_SEED + SEEDS_PER_RUN * options.seed
    job_options: dict[str, Any] = {
        "profile": profile,
        "truth": options.truth,
        "way": "ours",
        "eyes": "perfect",
        "limit_s": LIMIT_S,
    }
    amounts = QUICK if options.quick else AMOUNTS
    return [
        Job(f"{kind}/{i}", kind, first_seed + i, job_options | {"amount": amount})
        for i in range(trials)
        for kind, amount in amounts.items()
    ]


COLOURS: Final = {
    "LOOK": STEEL,
    "ABOVE": OIL,
    "DESCEND": "#5b93b8",
    "CLOSE": MOSS,
    "LIFT": "#87a978",
    "CARRY": TIMBER,
    "LOWER": "#c29a6b",
    "OPEN": "#d9c3a5",
    "RETREAT": "#8a6fae",
}
MAX_SHOWN_COUNT: Final = 30


def draw(outcomes: Mapping[str, Any], grapple_s: float, out: Path) -> None:
    """Write the plot into ``out``."""
    groups = {
        title: [c for name, o in outcomes.items() if name.startswith(f"{kind}/") for c in cycles(o, grapple_s)]
        for kind, title in KIND_TITLES.items()
    }
    groups = {title: some[:MAX_SHOWN_COUNT] for title, some in groups.items() if some}
    with sheet(out / "cycles.png", max(1, len(groups)), width=4.2 * max(1, len(groups)), height=4.2) as axes:
        for axis, (title, some) in zip(np.atleast_1d(axes), groups.items(), strict=False):
            _bars(axis, some, title)


def _bars(axis: Any, some: Sequence[Cycle], title: str) -> None:
    named: set[str] = set()
    for row, cycle in enumerate(some):
        begin = 0.0
        for name, seconds in cycle.phases:
            label = None if name in named or name not in COLOURS else name.lower()
            named.add(name)
            axis.barh(row, seconds, left=begin, color=COLOURS.get(name, "#dddddd"), height=0.75, label=label)
            begin += seconds
        axis.plot([cycle.shortest_s] * 2, [row - 0.4, row + 0.4], color="black", lw=1.6)
        if not cycle.good:
            axis.plot(begin + 0.8, row, "x", color=RUST, ms=5)
    axis.axvspan(*EXPERT_S, color=MOSS, alpha=0.12, lw=0)
    axis.set(title=title, xlabel="time [s]", ylabel="grasp", ylim=(len(some) - 0.4, -0.6))
    if named:
        axis.legend(fontsize=7, loc="lower right")
