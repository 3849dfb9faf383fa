"""Every stop has a file of its own: 10 s before it and 5 s after it, whole whatever happens to the writer."""

from __future__ import annotations

import errno
import itertools
import os
import random
import time
from pathlib import Path

import msgspec
import pytest

from can_dbc.messages.crane import StateReport
from can_dbc.messages.tick_record import decode
from hil.replay.recording import manifest_of, messages
from machine.status.explanation import StopDetector
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from recorder import manifest as manifests
from recorder import stop_recorder
from recorder import stop_recorder as stop_recorder_module
from recorder.recorder import TICK
from recorder.recover import is_complete
from recorder.stop_recorder import TOPIC, Stop, StopFiles, files_in, parts_in, repair, stop_from
from tests.codes import numbers_in
from tests.recorder.stopped_run import RecordedBench, recorder_in, run_with_a_stop


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
    recorder = recorder_in(tmp_path)
    bench = RecordedBench([recorder])
    bench.active(ticks=2400)
    bench.lose("EncLift", 1200)
    recorder.close()
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
    recorder = recorder_in(tmp_path)
    RecordedBench([recorder]).active(ticks=100)
    recorder.close()
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


# ---- the ring of files --------------------------------------------------------------------------------------------


def many_stops(directory: Path, stops: int) -> None:
    """Short stops, each in a recording of its own with one common directory of stops."""
    for k in range(stops):
        run_with_a_stop(directory / f"run-{k}", after=20, stops=directory / "stops")


@pytest.mark.long
def test_the_oldest_files_make_room_and_the_numbers_tell_how_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stop_recorder, "MAX_FILES", 3)
    many_stops(tmp_path, 5)
    assert [stop_of(path).number for path in files_in(tmp_path / "stops")] == [3, 4, 5]
    assert StopFiles(tmp_path / "stops", False).next_number == 6


def test_the_bytes_of_all_files_are_bounded_and_the_newest_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many_stops(tmp_path, 2)
    size = max(path.stat().st_size for path in files_in(tmp_path / "stops"))
    monkeypatch.setattr(stop_recorder, "MAX_BYTES", int(2.5 * size))
    many_stops(tmp_path / "more", 0)
    run_with_a_stop(tmp_path / "third", after=20, stops=tmp_path / "stops")
    assert [stop_of(path).number for path in files_in(tmp_path / "stops")] == [2, 3]
    monkeypatch.setattr(stop_recorder, "MAX_BYTES", 1)
    run_with_a_stop(tmp_path / "fourth", after=20, stops=tmp_path / "stops")
    assert [stop_of(path).number for path in files_in(tmp_path / "stops")] == [4]


# ---- a writer that dies -------------------------------------------------------------------------------------------


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
    recorder = recorder_in(tmp_path)
    bench = RecordedBench([recorder])
    bench.active(ticks=200)
    bench.lose("EncLift", 100)
    (part,) = parts_in(tmp_path / "stops")
    assert repair(tmp_path / "stops") == [] and parts_in(tmp_path / "stops") == [part]
    assert stop_of(part).code == "ENCODER_LOST" and times_s(part)[-1] > 0.3
    recorder.close()
    assert not parts_in(tmp_path / "stops") and len(files_in(tmp_path / "stops")) == 1


def test_a_full_disk_costs_the_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = recorder_in(tmp_path)
    bench = RecordedBench([recorder])
    bench.active(ticks=200)

    def full(self: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(stop_recorder_module.StopFile, "commit", full)
        bench.lose("EncLift", 100)
    bench.arm_again()
    bench.lose("GuardStat", 100)
    recorder.close()
    assert [stop_of(path).code for path in files_in(tmp_path / "stops")] == ["GUARD_LOST"]
    assert recorder.lost == 1 and manifests.read(tmp_path).dropped == 1


def test_a_directory_that_cannot_be_made_costs_the_stops_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    recorder = recorder_in(tmp_path / "run", stops=tmp_path / "file" / "stops")
    bench = RecordedBench([recorder])
    bench.active(ticks=20)
    bench.lose("EncLift", 20)
    recorder.close()
    assert recorder.lost == 1 and is_complete(tmp_path / "run" / "run.mcap")


def test_live_a_stop_has_the_time_of_day_and_is_announced_at_once(tmp_path: Path) -> None:
    told: list[tuple[str, Path]] = []
    recorder = recorder_in(tmp_path, live=True, on_stop=lambda stop, path: told.append((stop.code, path)))
    bench = RecordedBench([recorder])
    bench.active(ticks=20)
    bench.lose("EncLift", 20)
    assert [code for code, _ in told] == ["ENCODER_LOST"] and not told[0][1].exists()
    recorder.close()
    (path,) = files_in(tmp_path / "stops")
    assert path == told[0][1] and stop_of(path).utc_ns is not None
    assert time.strftime("%Y", time.gmtime()) in path.name and path.name.endswith("Z-ENCODER_LOST.mcap")


def test_memory_is_bounded_in_a_flood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_recorder_module, "MAX_MEMORY_BYTES", 200_000)
    recorder = recorder_in(tmp_path)
    bench = RecordedBench([recorder])
    bench.active(ticks=800)
    remembered = sum(len(record) for _, record in recorder._stops._recent)
    assert 150_000 < remembered <= 200_000
    recorder.close()
