"""Short missions on the plant: with both activity managers, sorted, and with a guard that wakes at every frame."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from mcap.reader import make_reader
from rich.console import Console
from typer.testing import CliRunner

import hil.missions.lockstep as lockstep
from autonomy.grasp.pile_planner import PilePlanner
from autonomy.grasp.planners import PlannerChoice
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import CheckpointFile, read_checkpoint
from autonomy.manager.tally import Load, LoadedLog
from autonomy.manager.transition_table import State
from autonomy.missions.model import ForwardingMission, KnownLog, Landing, Options, Point
from can_dbc.frame import Frame, RawFrame
from controller.guard.__main__ import build as build_guard
from controller.guard.guard import Guard
from controller.guard.verdicts import Verdict
from hil.harness.display import Display
from hil.missions.lockstep import MissionRun
from hil.missions.site import site_of
from hil.missions.summary import MissionSummary, report_loads
from host.exit_codes import ExitCode
from machine.loading.profile_file import load_profile, profile_hash
from runtime.errors import TimberhandError
from tests.codes import exit_code_of
from tests.hil.short_missions import PLANE, mission_file, point
from tests.hil.stand_ins import Idle
from timberhand.cli import app


def test_a_file_that_is_no_mission_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.geojson"
    path.write_text("{}")
    result = CliRunner().invoke(app, ["mission", "run", str(path), "--lockstep", "--out", str(tmp_path / "run")])
    assert isinstance(result.exception, TimberhandError) and str(path) in str(result.exception)
    assert exit_code_of(result.exception) == ExitCode.CONFIGURATION


def test_a_machine_without_a_carrier_drives_no_mission(tmp_path: Path) -> None:
    path = mission_file(tmp_path / "mission.geojson")
    result = CliRunner().invoke(
        app, ["mission", "run", str(path), "--lockstep", "--profile", "palms_471", "--out", str(tmp_path / "run")]
    )
    assert getattr(result.exception, "code", "") == "mission.stationary-machine"


@pytest.mark.parametrize(
    ("words", "detector", "planner", "cheats"),
    [
        ((), "ours", PlannerChoice("search", 1), False),
        (("--detector", "perfect"), "perfect", PlannerChoice("search", 1), True),
        (
            ("--detector", "paper-b", "--planner", "cnn", "--virtual-cameras", "3"),
            "faithful",
            PlannerChoice("cnn", 3),
            False,
        ),
    ],
)
def test_the_machine_sees_with_its_own_camera_and_perfect_sight_is_called_a_cheat(
    words: tuple[str, ...],
    detector: str,
    planner: tuple[str, int],
    cheats: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[object] = []

    def take_place(*arguments: object) -> MissionSummary:
        given.extend(arguments)
        return MissionSummary(True, "", 0, 0, 0, {}, 1.0, 0.0, 0, 0, (), str(tmp_path))

    monkeypatch.setattr("hil.missions.lockstep.run_mission", take_place)
    path = mission_file(tmp_path / "mission.geojson")
    done = CliRunner().invoke(app, ["mission", "run", str(path), "--lockstep", *words, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert detector in given and planner in given
    assert ("--detector perfect cheats" in done.output) is cheats


class FrameByFrame:
    """The guard of a run, one step for each frame; ``refused`` are the verdicts after it first was GOOD."""

    def __init__(self, guard: Guard) -> None:
        self.keys_of_buses = guard.keys_of_buses
        self.refused: list[tuple[Verdict, int]] = []
        self._guard, self._ready = guard, False
        self.hear = guard.hear

    def step(self, now_ns: int, frames: list[Frame]) -> list[RawFrame]:
        sent: list[RawFrame] = []
        for dealt in (*([frame] for frame in frames), []):
            sent += self._guard.step(now_ns, dealt)
            self._ready = self._ready or self._guard.enabled
            if self._ready and not self._guard.enabled:
                self.refused.append((self._guard.verdict, self._guard.axis))
        return sent


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("manager", "by_frame"), [("own", True), ("paper-b", False)])
def test_a_log_beside_the_route_is_brought_to_its_end(
    manager: str, by_frame: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Driving, swing arms and crane: the keys and the motions of a tick are in several frames, and a guard that steps
    for every one of them refuses nothing either.
    """
    guards: list[FrameByFrame] = []

    def built(profile: Path) -> FrameByFrame:
        guards.append(FrameByFrame(build_guard(profile)))
        return guards[-1]

    if by_frame:
        monkeypatch.setattr(lockstep, "build_guard", built)
    path = mission_file(tmp_path / "mission.geojson", (8.0, 3.6, 80.0))
    command = ["mission", "run", str(path), "--lockstep", "--manager", manager, "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(app, command)
    assert [guard.refused for guard in guards] == [[]] * by_frame, result.output[-2000:]
    told = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert result.exit_code == 0, (told, result.output[-2000:])
    assert told["finished"] and told["in_bunk"] == told["loaded"] == told["logs"] == 1
    assert told["stops"] == told["refused"] == 0
    assert told["states"][-1][1] == "DONE"
    with (tmp_path / "run" / "run.mcap").open("rb") as file:
        maps = [message for _, _, message in make_reader(file).iter_messages(["/logs"])]
    assert len(maps) > told["seconds"] / 3, "the log map, as in a live run"
    assert len(maps[0].data) < max(len(found.data) for found in maps), "the log is found on the way"


LIE = (("saw logs", 8.0, 4.2), ("pulpwood", 16.0, -4.2))
LANDINGS = (("saw logs", 34.0, 14.0), ("pulpwood", 34.0, -14.0))
DEAD_S = 3.0


@pytest.mark.long
@pytest.mark.timeout(900)
def test_each_assortment_reaches_its_landing_although_the_planner_restarts(tmp_path: Path) -> None:
    """It dies with the load on board; another resumes from the checkpoint file."""
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
        run.manager = Idle()  # type: ignore[assignment]
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


# -- the report of a run: the forwarded loads with positions and times

MISSION = ForwardingMission("Kiruna 7", (), landings=(Landing(Point(63.6, 19.9), "road"),))
BEGUN = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)


