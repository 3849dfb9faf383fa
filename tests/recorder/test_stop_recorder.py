"""Every stop has a file of its own, whole whatever happens to the writer, and an entry in systemd's journal."""

from __future__ import annotations

import errno
import itertools
import os
import random
import re
import shutil
import socket
import struct
import time
from pathlib import Path

import msgspec
import pytest

from can_dbc.messages.crane import StateReport
from can_dbc.messages.tick_record import decode
from hil.replay.recording import manifest_of, messages
from machine.status.explanation import StopDetector, message_id
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason, pack
from recorder import __main__, stop_recorder
from recorder import manifest as manifests
from recorder.__main__ import write_to_journal
from recorder.recorder import TICK
from recorder.recover import is_complete
from recorder.stop_recorder import TOPIC, Stop, StopFiles, files_in, parts_in, repair, stop_from
from tests.codes import numbers_in
from tests.recorder.stopped_run import RecordedBench, run_to_a_stop, run_with_a_stop


def stop_of(path: Path) -> Stop:
    (data,) = messages([path], TOPIC)
    return msgspec.json.decode(data, type=Stop)


def times_s(path: Path) -> list[float]:
    """Times of the ticks in a file, relative to its stop."""
    at_ns = stop_of(path).at_ns
    return [(decode(data).now_ns - at_ns) / 1e9 for data in messages([path], TICK)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("stopped")
    run_with_a_stop(directory)
    return directory


def test_a_stop_has_a_file_with_its_reason_and_numbers(whole: Path) -> None:
    (path,) = files_in(whole / "stops")
    stop = stop_of(path)
    assert path.name == f"000001-{stop.at_ns / 1e9:.3f}s-ENCODER_LOST.mcap" and is_complete(path)
    assert (stop.number, stop.mode_before, stop.mode, stop.utc_ns) == (1, "ACTIVE", "STOP", None)
    assert stop.reason == pack(Reason.ENCODER_LOST, 1)
    age_ms, limit_ms, refused = stop.numbers
    assert age_ms is not None and age_ms > 15.0 == limit_ms and refused == 0
    assert "lift" in stop.text and stop.text.endswith("[ENCODER_LOST]")
    assert manifest_of([path]).seed == 3


def test_the_file_has_ten_seconds_before_the_stop_and_five_after_it(tmp_path: Path) -> None:
    run_to_a_stop(tmp_path, before=2400).close()
    (path,) = files_in(tmp_path / "stops")
    times = times_s(path)
    assert times[0] == pytest.approx(-10.0, abs=0.03) and times[-1] == pytest.approx(5.0, abs=0.03)
    assert len(times) == pytest.approx(15.0 * 200, abs=8)
    assert all(0.004 < b - a < 0.006 for a, b in itertools.pairwise(times)), "no tick is missing"


def test_a_stop_and_the_fault_that_follows_its_ramp_are_one_and_a_new_reason_is_another(tmp_path: Path) -> None:
    def again(bench: RecordedBench) -> None:
        assert bench.mode is Mode.FAULT
        bench.arm_again()
        bench.lose("GuardStat", 100)

    run_with_a_stop(tmp_path, then=again)
    found = [stop_of(path) for path in files_in(tmp_path / "stops")]
    assert [(s.number, s.code, s.mode) for s in found] == [(1, "ENCODER_LOST", "STOP"), (2, "GUARD_LOST", "FAULT")]


def test_a_second_stop_within_five_seconds_has_a_file_of_its_own(tmp_path: Path) -> None:
    def again(bench: RecordedBench) -> None:
        bench.arm_again()
        bench.lose("GuardStat", 1200)

    run_with_a_stop(tmp_path, after=60, then=again)
    first, second = files_in(tmp_path / "stops")
    assert times_s(first)[-1] == pytest.approx(5.0, abs=0.03) and times_s(second)[-1] == pytest.approx(5.0, abs=0.03)
    assert times_s(second)[0] < -1.0, "the second one has the first in its past"


def test_the_end_of_the_run_completes_a_file_early(tmp_path: Path) -> None:
    run_with_a_stop(tmp_path, after=100)
    (path,) = files_in(tmp_path / "stops")
    assert is_complete(path) and times_s(path)[-1] == pytest.approx(0.5, abs=0.05)


def test_a_run_without_a_stop_has_no_directory(tmp_path: Path) -> None:
    run_to_a_stop(tmp_path, before=100, after=0).close()
    assert not (tmp_path / "stops").exists()


def test_in_lockstep_the_same_run_leaves_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    run_with_a_stop(tmp_path)
    (first,), (second,) = files_in(whole / "stops"), files_in(tmp_path / "stops")
    assert first.name == second.name and first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("modes", "stops"),
    [
        ([(Mode.ACTIVE, 0), (Mode.STOP, 25), (Mode.FAULT, 25)], ["ACTIVE"]),
        ([(Mode.ACTIVE, 0), (Mode.STOP, 10), (Mode.FAULT, 25)], ["ACTIVE", "ACTIVE"]),
        ([(Mode.FAULT, 25), (Mode.FAULT, 25)], []),
        ([(Mode.FAULT, 25), (Mode.BOOT, 0), (Mode.FAULT, 25)], ["BOOT"]),
        ([(Mode.ARMED, 60), (Mode.ARMED, 0), (Mode.ACTIVE, 0)], []),
        ([(Mode.ACTIVE, 0), (Mode.STOP, 10), (Mode.ARMED, 0), (Mode.STOP, 10)], ["ACTIVE", "ARMED"]),
    ],
)
def test_what_counts_as_a_stop(modes: list[tuple[Mode, int]], stops: list[str]) -> None:
    detector = StopDetector()
    found = [detector.step(mode, reason) for mode, reason in modes]
    assert [before for before in found if before is not None] == stops


