"""Replay: the same code gives the same bytes; anything else is found and named."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages import datagrams, tick_record
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from controller.config import load as load_settings
from controller.process.tick_recording import record
from controller.step import Controller, step
from controller.tick import Inputs
from hil.replay.recording import contents, files_of, manifest_of, messages
from hil.replay.replay import replay
from hil.tick.compare import kept_recordings
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile
from recorder import recorder as recorder_module
from recorder.manifest import describe
from recorder.recorder import Recorder
from tests.codes import coded, numbers_in
from timberhand.cli import app

PROFILE = load_profile("palms_471")
SETTINGS = load_settings("palms_471")
CRANE = load("crane")
T_NS = SETTINGS.period_ns
START_NS = 1_000_000_000
TICKS = 120


def inputs_of(k: int, inputs: Inputs) -> int:
    """Fills the inputs of tick ``k``: sensors of a standing crane, a damaged frame, an operator; gives its time."""
    now_ns = START_NS + k * T_NS
    inputs.frames.clear()
    for name in ("EncSlew", "EncLift", "EncTilt", "EncRot"):
        message = CRANE.message(name)
        values = {"Position": 8192 + k % 3, "TimeStamp": k, "Alarms": 0}
        data = message.encode(*(values[s.name] for s in message.signals))
        inputs.frames.append(Frame(now_ns - 1_000_000, message.key, data))
    inputs.frames.append(Frame(now_ns - 900_000, CRANE.message("GuardStat").key, bytes([k & 255] * 8)))
    stop = OperatorCommand(k, SETTINGS.profile_hash, now_ns, OperatorAction.STOP)
    inputs.datagrams[:] = [datagrams.encode(stop)] if k % 10 == 3 else []
    inputs.missed_ticks = 0
    inputs.late_ns = 1000 * k
    return now_ns


def tick_records(ticks: int = TICKS) -> list[bytes]:
    controller, inputs, records = Controller(SETTINGS), Inputs(), []
    for k in range(ticks):
        now_ns = inputs_of(k, inputs)
        out = step(controller, inputs, now_ns)
        records.append(record(inputs, out, now_ns))
    return records


RECORDS = tick_records()


def keep(directory: Path, records: list[bytes], machine=PROFILE, **manifest) -> Path:
    fields = describe(machine, ("crane0",), seed=1)
    recorder = Recorder(directory, machine, recorder_module.msgspec.structs.replace(fields, **manifest))
    for data in records:
        recorder.on_tick(data)
    recorder.close()
    return directory


def again(data: bytes, **changes) -> bytes:
    """A tick record with some of its fields changed."""
    return tick_record.encode(replace(tick_record.decode(data), **changes))


def run(*arguments: object):
    """``timberhand replay ...`` with the exit code the shell sees."""
    result = CliRunner().invoke(app, ["replay", *map(str, arguments)])
    if isinstance(result.exception, CommandFailed):
        return result.exception.exit_code, str(result.exception)
    return result.exit_code, result.stdout


def test_recorded_run_agrees_byte_for_byte(tmp_path):
    seen = []
    result = replay(files_of(keep(tmp_path, RECORDS)), progress=lambda *at: seen.append(at))
    assert result.agrees and result.ticks == TICKS and result.rate_hz == SETTINGS.rate_hz
    assert seen[-1] == (TICKS, TICKS)
    # The inputs matter: the stream holds reports, refused datagrams and received frames.
    reports = [datagrams.decode(t.report) for t in map(tick_record.decode, RECORDS) if t.report]
    assert len(reports) > TICKS / 5 and reports[-1].frames_received > 0
    code, text = run(tmp_path)
    assert code == 0 and TICKS in numbers_in(text)


def test_kept_recordings_replay_byte_for_byte(tmp_path):
    """The controller decides as it did: `tests/recordings` holds the first seconds of two lockstep runs, a crane on a
    fixed base (palms_471: start-up, arming, the first motion) and a forwarder on both buses (aoro_fc8: start-up,
    driving, a search), with the profiles of commit 7d68e2e.  A change of a database or of the law wants new ones::

        timberhand demo --lockstep --profile tests/recordings/palms.toml --limit-s 8
        timberhand mission run docs/examples/paper_b.geojson --lockstep --profile tests/recordings/aoro.toml --limit-s 8
    """
    for path, ticks in zip(kept_recordings(tmp_path), (2200, 1600), strict=True):
        result = replay(files_of(path))
        assert result.agrees and result.ticks == ticks, result


def test_tampered_output_is_found_and_shown_decoded(tmp_path):
    frames = list(tick_record.decode(RECORDS[50]).frames_out)
    i = next(i for i, (key, _) in enumerate(frames) if key == CRANE.message("ValveCmdA").key)
    key, data = frames[i]
    frames[i] = (key, data[:2] + bytes([data[2] ^ 0x40]) + data[3:])
    records = [*RECORDS[:50], again(RECORDS[50], frames_out=tuple(frames)), *RECORDS[51:]]
    result = replay(files_of(keep(tmp_path, records)))
    assert not result.agrees and result.ticks == 50 and result.difference["tick"] == 50
    (recorded,), (replayed,) = result.difference["recorded"], result.difference["replayed"]
    assert recorded != replayed and recorded.split()[1] == replayed.split()[1] == "ValveCmdA"
    code, text = run(tmp_path)
    assert code == ExitCode.FIGURE_MISSED and {50, 0.25} <= set(numbers_in(text)) and "ValveCmdA" in text


def test_what_was_said_on_mach0_counts_too(tmp_path):
    aoro = load_settings("aoro_fc8")
    controller, inputs, records = Controller(aoro), Inputs(), []
    for k in range(20):
        now_ns = inputs_of(k, inputs)
        inputs.datagrams.clear()
        records.append(record(inputs, step(controller, inputs, now_ns), now_ns))
    assert replay(files_of(keep(tmp_path / "good", records, machine=aoro.profile))).agrees
    at = next(k for k in range(5, 20) if tick_record.decode(records[k]).machine_frames_out)
    (key, data), *more = tick_record.decode(records[at]).machine_frames_out
    records[at] = again(records[at], machine_frames_out=((key, data[:6] + b"\x00" + data[7:]), *more))
    result = replay(files_of(keep(tmp_path / "bad", records, machine=aoro.profile)))
    assert result.difference["tick"] == at
    assert "VehCmd" in result.difference["recorded"][0] and "Brake=0" in result.difference["recorded"][0]
    assert "Brake=100" in result.difference["replayed"][0]


@pytest.mark.parametrize("field", ["report", "order", "missing"])
def test_every_part_of_the_output_counts(tmp_path, field):
    at = next(k for k in range(60, TICKS) if tick_record.decode(RECORDS[k]).report)
    t = tick_record.decode(RECORDS[at])
    changes = {
        "report": {"report": t.report[:-5] + bytes([t.report[-5] ^ 1]) + t.report[-4:]},
        "order": {"frames_out": t.frames_out[::-1]},
        "missing": {"frames_out": t.frames_out[:-1]},
    }
    records = [*RECORDS[:at], again(RECORDS[at], **changes[field])]
    result = replay(files_of(keep(tmp_path, records)))
    assert result.difference["tick"] == at


def test_changed_input_changes_the_output(tmp_path):
    stop = next(k for k in range(40, TICKS) if tick_record.decode(RECORDS[k]).datagrams)
    records = [*RECORDS[:stop], again(RECORDS[stop], datagrams=(b"x",)), *RECORDS[stop + 1 :]]
    assert replay(files_of(keep(tmp_path, records))).difference["tick"] >= stop


def test_a_recording_of_an_older_release_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tick_record, "VERSION", 1)
    bodies = [data[:4] + (1).to_bytes(2, "little") + data[6:-4] for data in RECORDS[:5]]
    old = keep(tmp_path, [again(body + zlib.crc32(body).to_bytes(4, "little")) for body in bodies])
    monkeypatch.undo()
    with pytest.raises(CommandFailed, check=coded("recording.other-version")):
        replay(files_of(old))


def test_a_replay_ends_at_a_gap_and_reports_it(tmp_path):
    code, text = run(keep(tmp_path, RECORDS[:70] + RECORDS[73:]), "--json")
    result = json.loads(text)
    assert code == ExitCode.FIGURE_MISSED and not result["agrees"] and result["ticks"] == 70
    assert {3, 69, 0.345} <= set(numbers_in(result["missing"]))


def test_ticks_that_the_controller_missed_are_no_gap(tmp_path):
    controller, inputs, records = Controller(SETTINGS), Inputs(), []
    for k in (*range(20), *range(22, 40)):
        now_ns = inputs_of(k, inputs)
        inputs.missed_ticks = 2 if k >= 22 else 0
        out = step(controller, inputs, now_ns)
        records.append(record(inputs, out, now_ns))
    assert replay(files_of(keep(tmp_path, records))).agrees


def test_a_short_first_step_is_no_gap_and_not_the_rate(tmp_path):
    """A run in lockstep may begin half a period before its first nominal tick."""
    first = again(RECORDS[0], now_ns=START_NS + T_NS // 2)
    result = replay(files_of(keep(tmp_path, [first, *RECORDS[1:3]])))
    assert not result.missing
    assert replay(files_of(keep(tmp_path / "all", [first, *RECORDS[1:]]))).rate_hz == SETTINGS.rate_hz


def test_a_missing_start_is_reported(tmp_path):
    reports = [k for k in range(1, 20) if tick_record.decode(RECORDS[k]).report]
    for k in (reports[0], reports[0] + 1):
        result = replay(files_of(keep(tmp_path / str(k), RECORDS[k:])))
        assert not result.agrees and result.missing and result.ticks == 0
    empty = replay(files_of(keep(tmp_path / "empty", [])))
    assert not empty.agrees and empty.missing and empty.total == 0


@pytest.mark.parametrize(
    ("manifest", "named"),
    [
        ({"profile_hash": "deadbeef"}, ("deadbeef", f"{SETTINGS.profile_hash:08x}")),
        ({"dbc_hash": {"crane": "0123456789abcdef"}}, ("0123456789ab", "crane.dbc")),
    ],
)
def test_another_profile_or_database_is_refused_with_both_hashes(tmp_path, manifest, named):
    code, text = run(keep(tmp_path, RECORDS, **manifest))
    assert code == ExitCode.CONFIGURATION and all(word in text for word in named)


def test_unknown_profile_name_asks_for_the_file(tmp_path):
    code, text = run(keep(tmp_path, RECORDS, profile="field_crane"))
    assert code == ExitCode.CONFIGURATION and "--profile" in text
    shipped = Path(recorder_module.__file__).parents[1] / "machine" / "palms_471.toml"
    assert run(tmp_path, "--profile", shipped)[0] == 0


def test_a_truncated_recording_is_recovered_and_agrees_up_to_its_end(tmp_path):
    path = keep(tmp_path, RECORDS) / "run.mcap"
    with path.open("rb") as file:
        last = make_reader(file).get_summary().chunk_indexes[-1]
    path.write_bytes(path.read_bytes()[: last.chunk_start_offset + last.chunk_length // 2])
    result = replay(files_of(tmp_path))
    assert result.agrees and 0 < result.ticks < TICKS


@pytest.mark.parametrize("make", [lambda d: d / "absent", lambda d: d, lambda d: d / "text.mcap"])
def test_a_file_that_is_no_recording_is_refused(tmp_path, make):
    (tmp_path / "text.mcap").write_text("hello, this is text")
    code, text = run(make(tmp_path))
    assert code == ExitCode.CONFIGURATION and str(tmp_path) in text


def test_contents_are_listed(tmp_path):
    files = files_of(keep(tmp_path, RECORDS))
    assert contents(files) == {"/controller/tick": TICKS, "/manifest": 1}
    assert manifest_of(files).seed == 1
    code, text = run(tmp_path, "--contents")
    assert code == 0 and "/controller/tick" in text and "palms_471" in text
    assert json.loads(run(tmp_path, "--contents", "--json")[1])["topics"]["/controller/tick"] == TICKS


@pytest.mark.parametrize("size", [0, 8, 40])
def test_a_recording_that_is_cut_before_its_manifest_is_named_so(tmp_path: Path, size: int) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes((b"\x89MCAP0\r\n" + bytes((1,)) + (1000).to_bytes(8, "little") + bytes(100))[:size])
    with pytest.raises(CommandFailed, check=coded("recording.cut-off")):
        manifest_of([path])


@pytest.mark.parametrize("damage", ["cut", "in a chunk"])
def test_a_recording_that_is_not_read_to_its_end_is_said_to_be_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    path = keep(tmp_path, RECORDS) / "run.mcap"
    content = path.read_bytes()
    list(messages([path], "/manifest"))
    assert capsys.readouterr().err == ""
    half = content.rindex(bytes((Opcode.DATA_END,)) + (4).to_bytes(8, "little")) // 2
    path.write_bytes(content[:half] if damage == "cut" else content[:half] + bytes(64) + content[half + 64 :])
    again = path.rename(path.with_name("run-0002.mcap"))
    list(messages([again], "/manifest"))
    contents([again])
    assert capsys.readouterr().err.count(str(again)) == 1