def taken(at_s: int, volume_m3: float = 0.1, *product: Any) -> LoadedLog:
    return LoadedLog(Point(63.65, 19.89), at_s * 1_000_000_000, volume_m3, *product)


def test_a_run_writes_a_report_of_its_loads(tmp_path: Path) -> None:
    loads = [
        Load((taken(10), taken(70, 0.2, "pulp", "birch", 31)), 130_000_000_000, 41.7),
        Load((taken(200),), 260_000_000_000, 9.0),
    ]
    path = report_loads(tmp_path, loads, MISSION, load_profile("aoro_fc8"), BEGUN, 0)
    assert path == tmp_path / "forwarded.fpr"
    text: dict[str, list[str]] = {}
    for element in ElementTree.fromstring(path.read_bytes()).iter():
        text.setdefault(element.tag.rpartition("}")[2], []).append(element.text or "")
    assert text["UnloadingTime"] == ["2026-05-04T12:02:10+00:00", "2026-05-04T12:04:20+00:00"]
    assert text["LoadVolume"] == ["0.1000", "0.2000", "0.1000"]
    assert text["CoordinateDate"][1] == "2026-05-04T12:01:10+00:00"
    assert text["ObjectName"] == ["Kiruna 7"] and text["LocationName"] == ["road"]
    assert text["DistanceFromLastUnloading"] == ["42", "9"] and sorted(text["ProductName"]) == ["pulp", "unknown"]
    assert sorted(text["SpeciesGroupName"]) == ["birch", "unknown"] and "31" in text["ProductKey"]
    assert text["CreationDate"] == ["2026-05-04T12:04:20+00:00"]


def test_a_run_without_forwarded_logs_has_no_report(tmp_path: Path) -> None:
    assert report_loads(tmp_path, [], MISSION, load_profile("aoro_fc8"), BEGUN, 0) is None
    assert not list(tmp_path.iterdir())
