"""The stop recorder: the controller's ticks of the last 10 s in memory, and a file for every stop.

A file has the 10 s before the stop, which are written at once, and the 5 s after it.  A tick record holds all inputs
and outputs of its tick, so these files show why the machine stopped without the rest of the recording: `timberhand why`
reads them.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from can_dbc.messages import datagrams
from can_dbc.messages.crane import StateReport
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import TickRecord
from machine.status.explanation import Explanation, StopDetector, explain
from machine.status.modes import Mode
from machine.status.reasons import known
from recorder.manifest import Manifest
from recorder.recover import Stored, is_complete, rewrite, scan
from recorder.segment import Segment
from runtime.errors import InputRefused

BEFORE_NS: Final = 10_000_000_000
AFTER_NS: Final = 5_000_000_000
MAX_MEMORY_BYTES: Final = 64 * 2**20
"""Of the ticks in memory; a flood of frames shortens the time before a stop instead of filling the memory."""
MAX_OPEN: Final = 4
"""Files at a time; a machine that is armed and stops again sooner ends the oldest one early."""


class StopRecorder:
    """Call ``on_tick`` for every tick, ``commit`` now and then, ``close`` at the end; none of them raises OSError."""

    def __init__(
        self,
        files: StopFiles,
        manifest: Manifest,
        on_stop: Callable[[Stop, Path], None] | None = None,
    ) -> None:
        """``on_stop`` is called at once with every stop and the path that its file will have."""
        self.files = files
        self.dropped = 0
        """Stops whose file could not be written to its end."""
        self._manifest, self._on_stop = manifest, on_stop
        self._offset_ns = manifest.utc_offset_ns if manifest.live else None
        self._detector = StopDetector()
        self._recent: deque[tuple[int, bytes]] = deque()
        self._recent_bytes = 0
        self._open: list[tuple[StopFile, int]] = []
        """Files and when they end [ns]."""

    def on_tick(self, tick: TickRecord, record: bytes) -> None:
        """Take a tick and its record."""
        now_ns = tick.now_ns
        self._remember(now_ns, record)
        for file, _ in self._open:
            file.add_tick(now_ns, record)
        with contextlib.suppress(DatagramRefused):
            if (report := report_of(tick)) and (before := self._detector.step(report.mode, report.reason)):
                self._begin(stop_from(report, before, self.files.next_number, self._offset_ns), now_ns)
        while self._open and now_ns >= self._open[0][1]:
            self._finish_oldest()

    def commit(self, now_ns: int) -> None:
        """Write what the open files have, and complete those whose time is over although no tick comes."""
        while self._open and now_ns >= self._open[0][1]:
            self._finish_oldest()
        for entry in [entry for entry in self._open if entry[0].pending]:
            try:
                entry[0].commit()
            except OSError:
                self._give_up(entry)

    def close(self) -> None:
        """Complete the open files, with the time after the stop as far as it is there."""
        while self._open:
            self._finish_oldest()

    def _begin(self, stop: Stop, now_ns: int) -> None:
        if self._on_stop is not None:
            self._on_stop(stop, self.files.directory / _name(stop))
        try:
            file = self.files.begin(stop, self._manifest)
        except OSError:
            self.dropped += 1
            return
        entry = (file, now_ns + AFTER_NS)
        self._open.append(entry)
        for at_ns, record in self._recent:
            file.add_tick(at_ns, record)
        try:
            file.commit()
        except OSError:
            self._give_up(entry)
        while len(self._open) > MAX_OPEN:
            self._finish_oldest()

    def _finish_oldest(self) -> None:
        entry = self._open[0]
        try:
            entry[0].finish()
            self._open.remove(entry)
            self.files.remove_oldest()
        except OSError:
            self._give_up(entry)

    def _give_up(self, entry: tuple[StopFile, int]) -> None:
        self.dropped += 1
        if entry in self._open:
            self._open.remove(entry)
            entry[0].abandon()

    def _remember(self, now_ns: int, record: bytes) -> None:
        recent = self._recent
        if recent and now_ns < recent[-1][0]:  # another controller, with another clock
            recent.clear()
            self._recent_bytes = 0
        recent.append((now_ns, record))
        self._recent_bytes += len(record)
        while recent[0][0] < now_ns - BEFORE_NS or self._recent_bytes > MAX_MEMORY_BYTES:
            self._recent_bytes -= len(recent.popleft()[1])


# -- The record of a stop; when one begins says `machine.status.explanation.StopDetector`.

TOPIC: Final = "/stop"


class Stop(msgspec.Struct, frozen=True, kw_only=True):
    """One stop, as the topic ``/stop`` stores it.

    ``reason`` has the detail in bits 8 to 15; ``numbers`` are those of ``StateReport``, None where there is none.
    """

    number: int
    """Counts the stops of a directory; the numbers below the oldest file's are those of removed files."""
    at_ns: int
    """Monotonic time at which the reason began."""
    utc_ns: int | None
    """The same as UTC; None in lockstep."""
    mode_before: str
    mode: str
    reason: int
    code: str
    numbers: tuple[float | None, ...]
    text: str
    """The whole explanation, for readers without this program."""

    @property
    def explanation(self) -> Explanation:
        """The reason in today's words; raises ValueError for a reason that this release does not know."""
        return explain(self.reason, self.numbers)


