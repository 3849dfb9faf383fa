"""A sorted mission on the plant whose planner dies with the load on board; another resumes from the checkpoint file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from rich.console import Console

from autonomy.grasp.pile_planner import PilePlanner
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import CheckpointFile, read_checkpoint
from autonomy.manager.transition_table import State
from autonomy.missions.model import ForwardingMission, KnownLog, Landing, Options
from hil.harness.display import Display
from hil.missions.lockstep import MissionRun
from hil.missions.site import site_of
from machine.loading.profile_file import load_profile, profile_hash
from tests.hil.short_missions import PLANE, point

LIE = (("saw logs", 8.0, 4.2), ("pulpwood", 16.0, -4.2))
LANDINGS = (("saw logs", 34.0, 14.0), ("pulpwood", 34.0, -14.0))
DEAD_S = 3.0


class Silent:
    """A planner that is gone."""

    def step(self, *_: object) -> None:
        """Nothing is sent."""


@pytest.mark.long
@pytest.mark.timeout(900)
def test_each_assortment_reaches_its_landing_although_the_planner_restarts(tmp_path: Path) -> None:
    known = tuple(KnownLog(point(x, y), "", 90.0, 2.0, 0.25, "", kind) for kind, x, y in LIE)
    landings = tuple(Landing(point(x, y), kind, None, (kind,)) for kind, x, y in LANDINGS)
    way = (point(0.0, 0.0), point(26.0, 0.0))
    told = ForwardingMission("sorted", way, (), landings, known, Options(logs="listed", sort_by_assortment=True))
    profile, book = load_profile("aoro_fc8"), tmp_path / "progress.json"
    site = site_of(told, profile, 1, "nominal")
    plant = site.plant(profile, "nominal", 1)
    with Display(Console(quiet=True), "sorted") as display:
        run = MissionRun(told, "aoro_fc8", profile, plant, None, display, "ours", site)
        system, first = run.system, run.manager
        while first.state is not State.HAUL and system.now_ns < 400e9:
            system.advance()
        assert first.state is State.HAUL and first.tally.loaded == 1, (first.state, first.failure)
        CheckpointFile(book).write(first.progress(), system.now_ns, 10**18)
        run.manager = Silent()  # type: ignore[assignment]
        dead_ns = system.now_ns
        while system.now_ns < dead_ns + int(DEAD_S * 1e9):
            system.advance()
        assert plant.world.carrier.speed_m_s == pytest.approx(0.0, abs=0.01), "the machine does not drive"
        progress = read_checkpoint(book, told, system.now_ns, 10**18 + int(DEAD_S * 1e9))
        run.manager = ActivityManager(
            profile,
            profile_hash(profile),
            told,
            selector=PlannerSelection(SamplingPlanner()),
            unloading_selector=PlannerSelection(PilePlanner(SamplingPlanner())),
            progress=progress,
        )
        run.manager.auto()
        summary = run.run(1500.0, str(tmp_path))
    assert summary.finished, summary.failure
    assert summary.loaded == 2 and not summary.given_up and summary.in_bunk == 0
    east, north, _ = PLANE.local(site.latitude_deg, site.longitude_deg)
    for state, (_, x, y) in zip(plant.world.log_bodies.states(), LANDINGS, strict=True):
        there = (state.position_m[0] + east, state.position_m[1] + north)
        assert math.dist(there, (x, y)) < 1.6, "on the pile of its assortment"
