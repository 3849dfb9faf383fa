"""Files that grow only by complete commits, so that a full disk costs records but never damages written data.

A commit that fails part way is truncated again.  ``durable`` adds fsync: a power cut then loses nothing committed.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class CommitFile:
    """An append-only file with a buffer; ``write`` cannot fail, ``commit`` can (OSError) and is all or nothing.

    It has the three methods that ``mcap.writer.Writer`` needs of a stream: ``write``, ``tell`` and ``flush``.
    """

    def __init__(self, path: Path, durable: bool) -> None:
        """Creates the file; raises OSError, also if it exists already."""
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._durable = durable
        self.buffer = bytearray()
        self._committed = 0

    def fileno(self) -> int:
        """The descriptor, for ``flock``."""
        return self._fd

    def write(self, data: bytes) -> int:
        """Appends to the buffer."""
        self.buffer += data
        return len(data)

    def tell(self) -> int:
        """Position of the next byte."""
        return self._committed + len(self.buffer)

    def flush(self) -> None:
        """Does nothing: only ``commit`` writes to the disk."""

    def commit(self) -> None:
        """Writes the buffer to the file; after an OSError the file is as before and the buffer is empty."""
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
        """Closes without committing."""
        os.close(self._fd)
