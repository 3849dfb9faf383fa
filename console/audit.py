"""The audit log: who commanded what from which page, when, and what became of it.

One line of JSON for each request that changes something, and for each that is refused; the file is only ever appended
to.  A thread writes it, so that a slow disk delays no STOP.  At most `MAX_REFUSED` refusals a second are written: what
an attacker sends must not fill the disk.  A file that cannot be written is told on every page (``failed``).
"""

from __future__ import annotations

import json
import os
import queue
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

MAX_REFUSED: Final = 10
MAX_WAITING: Final = 1000
_SECOND_NS: Final = 1_000_000_000


class AuditLog:
    """``wall_clock`` is UTC, ``clock`` monotonic [ns].

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(
        self, path: Path, clock: Callable[[], int], wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        self.path = path
        self.failed = ""
        """Why the last lines could not be written."""
        self._clock, self._wall_clock = clock, wall_clock
        self._second, self._refused, self._left_out = 0, 0, 0
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._waiting: queue.Queue[bytes] = queue.Queue(MAX_WAITING)
        self._writer = threading.Thread(target=self._write, name="audit", daemon=True)
        self._writer.start()

    def record(self, *, refused: bool, **fields: Any) -> None:
        """Write a line; ``fields`` are who, what and result."""
        second = self._clock() // _SECOND_NS
        if second != self._second:
            self._second, self._refused = second, 0
        if refused:
            self._refused += 1
            if self._refused > MAX_REFUSED:
                self._left_out += 1
                return
        line = {"at": self._wall_clock().isoformat(timespec="milliseconds"), **fields}
        if self._left_out:
            line["refusals_left_out"], self._left_out = self._left_out, 0
        try:
            self._waiting.put_nowait(json.dumps(line, ensure_ascii=False).encode() + b"\n")
        except queue.Full:
            self.failed = f"The audit log {self.path} is not written: the disk is too slow."

    def close(self) -> None:
        """Write what waits, and close the file; once is enough."""
        if self._writer.is_alive():
            self._waiting.put(b"")
            self._writer.join()
            os.close(self._file)

    def _write(self) -> None:
        while line := self._waiting.get():
            try:
                os.write(self._file, line)
                self.failed = ""
            except OSError as error:
                self.failed = f"The audit log {self.path} cannot be written ({error.strerror})."