def test_a_reason_of_another_release_keeps_its_number() -> None:
    nan5 = (float("nan"),) * 5
    report = StateReport(1, 2, 3, Mode.STOP, 0, 250, 0, 0, 0, 0, nan5, nan5, nan5, 0.0, 0.0, 0.0, 0, 0, 0, 0)
    stop = stop_from(report, "ACTIVE", 7, None)
    assert (stop.reason, stop.code, numbers_in(stop.text)) == (250, "REASON_250", [250])


# -- the ring of files
def many_stops(directory: Path, stops: int) -> None:
    """Short stops, each in a recording of its own with one common directory of stops."""
    for k in range(stops):
        run_with_a_stop(directory / f"run-{k}", after=20, stops=directory / "stops")


@pytest.mark.long
def test_the_oldest_files_make_room_and_the_numbers_tell_how_many(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(stop_recorder, "MAX_FILES", 3)
    many_stops(tmp_path, 5)
    assert [stop_of(path).number for path in files_in(tmp_path / "stops")] == [3, 4, 5]
    assert StopFiles(tmp_path / "stops", False).next_number == 6


def test_the_bytes_of_all_files_are_bounded_and_the_newest_stays(tmp_path, monkeypatch) -> None:
    many_stops(tmp_path, 2)
    size = max(path.stat().st_size for path in files_in(tmp_path / "stops"))
    monkeypatch.setattr(stop_recorder, "MAX_BYTES", int(2.5 * size))
    run_with_a_stop(tmp_path / "third", after=20, stops=tmp_path / "stops")
    assert [stop_of(path).number for path in files_in(tmp_path / "stops")] == [2, 3]
    monkeypatch.setattr(stop_recorder, "MAX_BYTES", 1)
    run_with_a_stop(tmp_path / "fourth", after=20, stops=tmp_path / "stops")
    assert [stop_of(path).number for path in files_in(tmp_path / "stops")] == [4]


# -- a writer that dies
@pytest.mark.long
def test_truncated_anywhere_it_is_readable_again_and_earlier_stops_are_not_touched(whole: Path, tmp_path: Path) -> None:
    (complete,) = files_in(whole / "stops")
    data, dice = complete.read_bytes(), random.Random(1)
    earlier = tmp_path / "000001-1.000s-GUARD_LOST.mcap"
    earlier.write_bytes(data)
    ticks = list(messages([complete], TICK))
    seen = []
    sizes = sorted({0, 1, 7, 8, 60, *(dice.randrange(len(data)) for _ in range(60)), *range(len(data) - 40, len(data))})
    for n in sizes:
        part = tmp_path / "000002-2.000s-ENCODER_LOST.mcap.part"
        part.write_bytes(data[:n])
        repaired = repair(tmp_path)
        assert not parts_in(tmp_path) and earlier.read_bytes() == data
        if repaired:
            (path,) = repaired
            kept = list(messages([path], TICK))
            assert is_complete(path) and kept == ticks[: len(kept)] and stop_of(path).code == "ENCODER_LOST"
            seen.append(len(kept))
            path.unlink()
        else:
            seen.append(0)
        assert [path.name for path in tmp_path.iterdir()] == [earlier.name], "nothing else is left behind"
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == len(ticks) and len(set(seen)) > 8


def test_a_flipped_byte_is_found_by_the_checksum(whole: Path, tmp_path: Path) -> None:
    (complete,) = files_in(whole / "stops")
    data = bytearray(complete.read_bytes())
    data[len(data) // 2] ^= 0x55
    path = tmp_path / complete.name
    path.write_bytes(data)
    kept, all_ticks = list(messages([path], TICK)), list(messages([complete], TICK))
    assert len(kept) < len(all_ticks) and kept == all_ticks[: len(kept)]


def test_a_file_that_is_still_written_is_left_alone_and_can_be_read(tmp_path: Path) -> None:
    bench = run_to_a_stop(tmp_path, before=200, after=100)
    (part,) = parts_in(tmp_path / "stops")
    assert repair(tmp_path / "stops") == [] and parts_in(tmp_path / "stops") == [part]
    assert stop_of(part).code == "ENCODER_LOST" and times_s(part)[-1] > 0.3
    bench.close()
    assert not parts_in(tmp_path / "stops") and len(files_in(tmp_path / "stops")) == 1


def test_a_full_disk_costs_the_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = run_to_a_stop(tmp_path, before=200, after=0)

    def full(self: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(stop_recorder.StopFile, "commit", full)
        bench.lose("EncLift", 100)
    bench.arm_again()
    bench.lose("GuardStat", 100)
    bench.close()
    assert [stop_of(path).code for path in files_in(tmp_path / "stops")] == ["GUARD_LOST"]
    assert bench.recorders[0].lost == 1 and manifests.read(tmp_path).dropped == 1


def test_a_directory_that_cannot_be_made_costs_the_stops_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    bench = run_to_a_stop(tmp_path / "run", before=20, after=20, stops=tmp_path / "file" / "stops")
    bench.close()
    assert bench.recorders[0].lost == 1 and is_complete(tmp_path / "run" / "run.mcap")


def test_a_stop_is_announced_although_its_file_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    told: list[str] = []
    where = {"stops": tmp_path / "file" / "stops", "on_stop": lambda stop, path: told.append(stop.code)}
    run_to_a_stop(tmp_path / "run", before=20, after=20, **where).close()
    assert told == ["ENCODER_LOST"]


def test_a_directory_that_is_removed_costs_the_stop_only(tmp_path: Path) -> None:
    bench = run_to_a_stop(tmp_path, before=20, after=20)
    shutil.rmtree(tmp_path / "stops")
    bench.close()
    assert bench.recorders[0].lost == 1 and manifests.read(tmp_path).complete


def test_live_a_stop_has_the_time_of_day_and_is_announced_at_once(tmp_path: Path) -> None:
    told: list[tuple[str, Path]] = []

    def tell(stop: Stop, path: Path) -> None:
        told.append((stop.code, path))

    bench = run_to_a_stop(tmp_path, before=20, after=20, live=True, on_stop=tell)
    assert [code for code, _ in told] == ["ENCODER_LOST"] and not told[0][1].exists()
    bench.close()
    (path,) = files_in(tmp_path / "stops")
    assert path == told[0][1] and stop_of(path).utc_ns is not None
    assert time.strftime("%Y", time.gmtime()) in path.name and path.name.endswith("Z-ENCODER_LOST.mcap")


def test_memory_is_bounded_in_a_flood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_recorder, "MAX_MEMORY_BYTES", 200_000)
    bench = run_to_a_stop(tmp_path, before=800, after=0)
    remembered = sum(len(record) for _, record in bench.recorders[0]._stops._recent)
    assert 150_000 < remembered <= 200_000
    bench.close()


# -- systemd's journal
CATALOG = (Path(__file__).parents[2] / "deploy/system/timberhand.catalog").read_text()
STOP = Stop(
    number=4,
    at_ns=5,
    utc_ns=6,
    mode_before="ACTIVE",
    mode="STOP",
    reason=pack(Reason.ENCODER_LOST, 1),
    code="ENCODER_LOST",
    numbers=(20.0, 15.0, 0.0),
    text="The encoder of joint lift ... [ENCODER_LOST]",
)


def test_the_catalog_explains_every_reason_that_stops_and_no_other() -> None:
    found = re.findall(r"^-- ([0-9a-f]{32})$", CATALOG, re.MULTILINE)
    assert found == [message_id(r) for r, fault in sorted(FAULTS.items()) if fault.reaction >= Reaction.HOLD]


def test_the_catalog_names_only_fields_that_an_entry_has() -> None:
    wanted = set(re.findall(r"@(\w+)@", CATALOG))
    bare = msgspec.structs.replace(STOP, numbers=(), text="")
    assert wanted and wanted <= set(__main__.stop_fields(bare, Path("file")))


def fields_in(data: bytes) -> dict[str, str]:
    """The fields of a datagram, read as systemd's journald reads them."""
    found, at = {}, 0
    while at < len(data):
        end = data.index(b"\n", at)
        name, equals, value = data[at:end].partition(b"=")
        at = end + 1
        if not equals:
            (length,) = struct.unpack_from("<Q", data, at)
            value = data[at + 8 : at + 8 + length]
            assert data[at + 8 + length : at + 9 + length] == b"\n"
            at += 9 + length
        found[name.decode()] = value.decode()
    return found


def test_a_value_with_a_line_feed_is_written_with_its_length() -> None:
    fields = {"MESSAGE": "two\nlines = 2", "PRIORITY": "3", "CODE": "a=b"}
    assert fields_in(__main__.encode(fields)) == fields


def test_a_stop_has_its_identity_its_numbers_and_its_file(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        receiver.settimeout(5)
        assert __main__.send(__main__.stop_fields(STOP, Path("/stops/4.mcap")), path)
        got = fields_in(receiver.recv(65536))
    assert got["MESSAGE_ID"] == message_id(Reason.ENCODER_LOST)
    assert got["MESSAGE"] == f"STOP: {STOP.text}" and got["PRIORITY"] == "3"
    assert got["TIMBERHAND_CODE"] == "ENCODER_LOST" and got["TIMBERHAND_PART"] == "joint lift"
    assert numbers_in(got["TIMBERHAND_MEASURED"])[:2] == [20.0, 15.0]
    assert (got["TIMBERHAND_MODE_BEFORE"], got["TIMBERHAND_FILE"]) == ("ACTIVE", "/stops/4.mcap")


def test_without_a_journal_the_text_goes_to_stderr(tmp_path: Path, monkeypatch, capfd) -> None:
    assert not __main__.send({"MESSAGE": "x"}, tmp_path / "none")
    monkeypatch.setattr(__main__.send, "__defaults__", (tmp_path / "none",))
    write_to_journal(STOP, Path("/stops/4.mcap"))
    assert capfd.readouterr().err == f"recorder: STOP: {STOP.text} /stops/4.mcap\n"


def test_a_reason_of_another_release_has_no_identity() -> None:
    unknown = msgspec.structs.replace(STOP, reason=250, code="REASON_250", text="Unknown reason 250.")
    fields = __main__.stop_fields(unknown, Path("x"))
    assert "MESSAGE_ID" not in fields and fields["PRIORITY"] == "3" and "250" in fields["MESSAGE"]
