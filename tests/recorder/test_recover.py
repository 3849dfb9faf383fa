"""A recording survives the death of its writer at any byte (fault 37)."""

from __future__ import annotations

import queue
import random
import shutil
import struct
import threading

import pytest
from mcap.reader import make_reader

from can_dbc.bus.factory import open_bus
from can_dbc.messages.record_ring import RingReader
from can_dbc.timing.page import TimingWriter
from recorder import manifest as manifests
from recorder.__main__ import InputCollector, udp_socket, write_all
from recorder.recorder import CHUNK_NS, Recorder
from recorder.recover import Stored, is_complete, recover, scan
from runtime.errors import InputRefused
from tests.codes import coded, numbers_in
from tests.recorder.recordings import PROFILE, T_NS, feed, manifest, record, tick

TICKS = 400


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole")
    record(directory, TICKS)
    return directory


def chunk_ends(path):
    """Where each chunk ends in the file; the first holds channels and manifest only."""
    with path.open("rb") as file:
        return [c.chunk_start_offset + c.chunk_length for c in make_reader(file).get_summary().chunk_indexes]


def ticks_of(path):
    """The tick records, read with the library's indexed reader."""
    with path.open("rb") as file:
        return [m.data for _, _, m in make_reader(file).iter_messages(topics=["/controller/tick"])]


@pytest.mark.long
def test_truncated_anywhere_is_readable_again_and_loses_one_chunk_at_most(whole, tmp_path):
    data = (whole / "run.mcap").read_bytes()
    size, dice = len(data), random.Random(1)
    ends = chunk_ends(whole / "run.mcap")
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


def test_a_flipped_byte_ends_the_valid_part(whole, tmp_path):
    data = bytearray((whole / "run.mcap").read_bytes())
    data[chunk_ends(whole / "run.mcap")[3] - 20] ^= 0x55  # within a chunk: the index behind it has no checksum
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


def test_a_complete_recording_is_not_changed(whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    before = {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in tmp_path.iterdir()}
    assert recover(tmp_path) == []
    assert {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in tmp_path.iterdir()} == before


def test_a_running_recorder_is_not_disturbed(tmp_path):
    recorder = Recorder(tmp_path, PROFILE, manifest())
    feed(recorder, range(100))
    assert recover(tmp_path) == []
    recorder.close()
    assert ticks_of(tmp_path / "run.mcap") == [tick(k) for k in range(100)]


def test_an_unfinished_line_of_the_candump_file_is_removed(whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    log = tmp_path / "crane0.log"
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:10]) + lines[10][:15])
    recover(tmp_path)
    assert log.read_bytes() == b"".join(lines[:10])


def test_a_file_of_another_kind_is_refused_with_its_name(tmp_path):
    (tmp_path / "run.mcap").write_text("this is no recording")
    with pytest.raises(InputRefused, check=coded("recording.not-mcap")):
        list(scan(tmp_path / "run.mcap"))


def test_write_of_the_manifest_is_old_or_new(tmp_path):
    manifests.write(tmp_path, manifest())
    assert manifests.read(tmp_path).complete is False
    assert [p.name for p in tmp_path.iterdir()] == ["manifest.json"]


# ---- the process ------------------------------------------------------------------------------------------------


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


def test_records_that_do_not_fit_into_the_queue_are_counted(tmp_path, capfd):
    inputs = InputCollector({}, RingReader(tmp_path / "controller.ticks"), udp_socket(0))
    inputs.items = queue.Queue(2)
    for k in range(5):
        inputs._put(("tick", "", tick(k)), 1)
    recorder = Recorder(tmp_path, PROFILE, manifest())
    writer = threading.Thread(target=write_all, args=(recorder, inputs))
    writer.start()
    inputs.items.put(None)
    writer.join(10)
    assert recorder.dropped == 3 and manifests.read(tmp_path).dropped == 3
    assert 3 in numbers_in(capfd.readouterr().err)
