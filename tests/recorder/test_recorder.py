"""The recorder: its files are read back, by other tools too, and survive the death of their writer (fault 37)."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import queue
import random
import shutil
import struct
import threading

import can
import pytest
from mcap.reader import make_reader

from can_dbc.bus.factory import open_bus
from can_dbc.frame import Frame
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import signed, write_key
from can_dbc.messages.picture import JPEG_START, PictureFacts, encode_picture
from can_dbc.messages.record_ring import RingReader
from can_dbc.timing.page import TimingWriter
from recorder import manifest as manifests
from recorder import recorder as recorder_module
from recorder import segment
from recorder.__main__ import InputCollector, main, udp_socket, write_all
from recorder.recorder import CHUNK_NS, Recorder
from recorder.recover import Channel, Stored, is_complete, recover, run_files, scan
from runtime.errors import InputRefused
from tests.codes import coded, numbers_in
from tests.console.vehicle_reports import VEHICLE
from tests.recorder.recordings import CRANE, PROFILE, START_NS, T_NS, feed, frames, manifest, record, report, tick

TICKS = 400


@pytest.fixture
def recorder(tmp_path):
    return Recorder(tmp_path, PROFILE, manifest())


@pytest.fixture
def inputs(tmp_path):
    """A collector without a bus."""
    return InputCollector({}, RingReader(tmp_path / "controller.ticks"), udp_socket(0))


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


def test_every_state_of_the_timing_page_is_a_message(recorder, timing, tmp_path):
    for k in range(3):
        recorder.on_timing(timing(100 + k, written_ns=START_NS + k * 10**9))
    recorder.close()
    told = by_topic(tmp_path / "run.mcap")["/timing"]
    assert [publish_ns for _, publish_ns, _ in told] == [START_NS + k * 10**9 for k in range(3)]
    first = json.loads(told[0][2])
    assert first["ticks"] == 100 and first["buses"][0]["name"] == "crane0"
    assert first["durations"]["wake"]["count"] == 100 and first["durations"]["wake"]["max_us"] == 10.099
    assert first["inputs"]["Input6"]["longest_ns"] == 16_000_000


def test_the_sender_follows_the_raw_frame(recorder, tmp_path):
    recorder.on_frame("crane0", Frame(START_NS, 0x80, b"\x01"), "plant")
    recorder.close()
    assert by_topic(tmp_path / "run.mcap")["/crane0/raw"][0][2][16:] == b"plant"


def test_a_frame_of_wrong_length_is_recorded_raw(recorder, tmp_path):
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


def test_chunks_close_within_250_ms_of_recorded_time(recorder, tmp_path):
    feed(recorder, range(500))
    path = tmp_path / "run.mcap"
    stamps = [r.publish_ns for r in scan(path) if isinstance(r, Stored)]
    assert not is_complete(path)
    assert START_NS + 499 * T_NS - stamps[-1] < 250_000_000
    recorder.close()
    assert is_complete(path)


def test_chunks_stay_short_when_one_source_lags(recorder, tmp_path):
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


def test_damaged_datagrams_are_counted(recorder, tmp_path):
    recorder.on_tick(tick(0)[:-1])
    recorder.on_report(b"nonsense")
    recorder.on_report(report(0))
    recorder.on_report(encode(VEHICLE))  # this machine stands still
    recorder.close()
    assert recorder.refused == 3


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("stamp_ns", [2**64 - 1, 2**63, 2**32 * 10**9])
def test_a_time_that_no_recording_can_hold_is_counted_and_ends_nothing(stamp_ns, live, tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest(live=live))
    recorder.on_report(encode(dataclasses.replace(decode(report(0)), stamp_ns=stamp_ns)))
    recorder.on_picture(encode_picture(PictureFacts(1, "stick", stamp_ns, "", 2, 2), JPEG_START))
    recorder.on_report(report(0))
    recorder.close()
    assert recorder.refused == 2 and len(by_topic(tmp_path / "run.mcap")["/controller/report"]) == 1


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


def test_full_disk_at_start_is_refused_until_there_is_space(tmp_path, monkeypatch):
    (disk := FullDisk(monkeypatch)).full = True
    with pytest.raises(InputRefused, match=os.strerror(errno.ENOSPC), check=coded("recording.cannot-write")):
        Recorder(tmp_path, PROFILE, manifest())
    disk.full = False
    record(tmp_path, 10)
    assert ticks_of(tmp_path / "run.mcap") == [tick(k) for k in range(10)]


def test_a_candump_file_of_somebody_else_is_kept(tmp_path):
    (tmp_path / "crane0.log").write_text("mine")
    with pytest.raises(InputRefused, check=coded("recording.cannot-write")):
        Recorder(tmp_path, PROFILE, manifest())
    assert (tmp_path / "crane0.log").read_text() == "mine"


def test_full_disk_while_running_costs_counted_records_and_nothing_else(recorder, tmp_path, monkeypatch):
    disk = FullDisk(monkeypatch)
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


def test_a_file_that_a_full_disk_keeps_from_its_index_is_closed(recorder, monkeypatch):
    monkeypatch.setattr("recorder.recorder.SEGMENT_BYTES", 1)
    fd = recorder._segment._file.fileno()

    def full(self):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(segment.Segment, "finish", full)
    feed(recorder, range(10))
    recorder.flush(START_NS + 10 * T_NS)
    with pytest.raises(OSError, match=os.strerror(errno.EBADF)):
        os.fstat(fd)


def test_a_repair_that_fails_leaves_no_second_file_on_the_full_disk(run, tmp_path, monkeypatch):
    (tmp_path / "run.mcap").write_bytes(cut := (run / "run.mcap").read_bytes()[:-1])

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("recorder.recover.os.fsync", full)
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
        recover(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    assert (tmp_path / "run.mcap").read_bytes() == cut


def test_scan_returns_only_the_requested_topics(run):
    records = list(scan(run / "run.mcap", {"/controller/tick"}))
    assert {r.topic for r in records if isinstance(r, Channel)} == {"/controller/tick"}
    assert len([r for r in records if isinstance(r, Stored)]) == TICKS


# -- a writer that dies
def chunk_ends(path):
    """Where each chunk ends in the file; the first holds channels and manifest only."""
    with path.open("rb") as file:
        return [c.chunk_start_offset + c.chunk_length for c in make_reader(file).get_summary().chunk_indexes]


def ticks_of(path):
    """The tick records, read with the library's indexed reader."""
    with path.open("rb") as file:
        return [m.data for _, _, m in make_reader(file).iter_messages(topics=["/controller/tick"])]


