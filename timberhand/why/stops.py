"""Finds stops: the files of the stop recorder, or the stops in a recording that has none.

A stop file, a directory of them, a run's directory, or one ``run.mcap``; without a place the newest stop on this
computer, of the runs below ``runs/`` and of the service.  Nothing is repaired or changed: a file that is still being
written, or whose writer was killed, is read up to its last complete chunk.
"""

from __future__ import annotations

import contextlib
import datetime
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from can_dbc.messages import tick_record
from can_dbc.messages.crane import StateReport
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import TickRecord
from hil.replay.recording import files_of, manifest_of, messages
from hil.replay.replay import recorded_ticks
from host.exit_codes import CommandFailed
from machine.status.explanation import StopDetector
from recorder.manifest import Manifest
from recorder.recorder import STOPS_NAME, TICK
from recorder.stop_recorder import AFTER_NS, BEFORE_NS, TOPIC, Stop, files_in, parts_in, report_of, stop_from
from runtime.errors import InputRefused
from timberhand.service_status import ending

SERVICE_RECORDINGS: Final = Path("/var/lib/timberhand")
SERVICE_STOPS: Final = SERVICE_RECORDINGS / STOPS_NAME


@dataclass(frozen=True, slots=True)
class FoundStop:
    """A stop with the ticks around it; ``source`` is the file or recording that has it."""

    stop: Stop
    manifest: Manifest
    ticks: tuple[TickRecord, ...]
    source: Path


def find_stops(run: Path | None, newest: bool = False) -> Iterator[FoundStop]:
    """Find the stops of ``run``, oldest first; with ``newest`` the last of them only.  None found: an empty iterator.

    Raises:
        CommandFailed: there is no recording, or it cannot be read.
    """
    paths = _newest_directory() if run is None else _stop_files(run)
    if paths:
        for path in paths[-1:] if newest else paths:
            yield from read_stop(path)
    elif run is not None:
        stops = stops_in_recording(_recording(run))
        yield from deque(stops, maxlen=1) if newest else stops


def read_stop(path: Path) -> Iterator[FoundStop]:
    """Read the stop in a stop recorder's file; none if its writer was killed before the first chunk was complete."""
    stop = next(messages([path], TOPIC), None)
    if stop is not None:
        ticks = tuple(recorded_ticks([path]))
        yield FoundStop(msgspec.json.decode(stop, type=Stop), manifest_of([path]), ticks, path)


def stops_in_recording(files: list[Path]) -> Iterator[FoundStop]:
    """Find the stops of a whole recording in the controller's reports."""
    manifest = manifest_of(files)
    offset_ns = manifest.utc_offset_ns if manifest.live else None
    detector, number = StopDetector(), 0
    recent: deque[tuple[int, bytes]] = deque()
    open_: list[tuple[Stop, list[bytes]]] = []

    def found(stop: Stop, records: list[bytes]) -> FoundStop:
        return FoundStop(stop, manifest, tuple(map(tick_record.decode, records)), files[0].parent)

    for data in messages(files, TICK):
        tick = _decoded(data, files[0])
        recent.append((tick.now_ns, data))
        for _, records in open_:
            records.append(data)
        while recent[0][0] < tick.now_ns - BEFORE_NS:
            recent.popleft()
        report = _report_of(tick)
        if report and (before := detector.step(report.mode, report.reason)):
            number += 1
            open_.append((stop_from(report, before, number, offset_ns), [record for _, record in recent]))
        while open_ and tick.now_ns >= open_[0][0].at_ns + AFTER_NS:
            yield found(*open_.pop(0))
    for stop, records in open_:
        yield found(stop, records)


def _decoded(data: bytes, file: Path) -> TickRecord:
    try:
        return tick_record.decode(data)
    except InputRefused as error:
        raise CommandFailed(
            "recording.other-version", f"{file.parent}: {error}; read it with the release that recorded it"
        ) from error


def _report_of(tick: TickRecord) -> StateReport | None:
    try:
        return report_of(tick)
    except DatagramRefused as error:
        raise CommandFailed(
            "recording.reports-unreadable",
            f"the recorded reports cannot be read ({error}); read it with the release that recorded it",
        ) from error


def _newest_directory() -> list[Path]:
    """Find the stop files of the directory, of all on this computer, that has the newest one."""
    directories = [*Path("runs").glob(f"*/{STOPS_NAME}"), SERVICE_STOPS]
    stop_files = [paths for directory in directories if (paths := _in_directory(directory))]
    return max(stop_files, key=lambda paths: paths[-1].stat().st_mtime_ns, default=[])


def _stop_files(run: Path) -> list[Path]:
    if run.is_dir():
        return _in_directory(run / STOPS_NAME) or _in_directory(run)
    if run.is_file() and next(messages([run], TOPIC), None) is not None:
        return [run]
    return []


def _in_directory(directory: Path) -> list[Path]:
    return sorted([*files_in(directory), *parts_in(directory)])


def _recording(run: Path) -> list[Path]:
    """Find the MCAP files of a run; raises CommandFailed with a sentence about what was looked for."""
    try:
        return files_of(run)
    except CommandFailed as error:
        raise CommandFailed(
            "why.no-record",
            f"{run} holds neither stops nor a recording; give a run's directory, a stop file, or nothing for the "
            "newest stop",
        ) from error


# -- Failures of the services: what systemd saw of their end, kept by deploy/system/service-ended.
#
# A controller or guard that dies reports no stop of its own; the valves are neutral, and this is what is left.

SERVICE_FAILURES: Final = Path("/var/lib/timberhand-failures/failures.jsonl")


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """One failure: ``result``, ``code`` and ``status`` are those of systemd.exec(5), ``utc_s`` the wall clock [s]."""

    unit: str
    result: str
    code: str
    status: str
    utc_s: int
    release: str

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        at = datetime.datetime.fromtimestamp(self.utc_s, datetime.UTC)
        how = ending(self.result, self.status)
        return f"{self.unit} failed at {at:%Y-%m-%d %H:%M:%S} UTC: {how} (release {self.release or 'unknown'})"


def failures(file: Path = SERVICE_FAILURES) -> Iterator[Failure]:
    """Read the failures in a file, oldest first; none without a file; a line that was cut off is left out."""
    try:
        lines = file.read_bytes().splitlines()
    except OSError:
        return
    for line in lines:
        with contextlib.suppress(msgspec.DecodeError):
            yield msgspec.json.decode(line, type=Failure)


def newest_failure(after_utc_ns: int | None, file: Path = SERVICE_FAILURES) -> tuple[Failure, int] | None:
    """Find the newest failure not older than a stop, and how often that service has failed since; None: none."""
    recent_failures = [
        failure for failure in failures(file) if after_utc_ns is None or failure.utc_s * 10**9 >= after_utc_ns - 10**9
    ]
    if not recent_failures:
        return None
    return recent_failures[-1], sum(failure.unit == recent_failures[-1].unit for failure in recent_failures)
