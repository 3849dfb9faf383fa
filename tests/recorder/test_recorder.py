"""The recorder: its files can be read back, by the trace reader and by other tools."""

from __future__ import annotations

import errno
import json
import os
import struct

import can
import pytest
from mcap.reader import make_reader

from can_dbc.frame import Frame
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import VehicleReport
from can_dbc.trace.candump import read_trace
from recorder import manifest as manifests
from recorder import recorder as recorder_module
from recorder import segment
from recorder.recorder import CHUNK_NS, Recorder
from recorder.recover import Channel, Stored, is_complete, run_files, scan
from runtime.errors import InputRefused
from tests.codes import coded
from tests.recorder.recordings import CRANE, PROFILE, START_NS, T_NS, feed, frames, manifest, record, report, tick

TICKS = 200


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    directory = tmp_path_factory.mktemp("run")
    record(directory, TICKS)
    return directory


def by_topic(path):
    """Topic -> list of (log time, publish time, payload), with the library's indexed reader."""
    found = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.log_time, message.publish_time, message.data))
    return found


def test_candump_file_is_read_back_by_python_can(run):
    messages = list(can.CanutilsLogReader(run / "crane0.log"))
    sent = [frame for k in range(TICKS) for frame in frames(k)]
    assert len(messages) == len(sent)
    for message, frame in zip(messages, sent, strict=True):
        assert message.channel == "crane0"
        assert message.timestamp == pytest.approx(frame.stamp_ns / 1e9, abs=2e-6)
        assert message.arbitration_id == frame.key & 0x1FFF_FFFF
        assert message.is_extended_id == bool(frame.key >> 31)
        assert message.is_remote_frame == bool(frame.key >> 30 & 1)
        assert bytes(message.data) == frame.data