@pytest.mark.long
def test_truncated_anywhere_is_readable_again_and_loses_one_chunk_at_most(run, tmp_path):
    data = (run / "run.mcap").read_bytes()
    size, dice = len(data), random.Random(1)
    ends = chunk_ends(run / "run.mcap")
    seen = []
    for n in sorted({*range(0, 60, 7), *(dice.randrange(size) for _ in range(60)), *range(size - 40, size, 5)}):
        path = tmp_path / "run.mcap"
        path.write_bytes(data[:n])
        (mended,) = recover(tmp_path)
        assert mended.path == path and is_complete(path)
        kept = ticks_of(path)
        assert kept == [tick(k) for k in range(len(kept))]
        whole_chunks = [end for end in ends if end <= n]
        assert len(kept) == min(TICKS, CHUNK_NS // T_NS * max(0, len(whole_chunks) - 1))
        seen.append(len(kept))
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == TICKS
    assert len(set(seen)) > 8


def test_a_flipped_byte_ends_the_valid_part(run, tmp_path):
    data = bytearray((run / "run.mcap").read_bytes())
    data[chunk_ends(run / "run.mcap")[3] - 20] ^= 0x55  # within a chunk: the index behind it has no checksum
    (tmp_path / "run.mcap").write_bytes(data)
    kept = [r.data for r in scan(tmp_path / "run.mcap", {"/controller/tick"}) if isinstance(r, Stored)]
    assert 0 < len(kept) < TICKS and kept == [tick(k) for k in range(len(kept))]


@pytest.mark.parametrize("damage", ["message without its header", "longer than its chunk", "unknown channel", "huge"])
def test_damaged_records_with_good_checksums_end_the_valid_part(tmp_path, damage):
    """A chunk may hold anything under a checksum that fits."""
    message = struct.pack("<HIQQ", 7, 0, 1, 1) + b"data"
    inner = {
        "message without its header": struct.pack("<BQ", 5, 3) + b"abc",
        "longer than its chunk": struct.pack("<BQ", 5, 1000) + message,
        "unknown channel": struct.pack("<BQ", 5, len(message)) + message,
        "huge": b"",
    }[damage]
    size = 1 << 50 if damage == "huge" else len(inner)
    chunk = struct.pack("<QQQII", 0, 0, size, 0, 0) + struct.pack("<Q", len(inner)) + inner
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk)
    assert list(scan(path)) == []
    assert [r.messages for r in recover(tmp_path)] == [0] and is_complete(path)


