"""Checkpoints: what is written and read back, which files are refused, and missions that another planner resumes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.__main__ import main
from autonomy.crane_job.rotator_estimate import RotatorEstimate
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import (
    PERIOD_NS,
    Checkpoint,
    CheckpointFile,
    LogKnowledge,
    MissedLog,
    RouteRemainder,
    copied_tally,
    mission_digest,
    read_checkpoint,
)
from autonomy.manager.tally import Load, LoadedLog, Tally
from autonomy.manager.transition_table import OURS, PAPER_B, RULES, State
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, KnownLog, MissionError, Options, Point
from autonomy.navigation.clothoid_path import PathRefused, drivable_path
from autonomy.navigation.joining_path import dubins_corners
from autonomy.process.command_line import CONFIGURATION, FINE
from autonomy.process.jobs import ForwardingJob
from can_dbc.messages.mission import MissionAction, MissionCommand
from runtime.errors import InputRefused
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.manager_missions import (
    LISTED_LOGS,
    PLANE,
    PROFILE,
    again,
    at,
    completed,
    ended,
    forwarder,
    listed_mission,
    managed,
    outward_rad,
    place,
    states,
    whole,
)
from tests.autonomy.mapped_logs import lying
from tests.codes import coded, numbers_in

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "paper_b.geojson"


def some(told: ForwardingMission, **more) -> Checkpoint:
    return Checkpoint(mission=mission_digest(told), tally=Tally(loaded=3), **more)


def kept(path: Path, progress: Checkpoint, now_ns: int = 5, unix_ns: int = 10**18) -> Path:
    CheckpointFile(path).write(progress, now_ns, unix_ns)
    return path


def test_without_a_file_there_is_no_checkpoint(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path / "none.json", listed_mission(), 0, 0) is None


def test_times_survive_a_restart_of_the_computer(tmp_path: Path) -> None:
    taken = LoadedLog(Point(63.0, 19.0), 80 * PERIOD_NS, 0.1)
    progress = Checkpoint(
        mission=mission_digest(listed_mission()),
        tally=Tally(board=[taken], loads=[Load((taken,), 90 * PERIOD_NS, 5.0)]),
    )
    path = kept(tmp_path / "p", progress, 100 * PERIOD_NS, 10**18)
    found = read_checkpoint(path, listed_mission(), 3 * PERIOD_NS, 10**18 + 60 * PERIOD_NS)
    then_ns = 10**18 - (10**18 + 60 * PERIOD_NS) + 3 * PERIOD_NS  # when it was kept, by the new clock
    assert found.tally.board[0].at_ns == then_ns - 20 * PERIOD_NS
    assert found.tally.loads[0].at_ns == then_ns - 10 * PERIOD_NS
    assert found.tally.loads[0].logs == tuple(found.tally.board)


def test_the_checkpoint_is_written_on_change_and_at_most_once_a_second(tmp_path: Path) -> None:
    path, told = tmp_path / "p", listed_mission()
    book = CheckpointFile(path)
    assert book.due(0)
    book.write(some(told), 0, 0)
    assert not book.due(PERIOD_NS - 1) and book.due(PERIOD_NS)
    path.unlink()
    book.write(some(told), PERIOD_NS, 0)
    assert not path.exists() and not book.due(PERIOD_NS + 1)
    book.write(some(told, rounds=1), 2 * PERIOD_NS, 0)
    assert [p.name for p in tmp_path.iterdir()] == ["p"], "nothing is left beside it"


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: text.replace('"schema":1', '"schema":2'),
        lambda text: text.replace('"loaded":3', '"loaded":"three"'),
        lambda text: "[]",
        lambda text: "\xff\xfe",
    ],
)
def test_a_damaged_checkpoint_is_refused(spoil, tmp_path: Path) -> None:
    path = kept(tmp_path / "p", some(listed_mission()))
    path.write_bytes(spoil(path.read_text()).encode("latin-1"))
    with pytest.raises(MissionError, check=coded("checkpoint.damaged")):
        read_checkpoint(path, listed_mission(), 0, 0)


@pytest.mark.parametrize(
    "what",
    [{"landing": 1}, {"served": (2,)}, {"left": RouteRemainder(3)}, {"tally": Tally(loads=[Load((), 0, 0.0, 4)])}],
)
def test_a_checkpoint_with_unknown_places_is_refused(what, tmp_path: Path) -> None:
    told = listed_mission((58.0, 14.0))
    path = kept(tmp_path / "p", msgspec.structs.replace(some(told), **what))
    with pytest.raises(MissionError, check=coded("checkpoint.unknown-place")):
        read_checkpoint(path, told, 0, 0)
    good = {"landing": 0, "served": (0,), "left": RouteRemainder(2)}
    assert read_checkpoint(kept(tmp_path / "q", msgspec.structs.replace(some(told), **good)), told, 0, 0) is not None


def test_other_missions_and_unreadable_files_are_refused(tmp_path: Path) -> None:
    path = kept(tmp_path / "p", some(listed_mission(logs_wanted=1)))
    with pytest.raises(MissionError, check=coded("checkpoint.other-mission")):
        read_checkpoint(path, listed_mission(), 0, 0)
    with pytest.raises(MissionError, check=coded("checkpoint.unreadable")):
        read_checkpoint(tmp_path, listed_mission(), 0, 0)


def test_a_finished_mission_is_reported(tmp_path: Path) -> None:
    path = kept(tmp_path / "p", some(listed_mission(), finished=True))
    with pytest.raises(InputRefused, check=coded("checkpoint.finished")):
        read_checkpoint(path, listed_mission(), 0, 0)


TEXT = st.text(max_size=8)
METRES = st.floats(0.0, 1e4)
NUMBER = st.integers(0, 10**6)
PLACE = st.builds(Point, st.floats(-90.0, 90.0), st.floats(-180.0, 180.0))
TAKEN = st.builds(LoadedLog, PLACE, st.integers(0, 2**62), METRES, TEXT)
LOAD = st.builds(Load, st.lists(TAKEN, max_size=3).map(tuple), st.integers(0, 2**62), METRES, st.just(0))
GIVEN_UP = st.dictionaries(NUMBER, TEXT, max_size=3)
ABOARD = st.lists(LOAD, max_size=3), st.lists(TAKEN, max_size=3), METRES
TALLY = st.builds(Tally, *[NUMBER] * 5, METRES, st.booleans(), GIVEN_UP, *ABOARD)
LOG = st.builds(KnownLog, PLACE, st.just(""), st.floats(0.0, 360.0), METRES, METRES, TEXT, TEXT)
KNOWN = st.builds(
    LogKnowledge,
    st.lists(NUMBER, max_size=3).map(tuple),
    st.lists(st.builds(MissedLog, NUMBER, LOG, NUMBER), max_size=3).map(tuple),
    NUMBER,
)
LEFT = st.builds(
    RouteRemainder,
    st.integers(0, 2),
    st.none() | st.tuples(PLACE, PLACE),
    st.lists(PLACE, max_size=3).map(tuple),
    st.booleans(),
)


@given(TALLY, KNOWN, st.none() | LEFT, st.sampled_from([None, 0]), st.sampled_from([(), (0,)]), NUMBER, METRES)
def test_a_written_checkpoint_is_read_back(
    tmp_path_factory, tally, known, left, landing, served, rounds, driven_m
) -> None:
    told = listed_mission((58.0, 14.0))
    progress = Checkpoint(
        mission=mission_digest(told),
        tally=tally,
        known=known,
        left=left,
        landing=landing,
        served=served,
        rounds=rounds,
        driven_m=driven_m,
        rotator=RotatorEstimate(driven_m, -driven_m, (0.8, 1.1)),
    )
    path = kept(tmp_path_factory.getbasetemp() / "p", progress, 7, 11)
    assert read_checkpoint(path, told, 7, 11) == progress
    later = read_checkpoint(path, told, 7 + 1000, 11)
    assert later is not None and later.tally == copied_tally(tally, 1000)


# -- the process
WORDS = ["--controller", "127.0.0.1:1", "--scene", "127.0.0.1:2", "--report-port", "0"]


def start(progress: Path, *more: str) -> int:
    words = [*WORDS, "--profile", "aoro_fc8", "--order-port", "0", "--mission", str(EXAMPLE)]
    return main([*words, "--progress", str(progress), *more])


def test_the_process_refuses_other_and_damaged_checkpoints(tmp_path: Path, capsys) -> None:
    path = kept(tmp_path / "p", some(listed_mission()))
    before = path.read_bytes()
    assert start(path) == CONFIGURATION
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and not said.out
    assert path.read_bytes() == before
    path.write_text("{")
    assert start(path) == CONFIGURATION
    assert capsys.readouterr().err.count("\n") == 1 and path.read_text() == "{"


def test_the_process_reports_a_finished_mission(tmp_path: Path, capsys) -> None:
    told = load_mission(EXAMPLE).mission
    path = kept(tmp_path / "p", some(told, finished=True))
    assert start(path) == FINE
    event = json.loads(capsys.readouterr().out)
    assert event["event"] == "done" and 3 in numbers_in(event["reason"])


def test_the_process_tells_what_a_mission_does_not_have_of_its_file(tmp_path: Path, capsys) -> None:
    document = json.loads(EXAMPLE.read_text())
    route = next(f["geometry"] for f in document["features"] if f["geometry"]["type"] == "LineString")
    beside = {"type": "Point", "coordinates": route["coordinates"][0]}
    document["features"].append({"type": "Feature", "properties": {}, "geometry": beside})
    file = tmp_path / "mission.geojson"
    file.write_text(json.dumps(document))
    path = kept(tmp_path / "p", some(load_mission(EXAMPLE).mission, finished=True))
    assert start(path, "--mission", str(file)) == FINE
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["event"] for event in events] == ["mission", "done"]
    assert len(events[0]["notes"]) == 1 and "warnings" not in events[0]


def test_the_process_refuses_an_unwritable_checkpoint(tmp_path: Path, capsys) -> None:
    assert start(tmp_path / "none" / "p") == CONFIGURATION
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("left_out", ["--mission", "--order-port"])
def test_progress_needs_a_mission_and_an_order_port(left_out: str, capsys) -> None:
    given = {"--mission": "m", "--order-port": "0"}
    del given[left_out]
    with pytest.raises(SystemExit, match="2"):
        main([*WORDS, "--progress", "p", *given.popitem()])


# -- missions that are resumed
def begun(told: ForwardingMission, lie=LISTED_LOGS, table=OURS) -> tuple[Forwarder, ActivityManager]:
    logs = [lying(i, x, y, outward_rad(y) if table is PAPER_B else 0.0) for i, (x, y) in enumerate(lie, 1)]
    return forwarder(logs, table), managed(told, table, plane=PLANE)


def resuming(told: ForwardingMission, left: RouteRemainder, table=OURS) -> ActivityManager:
    """Another planner that only knows what of the route is left."""
    return managed(told, table, progress=Checkpoint(mission="", tally=Tally(), left=left))


def followed(machine: Forwarder, manager: ActivityManager, what: Callable[[], float]) -> list[float]:
    """What was to be seen at each moment of a mission that is done."""
    seen: list[float] = []

    def over(manager: ActivityManager) -> bool:
        seen.append(what())
        return ended(manager)

    machine.run(manager, over, 1800.0)
    assert manager.state is State.DONE, manager.failure
    return seen


def loaded(count: int, state: State):
    return lambda manager: manager.tally.loaded >= count and manager.state is state


def unloads(manager: ActivityManager) -> bool:
    return manager.state is State.UNLOAD and manager.activity is not None and manager.activity.grasp is not None


@whole
@pytest.mark.parametrize("landing", [None, (58.0, 14.0)])
@pytest.mark.parametrize(
    "left_at",
    [
        at(State.SEARCH),
        at(State.APPROACH),
        at(State.COLLECT),
        loaded(1, State.CHECK),
        loaded(1, State.SEARCH),
        loaded(1, State.APPROACH),
        loaded(2, State.STOW),
    ],
)
def test_a_resumed_mission_has_the_same_tally(landing, left_at, tmp_path: Path) -> None:
    told = listed_mission(landing)
    machine, manager = begun(told)
    machine.run(manager, left_at)
    left_m, before = machine.x_m, manager.tally.loaded
    manager = again(machine, manager, told, tmp_path / "progress.json")
    assert manager.resumed and manager.tally.loaded == before
    manager.auto()
    behind = followed(machine, manager, lambda: machine.x_m)
    assert manager.tally.loaded == 2 and not manager.tally.given_up
    assert states(manager).count(State.APPROACH) == 2 - before, "loaded logs are not searched for again"
    assert states(manager)[:3] == [State.STOW, State.RAISE, State.SEARCH], "the crane was anywhere"
    assert min(behind) > left_m - 1.0, "it does not drive back"
    if landing is None:
        assert machine.in_bunk == 2
    else:
        assert manager.tally.unloaded == 2 and [len(load.logs) for load in manager.tally.loads] == [2]
        assert manager.tally.loads[0].driven_m == pytest.approx(machine.driven_m, abs=1.0)


@whole
@pytest.mark.parametrize("left_at", [at(State.HAUL), at(State.SETTLE), unloads])
def test_a_load_on_its_way_still_reaches_its_landing(left_at, tmp_path: Path) -> None:
    told = listed_mission((58.0, 14.0))
    machine, manager = begun(told)
    machine.run(manager, left_at, 900.0)
    manager = again(machine, manager, told, tmp_path / "progress.json", auto=True)
    completed(machine, manager, 900.0)
    assert manager.tally.loaded == 2 and machine.in_bunk == manager.tally.on_board == 0
    assert [len(load.logs) for load in manager.tally.loads] == [2]
    assert all(math.dist(log.center_m[:2], (58.0, 14.0)) < 1.6 for log in machine.field.values())


@whole
def test_a_paper_b_mission_is_resumed(tmp_path: Path) -> None:
    told = listed_mission()
    machine, manager = begun(told, table=PAPER_B)
    machine.run(manager, loaded(1, State.SEARCH))
    manager = again(machine, manager, told, tmp_path / "progress.json", PAPER_B, auto=True)
    machine.run(manager, ended, 900.0)
    assert manager.state is State.DONE and machine.in_bunk == manager.tally.loaded == 2


@whole
@pytest.mark.parametrize("left_at", [unloads, lambda m: m.tally.loads and m.route.along_m > 5.0])
def test_after_a_landing_the_machine_returns_to_where_it_left_the_route(left_at, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(Tally, "full", lambda self, _bunk, _next_m3=0.0: self.on_board >= 1)
    told = listed_mission((20.0, -20.0))
    machine, manager = begun(told)
    machine.run(manager, at(State.HAUL))
    left_m = (machine.x_m, machine.y_m)
    machine.run(manager, lambda m: m.state is not State.HAUL and left_at(m), 900.0)
    manager = again(machine, manager, told, tmp_path / "progress.json", auto=True)
    if left_at is unloads:
        driven_m = machine.driven_m
        machine.run(manager, at(State.UNLOAD))
        assert machine.driven_m - driven_m < 1.0, "it stands beside the landing already"
    assert min(followed(machine, manager, lambda: math.dist((machine.x_m, machine.y_m), left_m))) < 1.0
    assert manager.tally.unloaded == 2 and len(manager.tally.loads) == 2


@whole
def test_a_log_that_was_given_up_stays_given_up(tmp_path: Path) -> None:
    told = listed_mission(lie=LISTED_LOGS[:1], end_m=26.0)
    machine, manager = begun(told, LISTED_LOGS[:1])
    machine.crane.slippery = 9
    machine.run(manager, lambda m: bool(m.tally.given_up), 900.0)
    machine.run(manager, at(State.SEARCH))
    missed = manager.tally.missed
    manager = again(machine, manager, told, tmp_path / "progress.json", auto=True)
    machine.run(manager, ended, 900.0)
    assert manager.state is State.DONE and list(manager.tally.given_up) == [1]
    assert State.COLLECT not in states(manager) and manager.tally.missed == missed


def test_a_resumed_mission_waits_for_auto(tmp_path: Path) -> None:
    told = listed_mission()
    machine, manager = begun(told)
    machine.run(manager, at(State.SEARCH))
    manager = again(machine, manager, told, tmp_path / "progress.json")
    job = ForwardingJob(manager, told)
    for _ in range(100):
        machine.step(job)
    assert manager.state is State.IDLE and machine.drive is None and machine.crane.setpoint is None
    assert not job.report(0).auto
    assert job.report(0).words != RULES[State.IDLE].description
    assert job.execute(MissionCommand(1, 0, 0, MissionAction.AUTO)) == ""
    machine.step(job)
    machine.step(job)
    assert manager.state is not State.IDLE and job.report(0).auto
    assert ForwardingJob(begun(told)[1], told).report(0).auto, "one that begins does not wait"


LAPS = ForwardingMission(
    "test", tuple(place(*p) for p in ((10.0, 0.0), (30.0, 0.0), (30.0, 20.0), (10.0, 20.0))), options=Options(laps=2)
)


@pytest.fixture(scope="module")
def undisturbed_m() -> float:
    """Distance of a planner that drives all laps."""
    machine, manager = begun(LAPS, ())
    machine.run(manager, ended, 900.0)
    return machine.driven_m


@pytest.mark.long
@pytest.mark.parametrize(("after_m", "to_come"), [(35.0, 6), (90.0, 3)])
def test_the_remaining_waypoints_of_all_laps_are_counted(after_m, to_come, undisturbed_m, tmp_path) -> None:
    told = LAPS
    machine, manager = begun(told, ())
    assert manager.progress().left is None
    machine.run(manager, lambda m: machine.driven_m > after_m)
    left = manager.progress().left
    assert left is not None and left.to_come == to_come and not left.ended and left.at is not None
    left_m = PLANE.local(left.at[1].latitude_deg, left.at[1].longitude_deg)[:2]
    assert math.dist(left_m, (machine.x_m, machine.y_m)) < 0.5
    manager = again(machine, manager, told, tmp_path / "progress.json")
    assert manager.progress().left == left, "until something was driven"
    manager.auto()
    completed(machine, manager, 900.0)
    assert machine.driven_m == pytest.approx(undisturbed_m, abs=4.0), "nothing is driven twice or left out"
    assert manager.route.driven_m == pytest.approx(machine.driven_m, abs=1.0)
    assert manager.progress().finished


@pytest.mark.parametrize(
    ("left", "table"),
    [(RouteRemainder(1, ended=True), OURS), (RouteRemainder(0), OURS), (RouteRemainder(0), PAPER_B)],
    ids=["finished", "ours", "paper_b"],
)
def test_a_route_that_is_finished_or_has_no_waypoints_left_is_not_driven_again(left, table) -> None:
    manager = resuming(listed_mission(lie=()), left, table)
    machine = Forwarder(PROFILE, PLANE, [], (49.0, 0.0, 0.0))
    machine.run(manager, ended)
    assert manager.state is State.DONE and machine.driven_m < 0.1
    left = manager.progress().left
    assert left is not None and left.ended, "another planner does not drive the route again"


@pytest.mark.long
def test_a_machine_interrupted_while_returning_keeps_its_extra_places() -> None:
    told = ForwardingMission("test", (place(10.0, 0.0), place(60.0, 0.0)))
    left = RouteRemainder(1, (place(-6.0, 0.0), place(0.0, 0.0)), (place(30.0, 6.0),))
    machine, manager = Forwarder(PROFILE, PLANE, [], (0.0, 0.0, 0.0)), resuming(told, left)
    assert 4.0 < max(followed(machine, manager, lambda: machine.y_m)) < 8.0


HEADINGS = st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-math.pi, math.pi))


@given(HEADINGS)
def test_a_machine_with_any_heading_can_turn_onto_its_route(start) -> None:
    """One of the candidates is drivable; the shortest may have a leg too short for its bends."""
    x, y, yaw = start
    ahead = (x + 3.0 * math.cos(yaw), y + 3.0 * math.sin(yaw))
    ways = dubins_corners((*ahead, yaw), (0.0, 0.0, 0.0), 9.5)
    path = next(filter(None, map(partial(driven, (x, y), ahead), ways)))
    assert abs(math.remainder(path.at(0.0)[2] - yaw, math.tau)) < 0.1
    at_m = path.nearest(0.0, 0.0, 0.0)
    assert math.dist(path.at(at_m)[:2], (0.0, 0.0)) < 0.1


def driven(here: tuple[float, float], ahead: tuple[float, float], corners: Sequence[tuple[float, float]]):
    """The path by these corners onto the route, None where it is refused."""
    try:
        return drivable_path([here, ahead, *corners, (0.0, 0.0), (30.0, 0.0)], PROFILE.carrier)
    except PathRefused:
        return None