def stop_from(report: StateReport, mode_before: str, number: int, utc_offset_ns: int | None) -> Stop:
    """Make the record of a stop that begins with a report; ``utc_offset_ns`` is None in lockstep.

    A reason of another release keeps its number; its words say so.
    """
    at_ns = report.since_ns or report.stamp_ns
    explanation = None if known(report.reason) is None else explain(report.reason, report.numbers)
    return Stop(
        number=number,
        at_ns=at_ns,
        utc_ns=None if utc_offset_ns is None else at_ns + utc_offset_ns,
        mode_before=mode_before,
        mode=Mode(report.mode).name,
        reason=report.reason,
        code=explanation.code if explanation else f"REASON_{report.reason & 0xFF}",
        numbers=tuple(None if value != value else value for value in report.numbers),
        text=explanation.text if explanation else f"Unknown reason {report.reason & 0xFF}.",
    )


def report_of(tick: TickRecord) -> StateReport | None:
    """Decode the state report of a tick; None where it sent none.

    Raises:
        DatagramRefused: it is one of another release.
    """
    report = datagrams.decode(tick.report) if tick.report else None
    return report if isinstance(report, StateReport) else None


# -- The files of stops in one directory: a bounded ring, of which every file is whole or repaired.
#
# ``NUMBER-TIME-CODE.mcap``, in the order of their numbers whatever the clock says; the newest `MAX_FILES` that
# together have at most `MAX_BYTES` stay.  A file grows as ``.mcap.part`` by commits of whole chunks, each with its
# CRC, and gets its name, flushed to the disk, when it is complete.  A writer that was killed leaves a part, which
# the next one repairs up to its last chunk (`recorder.recover`).

TICK: Final = "/controller/tick"
MAX_FILES: Final = 50
MAX_BYTES: Final = 256 * 2**20
_PART: Final = ".part"
_JSON: Final = msgspec.json.Encoder()
_OBJECT: Final = b'{"type":"object"}'


def files_in(directory: Path) -> list[Path]:
    """List the complete files of a directory, oldest first."""
    return sorted(directory.glob("*-*.mcap"))


def parts_in(directory: Path) -> list[Path]:
    """List the files that are being written, or that a killed writer left, oldest first."""
    return sorted(directory.glob(f"*-*.mcap{_PART}"))