def test_a_complete_recording_is_not_changed(run, tmp_path):
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    (tmp_path / "crane0.log").write_bytes(b"a line\nwithout an end")
    before = {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in tmp_path.iterdir()}
    assert recover(tmp_path) == []
    assert {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in tmp_path.iterdir()} == before


def test_a_running_recorder_is_not_disturbed(recorder, tmp_path):
    feed(recorder, range(100))
    assert recover(tmp_path) == []
    recorder.close()
    assert ticks_of(tmp_path / "run.mcap") == [tick(k) for k in range(100)]


@pytest.mark.parametrize(
    ("name", "unfinished", "kept"), [("crane0", 15, 0), ("crane0", 300, 300), ("notes", 15, 15), ("crane0", 0, 0)]
)
def test_an_unfinished_line_of_the_candump_file_is_removed(run, tmp_path, name, unfinished, kept):
    (tmp_path / "manifest.json").write_bytes((run / "manifest.json").read_bytes())
    (tmp_path / "run.mcap").write_bytes((run / "run.mcap").read_bytes()[:-1])
    lines = b"".join((run / "crane0.log").read_bytes().splitlines(keepends=True)[:10])
    log = tmp_path / f"{name}.log"
    log.write_bytes(lines + unfinished * b"x")
    recover(tmp_path)
    assert log.read_bytes() == lines + kept * b"x"


def test_a_candump_file_that_holds_only_the_beginning_of_a_line_is_empty_again(run, tmp_path):
    (tmp_path / "manifest.json").write_bytes((run / "manifest.json").read_bytes())
    (tmp_path / "run.mcap").write_bytes((run / "run.mcap").read_bytes()[:-1])
    (tmp_path / "crane0.log").write_bytes(b"(7.000000) cra")
    recover(tmp_path)
    assert (tmp_path / "crane0.log").read_bytes() == b""


def test_a_file_of_another_kind_is_refused_with_its_name(tmp_path):
    (tmp_path / "run.mcap").write_text("this is no recording")
    with pytest.raises(InputRefused, check=coded("recording.not-mcap")):
        list(scan(tmp_path / "run.mcap"))


def test_a_manifest_is_written_without_a_second_file(tmp_path):
    manifests.write(tmp_path, manifest())
    assert manifests.read(tmp_path).complete is False
    assert [p.name for p in tmp_path.iterdir()] == ["manifest.json"]


def test_frames_that_the_kernel_dropped_are_reported_once(tmp_path, capfd):
    with open_bus("virtual:collector-loses") as bus:
        inputs = InputCollector({"crane0": bus}, RingReader(tmp_path / "controller.ticks"), udp_socket(0))
        receive = inputs._receivers[0]
        receive()
        assert not capfd.readouterr().err
        bus.stats.dropped += 7
        receive()
        receive()
        said = capfd.readouterr().err
        assert said.count("crane0") == 1 and 7 in numbers_in(said)
        inputs.items.put(None)
        write_all(Recorder(tmp_path, PROFILE, manifest()), inputs)
    assert manifests.read(tmp_path).dropped == 7, "a recording with gaps says so"


