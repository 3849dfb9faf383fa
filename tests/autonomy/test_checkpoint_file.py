"""Checkpoint files: what is written and read back, and which files are refused, also by the planning process."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.__main__ import main
from autonomy.crane_job.rotator_estimate import RotatorEstimate
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
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, KnownLog, MissionError, Point
from autonomy.process.command_line import CONFIGURATION, FINE
from runtime.errors import InputRefused
from tests.autonomy.manager_missions import listed_mission
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
