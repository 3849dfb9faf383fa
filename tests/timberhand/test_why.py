"""`timberhand why`: the stop in words, as JSON and as a plot, from stop files and from recordings without them; and the
service that failed.
"""

from __future__ import annotations

import io
import json
import lzma
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rich.console import Console
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction
from can_dbc.messages.envelope import signed
from can_dbc.messages.tick_record import BusReading, TickRecord, decode
from controller.process.tick_recording import record
from host.exit_codes import CommandFailed, ExitCode
from machine.status.explanation import sentence_of
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from recorder.segment import Segment
from recorder.stop_recorder import TOPIC, files_in
from tests.codes import coded, numbers_in
from tests.controller.bench import Bench
from tests.recorder.stopped_run import RecordedBench, recorder_in, run_with_a_stop
from timberhand.cli import app
from timberhand.commands import why
from timberhand.replay_page import show_recording
from timberhand.why import stops as records
from timberhand.why.screen import show
from timberhand.why.stops import Failure, find_stops, newest_failure
from timberhand.why.timeline import events_of

KEPT = Path(__file__).parents[1] / "recordings"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crane that moves, is refused a datagram, loses an encoder, and later the guard."""
    directory = tmp_path_factory.mktemp("why") / "run"
    recorder = recorder_in(directory)
    bench = RecordedBench([recorder])
    bench.active(ticks=600)
    bench.tick([b"rubbish"])
    bench.drive(0, 0.08, 40)
    bench.tick([bench.moving(0, 0.08)], late_ns=12_000_000)
    bench.drive(0, 0.08, 10)
    bench.lose("EncLift", 1200)
    bench.arm_again()
    bench.lose("GuardStat", 300)
    recorder.close()
    return directory


def invoke(*words: object) -> str:
    done = CliRunner().invoke(app, ["why", *map(str, words)], env={"COLUMNS": "120"}, catch_exceptions=False)
    assert done.exit_code == ExitCode.OK, done.output
    return done.stdout


def refused(*words: object) -> CommandFailed:
    done = CliRunner().invoke(app, ["why", *map(str, words)])
    assert isinstance(done.exception, CommandFailed), done.output
    return done.exception


def test_the_newest_stop_is_explained(run: Path) -> None:
    text = invoke(run)
    assert "GUARD_LOST" in text and "ENCODER_LOST" not in text
    assert sentence_of(Reason.GUARD_LOST) in text and FAULTS[Reason.GUARD_LOST].advice in text
    assert "50.0 ms" in text and Mode.ACTIVE.name in text
    assert any("GuardStat" in line and 50 in numbers_in(line) for line in text.splitlines())
    assert str(files_in(run / "stops")[-1]) in text


def test_all_stops_are_shown_with_what_happened_before_them(run: Path) -> None:
    text = invoke(run, "--all")
    first, second = text.index("ENCODER_LOST"), text.index("GUARD_LOST")
    assert first < second
    lines = text.splitlines()
    happened = ("12.0 ms", "ACTIVE → STOP: ENCODER_LOST", "STOP → FAULT", "RESET")
    for part in (sentence_of(Reason.DATAGRAM_LENGTH), *happened):
        assert part in text, part
    assert any("EncLift" in line and 15 in numbers_in(line) for line in lines)


def test_json_has_values_in_si_units(run: Path) -> None:
    told = json.loads(invoke(run, "--all", "--json"))
    first, second = told["stops"]
    assert (first["code"], first["detail"]) == ("ENCODER_LOST", 1)
    assert (first["mode_before"], first["mode"]) == ("ACTIVE", "STOP")
    age, limit, refused_frames = first["measured"]
    assert age["unit"] == "ms" and age["value"] > limit["value"] == 15.0 and refused_frames["value"] == 0.0
    assert first["text"].endswith("[ENCODER_LOST]") and second["number"] == 2
    assert {"at_s", "text"} == set(first["events"][0])


def test_a_stop_file_alone_is_enough(run: Path, tmp_path: Path) -> None:
    first = shutil.copy(files_in(run / "stops")[0], tmp_path / "copy.mcap")
    assert "ENCODER_LOST" in invoke(first)
    assert "GUARD_LOST" in invoke(run / "stops")


@pytest.mark.long
def test_a_recording_without_stop_files_tells_the_same(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "run.mcap", tmp_path / "run.mcap")
    with_files, without = json.loads(invoke(run, "--all", "--json")), json.loads(invoke(tmp_path, "--all", "--json"))
    assert len(without["stops"]) == 2
    for a, b in zip(with_files["stops"], without["stops"], strict=True):
        a.pop("recording"), b.pop("recording")
        assert a == b


@pytest.mark.parametrize("name", ["palms", "aoro"])
def test_an_old_recording_is_read(name: str, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(lzma.decompress((KEPT / f"{name}.mcap.xz").read_bytes()))
    assert json.loads(invoke(tmp_path, "--json")) == {"stops": [], "plot": None, "failure": None}


def test_without_a_run_the_newest_stop_of_all_runs_is_taken(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("timberhand.why.stops.SERVICE_STOPS", tmp_path / "service")
    assert refused().code == "why.no-stop"
    shutil.copytree(run, tmp_path / "runs" / "a")
    run_with_a_stop(tmp_path / "runs" / "b", after=20)
    for path in files_in(tmp_path / "runs" / "a" / "stops"):
        os.utime(path, (1, 1))
    assert "ENCODER_LOST" in invoke()
    shutil.copytree(run / "stops", tmp_path / "service")
    for path in files_in(tmp_path / "service"):
        os.utime(path)
    assert "GUARD_LOST" in invoke()


def test_a_place_without_a_record_is_refused_in_words(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "none"):
        error = refused(place)
        assert error.code == "why.no-record" and error.exit_code is ExitCode.CONFIGURATION
    (tmp_path / "text.mcap").write_text("this is no recording")
    assert refused(tmp_path / "text.mcap").code == "recording.not-mcap"


def test_the_plot_is_a_picture_of_the_newest_stop(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "why.png"
    assert str(path) in invoke(run, "--plot", path) and path.is_file()


def test_an_operator_and_a_pressed_stop_are_events(tmp_path: Path) -> None:
    recorder = recorder_in(tmp_path)
    bench = RecordedBench([recorder])
    bench.active(ticks=100)
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0, "ModeSwitch": 1}
    bench.changed["GuardStat"] = {"Enable": 0, "Verdict": 7}
    bench.run(20, bus_errors=12)
    bench.tick([bench.operator(OperatorAction.RESET)], bus_errors=12)
    bench.run(100, bus_errors=12, bus_state=2)
    recorder.close()
    (found,) = find_stops(tmp_path)
    texts = [event.text for event in events_of(found.ticks, found.stop.at_ns)]
    pressed = "ChannelA Released → Pressed, ChannelB Released → Pressed"
    assert f"EstopStat: {pressed}, ModeSwitch NotFitted → Idle" in texts
    assert "GuardStat: Enable Enabled → Disabled, Verdict GOOD → ESTOP" in texts
    assert "operator: RESET" in texts and "crane0: ACTIVE → PASSIVE" in texts
    assert any("crane0" in text and 12 in numbers_in(text) for text in texts)
    assert found.stop.code == "ESTOP_PRESSED"


def test_a_recording_of_a_release_that_kept_authenticators_is_refused(tmp_path: Path) -> None:
    recorder = recorder_in(tmp_path / "run")
    bench = Bench()
    for _ in range(20):
        outputs = bench.tick()
        if outputs.report is not None:
            outputs.report = signed(outputs.report, b"0123456789abcdef")
        recorder.on_tick(record(bench.inputs, outputs, bench.now_ns))
    recorder.close()
    assert refused(tmp_path / "run").code == "recording.reports-unreadable"


def test_missing_numbers_are_explained(run: Path) -> None:
    (found,) = find_stops(run, newest=True)
    told, unknown = [], (None, None, None)
    for reason, numbers in ((Reason.PERSON_IN_ZONE, unknown), (Reason.GUARD_LOST, unknown), (Reason.GUARD_LOST, ())):
        stop = msgspec.structs.replace(found.stop, reason=int(reason), code=reason.name, numbers=numbers)
        text = io.StringIO()
        show(Console(file=text, width=120), replace(found, stop=stop), [])
        (line,) = [line for line in text.getvalue().splitlines() if line.split()[:1] == ["measured"]]
        told.append(line.split()[1:])
    assert all(told) and len(set(map(tuple, told))) == 3, "none belongs to it, unknown, of an earlier release"


def test_heartbeats_of_an_operator_are_an_event_only_when_they_stop(tmp_path: Path) -> None:
    recorder = recorder_in(tmp_path)
    bench = RecordedBench([recorder])
    bench.active(ticks=40)
    for k in range(400):
        sent = [bench.moving(0, 0.01)] if k % 10 == 0 and bench.mode is Mode.ACTIVE else []
        bench.tick([*sent, bench.operator(OperatorAction.WATCH)] if k % 40 == 0 and k < 160 else sent)
    recorder.close()
    (found,) = find_stops(tmp_path)
    texts = [event.text for event in events_of(found.ticks, found.stop.at_ns)]
    assert found.stop.code == "OPERATOR_LINK_LOST"
    assert any(500 in numbers_in(text) for text in texts)
    assert not any("WATCH" in text for text in texts)


def test_a_watch_that_ends_on_purpose_is_no_silence() -> None:
    def tick(bench: Bench, *sent: OperatorAction) -> TickRecord:
        outputs = bench.tick([bench.operator(action) for action in sent])
        return decode(record(bench.inputs, outputs, bench.now_ns))

    bench = Bench().boot()
    ticks = [tick(bench, OperatorAction.WATCH), tick(bench, OperatorAction.WATCH_END)]
    ticks += [tick(bench) for _ in range(200)]
    texts = [event.text for event in events_of(ticks, bench.now_ns)]
    assert "operator: WATCH_END" in texts and not any(500 in numbers_in(text) for text in texts)


# -- its page


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    (tmp_path / "run.mcap").write_bytes(lzma.decompress((KEPT / "palms.mcap.xz").read_bytes()))
    return tmp_path


def test_a_stop_opens_ten_seconds_before(monkeypatch: pytest.MonkeyPatch, kept: Path) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr("timberhand.replay_page.serve_replay", lambda *_, **told: asked.update(told))
    show_recording(kept, None, 0, stop_ns=25 * 10**9)
    assert asked["at_ns"] == 15 * 10**9


def test_a_run_without_a_stop_has_no_page_of_one(kept: Path) -> None:
    refused = CliRunner().invoke(app, ["why", str(kept), "--page"]).exception
    assert isinstance(refused, CommandFailed) and refused.code == "why.no-stop"


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CommandFailed, check=coded("recording.none")):
        show_recording(tmp_path, None, 0)


# -- a service that failed; the units' script writes its record

GUARD = "timberhand-guard.service"


def test_only_what_failed_since_the_last_stop_is_told_with_its_number(tmp_path: Path) -> None:
    file = tmp_path / "failures.jsonl"
    text = '{"unit": "%s", "result": "signal", "code": "killed", "status": "KILL", "utc_s": %d, "release": "1.0-a"}\n'
    file.write_text("".join(text % pair for pair in (("a", 10), (GUARD, 20), ("a", 25), (GUARD, 30))) + '{"unit": "cu')
    newest = newest_failure(15 * 10**9, file)
    assert newest is not None and (newest[0].utc_s, newest[1]) == (30, 2)
    assert newest_failure(40 * 10**9, file) is None and newest_failure(None, tmp_path / "none") is None


def test_why_tells_a_failure_where_there_is_no_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = Failure(unit=GUARD, result="watchdog", code="killed", status="KILL", utc_s=86400, release="1.0-abc")
    monkeypatch.setattr(records, "newest_failure", lambda after: (found, 3) if after is None else None)
    monkeypatch.setattr(why, "_explain", lambda *_: (0, None))
    done = CliRunner().invoke(app, ["why"])
    assert done.exit_code == 0 and GUARD in done.stdout
    assert "1970-01-02 00:00:00" in done.stdout and 3 in numbers_in(done.stdout) and "journalctl -u" in done.stdout
    assert json.loads(CliRunner().invoke(app, ["why", "--json"]).stdout)["failure"]["times"] == 3


def test_a_gnss_receiver_that_falls_silent_is_on_the_timeline() -> None:
    codec, quiet = load("gnss").message("PositionRapidUpdate"), BusReading()

    def tick(k: int) -> TickRecord:
        now_ns = k * 5_000_000
        position = [Frame(now_ns, codec.key, bytes(codec.length))] if k % 20 == 0 and k <= 200 else []
        return TickRecord(now_ns, 0, 0, 0, quiet, quiet, (), position, (), (), (), b"")

    (event,) = events_of(tuple(map(tick, range(400))), 1_800_000_000)
    assert event.at_s == pytest.approx(-0.8) and event.text.startswith("PositionRapidUpdate silent")


@pytest.mark.parametrize("words", [[], ["--page", "--port", "0"]])
def test_a_stop_that_this_release_cannot_read_is_one_sentence(words: list[str], tmp_path: Path) -> None:
    file = Segment(tmp_path / "000001-1.000s-LATER.mcap", durable=False)
    file.channel(TOPIC, "json", "Stop", b"{}")
    file.add(TOPIC, 1, 1, b'{"number": 1, "written": "by a later release"}')
    file.finish()
    assert refused(tmp_path, *words).code == "why.unusable"