def test_the_collector_receives_each_state_of_the_timing_page_once(timing, tmp_path, monkeypatch):
    monkeypatch.setattr("recorder.__main__.TIMING_PERIOD_S", 0.0)
    page = tmp_path / "controller.timing"
    inputs = InputCollector({}, RingReader(tmp_path / "controller.ticks"), udp_socket(0), page)
    *_, receive = inputs._receivers
    receive()
    assert inputs.items.empty(), "no controller yet"
    writer = TimingWriter(page)
    for k in (1, 1, 2):
        written = timing(100, written_ns=k)
        writer.publish(written.facts, written.durations)
        receive()
    writer.close()
    receive()
    received = [inputs.items.get_nowait() for _ in range(inputs.items.qsize())]
    assert [(kind, told.facts.written_ns) for kind, _, told in received] == [("timing", 1), ("timing", 2)]


def test_records_that_do_not_fit_into_the_queue_are_counted(recorder, inputs, tmp_path, capfd):
    inputs.items = queue.Queue(2)
    for k in range(5):
        inputs._put(("tick", "", tick(k)), 1)
    writer = threading.Thread(target=write_all, args=(recorder, inputs))
    writer.start()
    inputs.items.put(None)
    writer.join(10)
    assert recorder.dropped == 3 and manifests.read(tmp_path).dropped == 3
    assert 3 in numbers_in(capfd.readouterr().err)


class Full:
    """A stream to a file on a full disk."""

    def write(self, text):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_report_that_cannot_be_written_costs_no_record(recorder, inputs, tmp_path, monkeypatch):
    inputs.dropped = 3
    for item in (("tick", "", tick(0)), None):
        inputs.items.put(item)
    monkeypatch.setattr("sys.stderr", Full())
    write_all(recorder, inputs)
    assert manifests.read(tmp_path).complete and ticks_of(tmp_path / "run.mcap") == [tick(0)]


def test_a_writer_that_fails_ends_the_inputs_although_the_queue_is_full(recorder, inputs, monkeypatch):
    inputs.items = queue.Queue(1)

    def fail(record):
        inputs._put(("tick", "", record), 1)
        raise RuntimeError

    monkeypatch.setattr(recorder, "on_tick", fail)
    inputs._put(("tick", "", tick(0)), 1)
    with pytest.raises(RuntimeError):
        write_all(recorder, inputs)
    receiver = threading.Thread(target=inputs.run, daemon=True)
    receiver.start()
    receiver.join(10)
    assert inputs.items.full() and not receiver.is_alive()


@pytest.mark.parametrize("failed", [False, True])
def test_the_exit_code_is_that_of_the_writer_and_not_of_a_full_disk(failed, tmp_path, monkeypatch):
    keys = []

    def write(recorder, inputs):
        keys.append(recorder._key)
        inputs.failed = failed
        inputs.end()

    key = write_key(tmp_path / "key")
    monkeypatch.setattr("can_dbc.messages.envelope.SERVICE_KEY", key)
    monkeypatch.setattr("recorder.__main__.write_all", write)
    monkeypatch.setattr("recorder.__main__.signal.signal", lambda *_: None)
    monkeypatch.setattr("sys.stdout", Full())
    ticks = str(tmp_path / "controller.ticks")
    assert main(["--out", str(tmp_path / "run"), "--report-port", "0", "--ticks", ticks, "--no-sync"]) == failed
    assert keys == [key.read_bytes()], "the key of the installed services"


@pytest.mark.parametrize(("key", "said"), [(None, 1), (16 * b"b", 1), (16 * b"a", 0)])
def test_reports_that_need_another_key_are_said_once(key, said, inputs, tmp_path, capfd):
    for datagram in (signed(report(0), 16 * b"a"), b"nonsense", signed(report(1), 16 * b"a")):
        inputs.items.put(("report", "", datagram))
    inputs.items.put(None)
    recorder = Recorder(tmp_path, PROFILE, manifest(), key)
    write_all(recorder, inputs)
    assert recorder.refused == 1 + 2 * said and capfd.readouterr().err.count("--key-file") == said