class StopFile:
    """The file of one stop while it is written; its methods raise OSError."""

    def __init__(self, directory: Path, stop: Stop, manifest: Manifest, durable: bool) -> None:
        self.path = directory / _name(stop)
        self._part = self.path.with_name(self.path.name + _PART)
        self._durable = durable
        self._offset_ns = manifest.utc_offset_ns
        self._segment = Segment(self._part, durable)
        self._segment.channel("/manifest", "json", "Manifest", _OBJECT)
        self._segment.channel(TOPIC, "json", "Stop", _OBJECT)
        self._segment.channel(TICK, "timberhand.tick")
        self._add("/manifest", stop.at_ns, _JSON.encode(manifest))
        self._add(TOPIC, stop.at_ns, _JSON.encode(stop))

    @property
    def pending(self) -> int:
        """Messages since the last commit."""
        return self._segment.pending

    def add_tick(self, now_ns: int, record: bytes) -> None:
        """Add the controller's record of a tick."""
        self._add(TICK, now_ns, record)

    def commit(self) -> None:
        """Write what was added."""
        self._segment.commit()

    def finish(self) -> None:
        """Complete the file and give it its name."""
        self._segment.finish()
        _put_in_place(self._part, self.path, self._durable)

    def abandon(self) -> None:
        """Close a file that cannot be written; what was committed stays as a part."""
        self._segment.close()

    def _add(self, topic: str, at_ns: int, data: bytes) -> None:
        self._segment.add(topic, at_ns + self._offset_ns, at_ns, data)


class StopFiles:
    """The ring; it makes its directory with the first stop."""

    def __init__(self, directory: Path, durable: bool) -> None:
        self.directory, self._durable = directory, durable
        with contextlib.suppress(OSError):  # a directory that cannot be written shows at the next stop
            repair(directory)
        self.next_number = 1 + max(map(_number, [*files_in(directory), *parts_in(directory)]), default=0)

    def begin(self, stop: Stop, manifest: Manifest) -> StopFile:
        """Open a file for a new stop; raises OSError."""
        self.directory.mkdir(parents=True, exist_ok=True)
        self.next_number = max(self.next_number, stop.number + 1)
        return StopFile(self.directory, stop, manifest, self._durable)

    def remove_oldest(self) -> None:
        """Remove the oldest files until the bounds hold; raises OSError."""
        files = files_in(self.directory)
        sizes = [path.stat().st_size for path in files]
        while len(files) > 1 and (len(files) > MAX_FILES or sum(sizes) > MAX_BYTES):
            files.pop(0).unlink()
            sizes.pop(0)


def repair(directory: Path) -> list[Path]:
    """Complete the parts that a killed writer left; one without a stop is removed.  Returns the repaired files.

    A part that another process still writes (``flock``) is not touched.

    Raises:
        OSError: the directory cannot be written; nothing is lost.
    """
    repaired: list[Path] = []
    for part in parts_in(directory):
        with part.open("rb") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if not is_complete(part):
                if not _has_stop(part):
                    part.unlink()
                    continue
                rewrite(part)
            final = part.with_name(part.name.removesuffix(_PART))
            _put_in_place(part, final, True)
            repaired.append(final)
    return repaired


def _has_stop(part: Path) -> bool:
    try:
        return any(isinstance(record, Stored) for record in scan(part, {TOPIC}))
    except InputRefused:
        return False


def _put_in_place(part: Path, final: Path, durable: bool) -> None:
    os.replace(part, final)
    if durable:
        folder = os.open(final.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _name(stop: Stop) -> str:
    if stop.utc_ns is None:
        when = f"{stop.at_ns / 1e9:.3f}s"
    else:
        when = f"{datetime.datetime.fromtimestamp(stop.utc_ns // 10**9, datetime.UTC):%Y%m%dT%H%M%SZ}"
    return f"{stop.number:06d}-{when}-{stop.code}.mcap"


def _number(path: Path) -> int:
    first = path.name.partition("-")[0]
    return int(first) if first.isdigit() else 0