def test_candump_file_is_read_back_by_the_trace_reader(run):
    got = list(read_trace(run / "crane0.log"))
    sent = [frame for k in range(TICKS) for frame in frames(k)]
    assert [(f.stamp_ns // 1000, f.key, f.data) for f in got] == [(f.stamp_ns // 1000, f.key, f.data) for f in sent]


def test_candump_line_is_that_of_candump(run):
    lines = (run / "crane0.log").read_text().splitlines()[:3]
    assert lines[0].startswith("(7.000000) crane0 182#E8030000")
    assert lines[1] == "(7.000001) crane0 18FF1234#0002"
    assert lines[2] == "(7.000002) crane0 123#R"


def test_mcap_has_raw_and_decoded_frames_ticks_and_reports(run):
    found = by_topic(run / "run.mcap")
    sent = [frame for k in range(TICKS) for frame in frames(k)]
    raw = [struct.unpack("<IB3x8s", data) for _, _, data in found["/crane0/raw"]]
    assert [(key, data[:n]) for key, n, data in raw] == [(f.key, f.data) for f in sent]
    encoder = [json.loads(data)["Position"] for _, _, data in found["/crane0/EncSlew"]]
    assert encoder == [1000 + k for k in range(TICKS)]
    assert [data for _, _, data in found["/controller/tick"]] == [tick(k) for k in range(TICKS)]
    first = json.loads(found["/controller/report"][0][2])
    assert first["mode"] == 3 and first["position"] == [None] * 5 and first["opening_pct"] == 50.0
    assert len(found["/controller/report"]) == TICKS / 4
    assert json.loads(found["/manifest"][0][2])["seed"] == 3


def test_channels_have_their_encoding(run):
    with (run / "run.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    channels = {c.topic: c for c in summary.channels.values()}
    assert channels["/crane0/raw"].message_encoding == "socketcan"
    decoded = channels["/crane0/EncSlew"]
    assert decoded.message_encoding == "json"
    schema = summary.schemas[decoded.schema_id]
    assert schema.encoding == "jsonschema"
    assert set(json.loads(schema.data)["properties"]) == set(CRANE.message("EncSlew").index)
    assert {f"/crane0/{name}" for name in CRANE.messages} <= set(channels)


def test_every_state_of_the_timing_page_is_a_message(timing, tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    for k in range(3):
        recorder.on_timing(timing(100 + k, written_ns=START_NS + k * 10**9))
    recorder.close()
    told = by_topic(tmp_path / "run.mcap")["/timing"]
    assert [publish_ns for _, publish_ns, _ in told] == [START_NS + k * 10**9 for k in range(3)]
    first = json.loads(told[0][2])
    assert first["ticks"] == 100 and first["buses"][0]["name"] == "crane0"
    assert first["durations"]["wake"]["count"] == 100 and first["durations"]["wake"]["max_us"] == 10.099
    assert first["inputs"]["Input6"]["longest_ns"] == 16_000_000


def test_the_sender_follows_the_raw_frame(tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    recorder.on_frame("crane0", Frame(START_NS, 0x80, b"\x01"), "plant")
    recorder.close()
    assert by_topic(tmp_path / "run.mcap")["/crane0/raw"][0][2][16:] == b"plant"


def test_a_frame_of_wrong_length_is_recorded_raw(tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    recorder.on_frame("crane0", Frame(START_NS, CRANE.message("EncSlew").key, b"\x01"))
    recorder.close()
    assert set(by_topic(tmp_path / "run.mcap")) == {"/manifest", "/crane0/raw"}


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in "ab":
        record(tmp_path / name, TICKS)
    for name in ("run.mcap", "crane0.log", "manifest.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_lockstep_manifest_has_no_clock(run):
    content = json.loads((run / "manifest.json").read_text())
    assert content["complete"] is True and content["seed"] == 3 and content["profile"] == "palms_471"
    assert not [name for name in content if name.startswith("start")]
    assert set(content["dbc_hash"]) == {"crane"}


def test_live_records_carry_utc_and_monotonic_time(tmp_path):
    live = manifest(live=True)
    recorder = Recorder(tmp_path, PROFILE, live)
    stamp_ns = live.start_monotonic_ns + 10**9
    recorder.on_frame("crane0", Frame(stamp_ns, 0x80, b"\x01"))
    recorder.close()
    (log_ns, publish_ns, _), *_ = by_topic(tmp_path / "run.mcap")["/crane0/raw"]
    assert publish_ns == stamp_ns and log_ns == live.start_utc_ns + 10**9
    utc_s = float((tmp_path / "crane0.log").read_text()[1:].split(")")[0])
    assert utc_s == pytest.approx(live.start_utc_ns / 1e9 + 1, abs=1e-5)
    assert manifests.read(tmp_path).start_utc.endswith("Z")


def test_chunks_close_within_250_ms_of_recorded_time(tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    feed(recorder, range(500))
    path = tmp_path / "run.mcap"
    stamps = [r.publish_ns for r in scan(path) if isinstance(r, Stored)]
    assert not is_complete(path)
    assert START_NS + 499 * T_NS - stamps[-1] < 250_000_000
    recorder.close()
    assert is_complete(path)


def test_chunks_stay_short_when_one_source_lags(tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    for k in range(0, 400, 38):
        for lagging in range(k, k + 38):
            recorder.on_tick(tick(lagging))
        for lagging in range(k, k + 38):
            for frame in frames(lagging):
                recorder.on_frame("crane0", frame)
    recorder.close()
    with (tmp_path / "run.mcap").open("rb") as file:
        spans = [c.message_end_time - c.message_start_time for c in make_reader(file).get_summary().chunk_indexes]
    assert max(spans) < CHUNK_NS


def test_damaged_datagrams_are_counted(tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    recorder.on_tick(tick(0)[:-1])
    recorder.on_report(b"nonsense")
    recorder.on_report(report(0))
    nan = float("nan")
    of_a_vehicle = VehicleReport(
        1, 2, 3, 4, 1, 0, 0, 0, nan, nan, nan, 0, 0, nan, 0, nan, nan, 0, nan, nan, nan, nan, (nan,) * 4, 0
    )
    recorder.on_report(encode(of_a_vehicle))  # this machine stands still
    recorder.close()
    assert recorder.refused == 3


def test_a_directory_with_a_recording_is_refused_and_unchanged(run):
    before = (run / "run.mcap").read_bytes()
    with pytest.raises(InputRefused, check=coded("recording.exists")):
        Recorder(run, PROFILE, manifest())
    assert (run / "run.mcap").read_bytes() == before


def test_directory_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputRefused, check=coded("recording.cannot-write")):
        Recorder(tmp_path / "file", PROFILE, manifest())


def test_a_large_recording_goes_into_several_files(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "SEGMENT_BYTES", 30_000)
    record(tmp_path, 300)
    paths = run_files(tmp_path)
    assert len(paths) > 1 and [p.name for p in paths[:2]] == ["run.mcap", "run-0002.mcap"]
    assert all(is_complete(path) for path in paths)
    ticks = [data for path in paths for _, _, data in by_topic(path).get("/controller/tick", [])]
    assert ticks == [tick(k) for k in range(300)]


class FullDisk:
    """Makes ``os.pwrite`` fail half-way while ``full``."""

    def __init__(self, monkeypatch):
        self.full = False
        real = os.pwrite

        def pwrite(fd, data, offset):
            if self.full:
                real(fd, data[: len(data) // 2], offset)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(fd, data, offset)

        monkeypatch.setattr(segment.os, "pwrite", pwrite)


def test_full_disk_at_start_is_refused(tmp_path, monkeypatch):
    FullDisk(monkeypatch).full = True
    with pytest.raises(InputRefused, match=os.strerror(errno.ENOSPC), check=coded("recording.cannot-write")):
        Recorder(tmp_path, PROFILE, manifest())


def test_full_disk_while_running_costs_counted_records_and_nothing_else(tmp_path, monkeypatch):
    disk = FullDisk(monkeypatch)
    recorder = Recorder(tmp_path, PROFILE, manifest())
    feed(recorder, range(100))
    recorder.flush(START_NS + 100 * T_NS)
    disk.full = True
    feed(recorder, range(100, 200))
    recorder.flush(START_NS + 200 * T_NS)
    disk.full = False
    recorder.flush(START_NS + 200 * T_NS)
    dropped = recorder.dropped
    feed(recorder, range(200, 300))
    recorder.close()
    # Of 100 ticks: 4 lines of text, 4 raw and 2 decoded frames and the tick; and every fourth a report.
    assert recorder.dropped == dropped == 100 * (4 + 4 + 2 + 1) + 25
    assert manifests.read(tmp_path).dropped == dropped
    first, second = run_files(tmp_path)
    kept = [r.data for path in (first, second) for r in scan(path, {"/controller/tick"}) if isinstance(r, Stored)]
    assert kept == [tick(k) for k in (*range(100), *range(200, 300))]
    assert is_complete(second)
    assert len(list(can.CanutilsLogReader(tmp_path / "crane0.log"))) == 4 * 200


def test_scan_returns_only_the_requested_topics(run):
    records = list(scan(run / "run.mcap", {"/controller/tick"}))
    assert {r.topic for r in records if isinstance(r, Channel)} == {"/controller/tick"}
    assert len([r for r in records if isinstance(r, Stored)]) == TICKS
