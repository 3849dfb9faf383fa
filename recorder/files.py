"""Files that only ever grow by whole commits, so that a full disk costs records but never breaks what is written.

A commit that fails part way is cut off again.  ``durable`` adds fsync: a power cut then loses nothing committed.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class CommitFile:
    """An append-only file with a buffer; ``write`` cannot fail, ``commit`` can (OSError) and is all or nothing.

    It has the three methods that ``mcap.writer.Writer`` asks of a stream: ``write``, ``tell`` and ``flush``.
    """

    def __init__(self, path: Path, durable: bool) -> None:
        """Create the file; raises OSError, also when it exists already."""
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._durable = durable
        self.buffer = bytearray()
        self._committed = 0

    def fileno(self) -> int:
        """The descriptor, for ``flock``."""
        return self._fd

    def write(self, data: bytes) -> int:
        """Add to the buffer."""
        self.buffer += data
        return len(data)

    def tell(self) -> int:
        """Where the next byte will stand."""
        return self._committed + len(self.buffer)

    def flush(self) -> None:
        """Nothing: only ``commit`` touches the disk."""

    def commit(self) -> None:
        """Bring the buffer to the file; on OSError the file is as before and the buffer is gone."""
        data, self.buffer = memoryview(bytes(self.buffer)), bytearray()
        if not data:
            return
        at = 0
        try:
            while at < len(data):
                at += os.pwrite(self._fd, data[at:], self._committed + at)
            if self._durable:
                os.fdatasync(self._fd)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._committed)
            raise
        self._committed += at

    def close(self) -> None:
        """Close without committing."""
        os.close(self._fd)
