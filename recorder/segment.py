"""One MCAP file that grows by commits: each one is a chunk with its CRC, complete on the disk or not there at all."""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import Writer


class Segment:
    """One MCAP file, locked (``flock``) while it is open; ``durable``: a commit survives a power cut."""

    def __init__(self, path: Path, durable: bool) -> None:
        """Create the file; raises OSError, also if it exists already."""
        self.pending = 0
        """Counted messages since the last commit."""
        self._file = CommitFile(path, durable)
        fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Only a commit ends a chunk, so that the index of none is on the disk without it.
        self._writer = Writer(cast(IO[Any], self._file), chunk_size=sys.maxsize)
        self._writer.start(library="timberhand")
        self._channels: dict[str, int] = {}

    def channel(
        self, topic: str, encoding: str, schema: str = "", text: bytes = b"", schema_encoding: str = "jsonschema"
    ) -> None:
        """Add a topic; ``text`` is the schema of the name ``schema``, in its encoding."""
        schema_id = self._writer.register_schema(schema, schema_encoding, text) if schema else 0
        self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)

    def add(self, topic: str, log_ns: int, publish_ns: int, data: bytes, counted: bool = True) -> None:
        """Add a message to the open chunk; what is drawn from other records is not ``counted`` as one."""
        self._writer.add_message(self._channels[topic], log_ns, data, publish_ns)
        self.pending += counted

    def commit(self) -> int:
        """End the chunk and write it; returns the size of the file [bytes]; raises OSError."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.commit()
        self.pending = 0
        return self._file.tell()

    def finish(self) -> None:
        """Write the index and close the file; raises OSError."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.commit()
        self._file.close()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()


# -- Files that grow only by complete commits, so that a full disk costs records but never damages written data.
#
# A commit that fails part way is truncated again.  ``durable`` adds fsync: a power cut then loses nothing
# committed.


class CommitFile:
    """An append-only file with a buffer; ``write`` cannot fail, ``commit`` can (OSError) and is all or nothing.

    It has the three methods that ``mcap.writer.Writer`` needs of a stream: ``write``, ``tell`` and ``flush``.
    """

    def __init__(self, path: Path, durable: bool) -> None:
        """Create the file; raises OSError, also if it exists already."""
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._durable = durable
        self.buffer = bytearray()
        self._committed = 0

    def fileno(self) -> int:
        """Return the descriptor, for ``flock``."""
        return self._fd

    def write(self, data: bytes) -> int:
        """Append to the buffer."""
        self.buffer += data
        return len(data)

    def tell(self) -> int:
        """Return the position of the next byte."""
        return self._committed + len(self.buffer)

    def flush(self) -> None:
        """Do nothing: only ``commit`` writes to the disk."""

    def commit(self) -> None:
        """Write the buffer to the file; after an OSError the file is as before and the buffer is empty."""
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
        """Close without committing; again, do nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)
