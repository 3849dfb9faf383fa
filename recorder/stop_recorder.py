"""The stop recorder: the controller's ticks of the last 10 s in memory, and a file for every stop.

A file has the 10 s before the stop, which are written at once, and the 5 s after it (`recorder.stop_files`).  A tick
record holds all inputs and outputs of its tick, so these files show why the machine stopped without the rest of the
recording: `timberhand why` reads them.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import TickRecord
from machine.status.explanation import StopDetector
from recorder.manifest import Manifest
from recorder.stop import Stop, report_of, stop_from
from recorder.stop_files import StopFile, StopFiles

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
        """Takes a tick and its record."""
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
        """Writes what the open files have, and completes those whose time is over although no tick comes."""
        while self._open and now_ns >= self._open[0][1]:
            self._finish_oldest()
        for entry in [entry for entry in self._open if entry[0].pending]:
            try:
                entry[0].commit()
            except OSError:
                self._give_up(entry)

    def close(self) -> None:
        """Completes the open files, with the time after the stop as far as it is there."""
        while self._open:
            self._finish_oldest()

    def _begin(self, stop: Stop, now_ns: int) -> None:
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
        if self._on_stop is not None:
            self._on_stop(stop, file.path)
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
