"""A planner that is started again: what it knows of the mission, what it does first, and which files it refuses."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
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
    Checkpoint,
    LogKnowledge,
    MissedLog,
    RouteRemainder,
    copied_tally,
    mission_digest,
)
from autonomy.manager.checkpoint_file import PERIOD_NS, CheckpointFile, MissionFinished, read_checkpoint
from autonomy.manager.tally import Load, LoadedLog, Tally
from autonomy.manager.transition_table import OURS, PAPER_B, RULES, State
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, KnownLog, Landing, MissionError, Options, Point
from autonomy.navigation.clothoid_path import PathRefused, drivable_path
from autonomy.navigation.dubins import dubins_corners
from autonomy.process.exit_codes import CONFIGURATION, FINE
from autonomy.process.jobs import ForwardingJob
from can_dbc.messages.mission import MissionOrder, Order
from machine.loading.profile_file import profile_hash
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.manager_missions import PLANE, PROFILE, again, at, ended, place, states, whole
from tests.autonomy.mapped_logs import lying
from tests.codes import coded

LIE = ((15.0, 4.2), (36.0, -4.2))
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "paper_b.geojson"


def mission(landing=None, lie=LIE, end_m: float = 50.0, **options) -> ForwardingMission:
    known = tuple(KnownLog(place(x, y), "", 90.0, 2.0, 0.25) for x, y in lie)
    landings = () if landing is None else (Landing(place(*landing)),)
    way = (place(10.0, 0.0), place(end_m, 0.0))
    return ForwardingMission("test", way, (), landings, known, Options(logs="listed", **options))


def begun(told: ForwardingMission, lie=LIE, table=OURS) -> tuple[Forwarder, ActivityManager]:
    manager = ActivityManager(PROFILE, profile_hash(PROFILE), told, table, plane=PLANE)
    manager.auto()
    logs = [lying(i, x, y, 0.0) for i, (x, y) in enumerate(lie, 1)]
    return Forwarder(PROFILE, PLANE, logs, (0.0, 0.1, 0.05)), manager


def loaded(count: int, state: State):
    return lambda manager: manager.tally.loaded >= count and manager.state is state


def unloads(manager: ActivityManager) -> bool:
    return manager.state is State.UNLOAD and manager.activity is not None and manager.activity.grasp is not None


# ---------------------------------------------------------------------- going on
@whole
@pytest.mark.parametrize("landing", [None, (58.0, 14.0)])
@pytest.mark.parametrize(
    "left_at", [at(State.SEARCH), at(State.APPROACH), at(State.COLLECT), loaded(1, State.CHECK),
                loaded(1, State.SEARCH), loaded(1, State.APPROACH), loaded(2, State.STOW)],
)  # fmt: skip
def test_a_mission_that_is_started_again_comes_to_the_same_tally(landing, left_at, tmp_path: Path) -> None:
    told = mission(landing)
    machine, manager = begun(told)
    machine.run(manager, left_at)
    left_m, before = machine.x_m, manager.tally.loaded
    manager = again(machine, manager, told, tmp_path / "progress.json")
    assert manager.resumed and manager.tally.loaded == before
    manager.auto()
    behind = []

    def over(_: ActivityManager) -> bool:
        behind.append(machine.x_m)
        return ended(manager)

    machine.run(manager, over, 900.0)
    assert manager.state is State.DONE, manager.failure
    assert manager.tally.loaded == 2 and not manager.tally.given_up
    assert states(manager).count(State.APPROACH) == 2 - before, "nobody looks again for what was taken"
    assert states(manager)[:3] == [State.STOW, State.RAISE, State.SEARCH], "the crane was anywhere"
    assert min(behind) > left_m - 1.0, "it does not drive back"
    if landing is None:
        assert machine.in_bunk == 2
    else:
        assert manager.tally.unloaded == 2 and [len(load.logs) for load in manager.tally.loads] == [2]
        assert manager.tally.loads[0].driven_m == pytest.approx(machine.driven_m, abs=1.0)


@whole
@pytest.mark.parametrize("left_at", [at(State.HAUL), at(State.SETTLE), unloads])
def test_a_load_that_was_under_way_still_comes_to_its_landing(left_at, tmp_path: Path) -> None:
    told = mission((58.0, 14.0))
    machine, manager = begun(told)
    machine.run(manager, left_at, 900.0)
    manager = again(machine, manager, told, tmp_path / "progress.json")
    manager.auto()
    machine.run(manager, ended, 900.0)
    assert manager.state is State.DONE, manager.failure
    assert manager.tally.loaded == 2 and machine.in_bunk == manager.tally.on_board == 0
    assert [len(load.logs) for load in manager.tally.loads] == [2]
    assert all(math.dist(log.center_m[:2], (58.0, 14.0)) < 1.6 for log in machine.field.values())


@whole
def test_paper_b_goes_on_too(tmp_path: Path) -> None:
    told = mission()
    machine, manager = begun(told, table=PAPER_B)
    machine.run(manager, loaded(1, State.SEARCH))
    manager = again(machine, manager, told, tmp_path / "progress.json", PAPER_B)
    manager.auto()
    machine.run(manager, ended, 900.0)
    assert manager.state is State.DONE and machine.in_bunk == manager.tally.loaded == 2


@whole
@pytest.mark.parametrize("left_at", [unloads, lambda m: m.tally.loads and m.route.along_m > 5.0])
def test_from_a_landing_the_machine_comes_back_to_where_it_left_its_route(left_at, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(Tally, "full", lambda self, _bunk, _next_m3=0.0: self.on_board >= 1)
    told = mission((20.0, -20.0))
    machine, manager = begun(told)
    machine.run(manager, at(State.HAUL))
    left_m = (machine.x_m, machine.y_m)
    machine.run(manager, lambda m: m.state is not State.HAUL and left_at(m), 900.0)
    manager = again(machine, manager, told, tmp_path / "progress.json")
    manager.auto()
    if left_at is unloads:
        driven_m = machine.driven_m
        machine.run(manager, at(State.UNLOAD))
        assert machine.driven_m - driven_m < 1.0, "it stands beside the landing already"
    nearest_m = []

    def over(_: ActivityManager) -> bool:
        nearest_m.append(math.dist((machine.x_m, machine.y_m), left_m))
        return ended(manager)

    machine.run(manager, over, 1800.0)
    assert min(nearest_m) < 1.0
    assert manager.state is State.DONE, manager.failure
    assert manager.tally.unloaded == 2 and len(manager.tally.loads) == 2


@whole
def test_a_log_that_was_given_up_stays_given_up(tmp_path: Path) -> None:
    told = mission(lie=LIE[:1], end_m=26.0)
    machine, manager = begun(told, LIE[:1])
    machine.crane.slippery = 9
    machine.run(manager, lambda m: bool(m.tally.given_up), 900.0)
    machine.run(manager, at(State.SEARCH))
    missed = manager.tally.missed
    manager = again(machine, manager, told, tmp_path / "progress.json")
    manager.auto()
    machine.run(manager, ended, 900.0)
    assert manager.state is State.DONE and list(manager.tally.given_up) == [1]
    assert State.COLLECT not in states(manager) and manager.tally.missed == missed


def test_a_mission_that_goes_on_waits_for_auto(tmp_path: Path) -> None:
    told = mission()
    machine, manager = begun(told)
    machine.run(manager, at(State.SEARCH))
    manager = again(machine, manager, told, tmp_path / "progress.json")
    job = ForwardingJob(manager, told)
    for _ in range(100):
        machine.step(job)  # type: ignore[arg-type]
    assert manager.state is State.IDLE and machine.drive is None and machine.crane.setpoint is None
    assert not job.report(0).auto
    assert job.report(0).words != RULES[State.IDLE].description
    assert job.execute(MissionOrder(1, 0, 0, Order.AUTO)) == ""
    machine.step(job)  # type: ignore[arg-type]
    machine.step(job)  # type: ignore[arg-type]
    assert manager.state is not State.IDLE and job.report(0).auto
    assert ForwardingJob(begun(told)[1], told).report(0).auto, "one that begins does not wait"


LAPS = ForwardingMission("test", tuple(place(*p) for p in ((10.0, 0.0), (30.0, 0.0), (30.0, 20.0), (10.0, 20.0))),
                         options=Options(laps=2))  # fmt: skip


@pytest.fixture(scope="module")
def undisturbed_m() -> float:
    """The way of a planner that drives all laps."""
    machine, manager = begun(LAPS, ())
    machine.run(manager, ended, 900.0)
    return machine.driven_m


@pytest.mark.parametrize(("after_m", "to_come"), [(35.0, 6), (90.0, 3)])
def test_what_is_left_of_the_laps_is_counted(
    after_m: float, to_come: int, undisturbed_m: float, tmp_path: Path
) -> None:
    told = LAPS
    machine, manager = begun(told, ())
    assert manager.progress().left is None
    machine.run(manager, lambda m: machine.driven_m > after_m)
    left = manager.progress().left
    assert left is not None and left.to_come == to_come and not left.ended and left.at is not None
    assert (
        math.dist(PLANE.local(left.at[1].latitude_deg, left.at[1].longitude_deg)[:2], (machine.x_m, machine.y_m)) < 0.5
    )
    manager = again(machine, manager, told, tmp_path / "progress.json")
    assert manager.progress().left == left, "as long as nothing was driven"
    manager.auto()
    machine.run(manager, ended, 900.0)
    assert manager.state is State.DONE
    assert machine.driven_m == pytest.approx(undisturbed_m, abs=4.0), "nothing is driven twice or left out"
    assert manager.route.driven_m == pytest.approx(machine.driven_m, abs=1.0)
    assert manager.progress().finished


def test_a_route_that_was_driven_to_its_end_is_not_driven_again() -> None:
    told = mission(lie=())
    left = RouteRemainder(1, ended=True)
    manager = ActivityManager(
        PROFILE, profile_hash(PROFILE), told, progress=Checkpoint(mission="", tally=Tally(), left=left)
    )
    manager.auto()
    machine = Forwarder(PROFILE, PLANE, [], (49.0, 0.0, 0.0))
    machine.run(manager, ended)
    assert manager.state is State.DONE and machine.driven_m < 0.1


def test_a_machine_that_stands_on_its_way_back_keeps_the_places_that_it_was_to_drive_by() -> None:
    told = ForwardingMission("test", (place(10.0, 0.0), place(60.0, 0.0)))
    left = RouteRemainder(1, (place(-6.0, 0.0), place(0.0, 0.0)), (place(30.0, 6.0),))
    manager = ActivityManager(
        PROFILE, profile_hash(PROFILE), told, progress=Checkpoint(mission="", tally=Tally(), left=left)
    )
    manager.auto()
    machine = Forwarder(PROFILE, PLANE, [], (0.0, 0.0, 0.0))
    aside_m = []

    def over(_: ActivityManager) -> bool:
        aside_m.append(machine.y_m)
        return ended(manager)

    machine.run(manager, over)
    assert manager.state is State.DONE and 4.0 < max(aside_m) < 8.0


HEADINGS = st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-math.pi, math.pi))


@given(HEADINGS)
def test_a_machine_that_looks_anywhere_can_turn_onto_its_route(start) -> None:
    """One of the ways is drivable, as the ride tries them; the shortest may have a leg too short for its bends."""
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


# ---------------------------------------------------------------------- the file
def some(told: ForwardingMission, **more) -> Checkpoint:
    return Checkpoint(mission=mission_digest(told), tally=Tally(loaded=3), **more)


def kept(path: Path, progress: Checkpoint, now_ns: int = 5, unix_ns: int = 10**18) -> Path:
    CheckpointFile(path).keep(progress, now_ns, unix_ns)
    return path


def test_without_a_file_the_mission_begins(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path / "none.json", mission(), 0, 0) is None


def test_times_outlast_the_start_of_the_computer(tmp_path: Path) -> None:
    taken = LoadedLog(Point(63.0, 19.0), 80 * PERIOD_NS, 0.1)
    progress = Checkpoint(
        mission=mission_digest(mission()), tally=Tally(board=[taken], loads=[Load((taken,), 90 * PERIOD_NS, 5.0)])
    )
    path = kept(tmp_path / "p", progress, 100 * PERIOD_NS, 10**18)
    found = read_checkpoint(path, mission(), 3 * PERIOD_NS, 10**18 + 60 * PERIOD_NS)
    assert found is not None
    then_ns = 10**18 - (10**18 + 60 * PERIOD_NS) + 3 * PERIOD_NS  # when it was kept, by the new clock
    assert found.tally.board[0].at_ns == then_ns - 20 * PERIOD_NS
    assert found.tally.loads[0].at_ns == then_ns - 10 * PERIOD_NS
    assert found.tally.loads[0].logs == tuple(found.tally.board)


def test_it_is_written_when_it_has_changed_and_at_most_once_a_second(tmp_path: Path) -> None:
    path, told = tmp_path / "p", mission()
    book = CheckpointFile(path)
    assert book.due(0)
    book.keep(some(told), 0, 0)
    assert not book.due(PERIOD_NS - 1) and book.due(PERIOD_NS)
    path.unlink()
    book.keep(some(told), PERIOD_NS, 0)
    assert not path.exists() and not book.due(PERIOD_NS + 1)
    book.keep(some(told, rounds=1), 2 * PERIOD_NS, 0)
    assert [p.name for p in tmp_path.iterdir()] == ["p"], "nothing is left beside it"


@pytest.mark.parametrize(
    "spoil",
    [lambda text: text[: len(text) // 2], lambda text: "", lambda text: text.replace('"schema":1', '"schema":2'),
     lambda text: text.replace('"loaded":3', '"loaded":"three"'), lambda text: "[]", lambda text: "\xff\xfe"],
)  # fmt: skip
def test_a_damaged_file_is_one_sentence(spoil, tmp_path: Path) -> None:
    path = kept(tmp_path / "p", some(mission()))
    path.write_bytes(spoil(path.read_text()).encode("latin-1"))
    with pytest.raises(MissionError, check=coded("checkpoint.damaged")):
        read_checkpoint(path, mission(), 0, 0)


@pytest.mark.parametrize(
    "what",
    [{"landing": 1}, {"served": (2,)}, {"left": RouteRemainder(3)}, {"tally": Tally(loads=[Load((), 0, 0.0, 4)])}],
)
def test_a_file_that_names_what_the_mission_has_not_is_damaged(what, tmp_path: Path) -> None:
    told = mission((58.0, 14.0))
    path = kept(tmp_path / "p", msgspec.structs.replace(some(told), **what))
    with pytest.raises(MissionError, check=coded("checkpoint.unknown-place")):
        read_checkpoint(path, told, 0, 0)
    good = {"landing": 0, "served": (0,), "left": RouteRemainder(2)}
    assert read_checkpoint(kept(tmp_path / "q", msgspec.structs.replace(some(told), **good)), told, 0, 0) is not None


def test_another_mission_and_a_file_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    path = kept(tmp_path / "p", some(mission(logs_wanted=1)))
    with pytest.raises(MissionError, check=coded("checkpoint.other-mission")):
        read_checkpoint(path, mission(), 0, 0)
    with pytest.raises(MissionError, check=coded("checkpoint.unreadable")):
        read_checkpoint(tmp_path, mission(), 0, 0)


def test_a_finished_mission_says_so(tmp_path: Path) -> None:
    path = kept(tmp_path / "p", some(mission(), finished=True))
    with pytest.raises(MissionFinished, check=coded("checkpoint.finished")):
        read_checkpoint(path, mission(), 0, 0)


TEXT = st.text(max_size=8)
METRES = st.floats(0.0, 1e4)
NUMBER = st.integers(0, 10**6)
PLACE = st.builds(Point, st.floats(-90.0, 90.0), st.floats(-180.0, 180.0))
TAKEN = st.builds(LoadedLog, PLACE, st.integers(0, 2**62), METRES, TEXT)
LOAD = st.builds(Load, st.lists(TAKEN, max_size=3).map(tuple), st.integers(0, 2**62), METRES, st.just(0))
TALLY = st.builds(
    Tally, NUMBER, NUMBER, NUMBER, NUMBER, NUMBER, METRES, METRES, st.booleans(),
    st.dictionaries(NUMBER, TEXT, max_size=3), st.lists(LOAD, max_size=3), st.lists(TAKEN, max_size=3), METRES,
)  # fmt: skip
LOG = st.builds(KnownLog, PLACE, st.just(""), st.floats(0.0, 360.0), METRES, METRES, TEXT, TEXT)
KNOWN = st.builds(
    LogKnowledge, st.lists(NUMBER, max_size=3).map(tuple),
    st.lists(st.builds(MissedLog, NUMBER, LOG, NUMBER), max_size=3).map(tuple), NUMBER,
)  # fmt: skip
LEFT = st.builds(
    RouteRemainder,
    st.integers(0, 2),
    st.none() | st.tuples(PLACE, PLACE),
    st.lists(PLACE, max_size=3).map(tuple),
    st.booleans(),
)


@given(TALLY, KNOWN, st.none() | LEFT, st.sampled_from([None, 0]), st.sampled_from([(), (0,)]), NUMBER, METRES)
def test_what_is_kept_is_read_again(tmp_path_factory, tally, known, left, landing, served, rounds, driven_m) -> None:
    told = mission((58.0, 14.0))
    progress = Checkpoint(
        mission=mission_digest(told), tally=tally, known=known, left=left, landing=landing, served=served, rounds=rounds,
        driven_m=driven_m, rotator=RotatorEstimate(driven_m, -driven_m, (0.8, 1.1)),
    )  # fmt: skip
    path = kept(tmp_path_factory.getbasetemp() / "p", progress, 7, 11)
    assert read_checkpoint(path, told, 7, 11) == progress
    later = read_checkpoint(path, told, 7 + 1000, 11)
    assert later is not None and later.tally == copied_tally(tally, 1000)


# ---------------------------------------------------------------------- the process
def start(progress: Path, *more: str) -> int:
    return main(
        ["--profile", "aoro_fc8", "--controller", "127.0.0.1:1", "--scene", "127.0.0.1:2", "--report-port", "0",
         "--order-port", "0", "--mission", str(EXAMPLE), "--progress", str(progress), *more]
    )  # fmt: skip


def test_the_process_refuses_another_missions_file_and_a_damaged_one(tmp_path: Path, capsys) -> None:
    path = kept(tmp_path / "p", some(mission()))
    before = path.read_bytes()
    assert start(path) == CONFIGURATION
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and not said.out
    assert path.read_bytes() == before
    path.write_text("{")
    assert start(path) == CONFIGURATION
    assert capsys.readouterr().err.count("\n") == 1 and path.read_text() == "{"


def test_the_process_says_that_a_mission_is_finished(tmp_path: Path, capsys) -> None:
    told = load_mission(EXAMPLE).mission
    path = kept(tmp_path / "p", some(told, finished=True))
    assert start(path) == FINE
    event = json.loads(capsys.readouterr().out)
    assert event["event"] == "done" and "3 logs" in event["reason"]


def test_the_process_refuses_a_place_where_nothing_can_be_kept(tmp_path: Path, capsys) -> None:
    assert start(tmp_path / "none" / "p") == CONFIGURATION
    assert "No such file or directory" in capsys.readouterr().err


@pytest.mark.parametrize("left_out", ["--mission", "--order-port"])
def test_progress_needs_a_mission_and_somebody_who_can_order_auto(left_out: str, capsys) -> None:
    words = ["--controller", "127.0.0.1:1", "--scene", "127.0.0.1:2", "--report-port", "0", "--progress", "p"]
    words += [
        w for name, value in (("--mission", "m"), ("--order-port", "0")) if name != left_out for w in (name, value)
    ]
    with pytest.raises(SystemExit) as ended_:
        main(words)
    assert ended_.value.code == 2
