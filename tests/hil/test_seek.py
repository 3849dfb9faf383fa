"""A recording read from any time on: as from front to back; and the sentence for one that is cut off."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import msgspec
import pytest

from can_dbc.messages import datagrams, tick_record
from can_dbc.messages.crane import StateReport
from can_dbc.messages.vehicle import VehicleReport
from console.can_tap import load_databases
from console.replay import Overview, ReplayView
from hil.replay.recording import messages
from hil.replay.seek import SeekableRecording
from hil.tick.compare import kept_recordings
from host.exit_codes import CommandFailed
from machine.loading.profile_file import load_profile
from recorder.manifest import describe
from recorder.recorder import TICK, Recorder
from tests.codes import coded


@pytest.fixture(scope="module")
def aoro(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return kept_recordings(tmp_path_factory.mktemp("kept"))[0]


Reports = Iterable[StateReport | VehicleReport]


def same(some: Reports, others: Reports) -> bool:
    a, b = (sorted((r.stamp_ns, type(r).__name__, msgspec.json.encode(r)) for r in each) for each in (some, others))
    return a == b and len(a) > 5


def test_reports_and_frames_are_those_of_the_recorded_ticks(aoro: Path) -> None:
    recording = SeekableRecording([aoro])
    ticks = [tick_record.decode(data) for data in messages([aoro], TICK)]
    recorded = [datagrams.decode(d) for t in ticks for d in (t.report, t.vehicle_report) if d]
    assert {StateReport, VehicleReport} == {type(report) for report in recorded}
    begin, end = ticks[500].now_ns, ticks[900].now_ns
    wanted = [r for r in recorded if begin <= r.stamp_ns < end]
    assert same(recording.reports(begin, end), wanted)
    assert any(math.isnan(v) for r in wanted if isinstance(r, StateReport) for v in r.position)
    heard = {(f.stamp_ns, f.key, f.data) for t in ticks[501:900] for f in t.machine_frames_in}
    assert heard <= {tuple(f) for f in recording.frames(recording.buses[1], begin - 10**7, end)}


def test_a_file_with_ticks_alone_shows_the_same(aoro: Path, tmp_path: Path) -> None:
    profile = load_profile("aoro_fc8")
    recorder = Recorder(
        tmp_path, profile, describe(profile, (profile.crane_bus, profile.machine_bus or "")), sync=False
    )
    for data in messages([aoro], TICK):
        recorder.on_tick(data)
    recorder.close()
    whole, ticks = SeekableRecording([aoro]), SeekableRecording([tmp_path / "run.mcap"])
    begin = whole.begin_ns + 4 * 10**9
    assert same(ticks.reports(begin, begin + 10**9), whole.reports(begin, begin + 10**9))
    assert ticks.frames("mach0", begin, begin + 10**8)


def test_a_page_of_the_recording_seeks_and_plays(aoro: Path) -> None:
    recording, profile = SeekableRecording([aoro]), load_profile("aoro_fc8")
    overview = Overview(recording, profile)
    view = ReplayView(recording, profile, overview, load_databases(profile), recording.begin_ns + 6 * 10**9)
    state = view.step(0)
    assert state["alive"] and state["mode"] == "ACTIVE" and state["vehicle"]["place"] and len(state["history"]) > 40
    assert view.order("panel can")
    (crane, machine) = view.step(10**9)["can"]
    assert crane["load_pct"] > 20 and machine["rows"] and not any(row["refused"] for row in crane["rows"])
    assert len(overview.trail) > 5 and [e["title"] for e in overview.entries][-1] == "ACTIVE"


def test_a_file_that_is_still_written_is_refused(aoro: Path, tmp_path: Path) -> None:
    part = tmp_path / "run.mcap"
    part.write_bytes(aoro.read_bytes()[:-1000])
    with pytest.raises(CommandFailed, check=coded("replay.unfinished")):
        SeekableRecording([part])
