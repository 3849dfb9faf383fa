"""One MCAP file that grows by commits: each one is a chunk with its CRC, complete on the disk or not there at all."""

from __future__ import annotations

import fcntl
import sys
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import Writer

from recorder.files import CommitFile


class Segment:
    """One MCAP file, locked (``flock``) while it is open; ``durable``: a commit survives a power cut."""

    def __init__(self, path: Path, durable: bool) -> None:
        """Creates the file; raises OSError, also if it exists already."""
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
        """Adds a topic; ``text`` is the schema of the name ``schema``, in its encoding."""
        schema_id = self._writer.register_schema(schema, schema_encoding, text) if schema else 0
        self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)

    def add(self, topic: str, log_ns: int, publish_ns: int, data: bytes, counted: bool = True) -> None:
        """Adds a message to the open chunk; what is drawn from other records is not ``counted`` as one."""
        self._writer.add_message(self._channels[topic], log_ns, data, publish_ns)
        self.pending += counted

    def commit(self) -> int:
        """Ends the chunk and writes it; returns the size of the file [bytes]; raises OSError."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.commit()
        self.pending = 0
        return self._file.tell()

    def finish(self) -> None:
        """Writes the index and closes the file; raises OSError."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.commit()
        self._file.close()

    def close(self) -> None:
        """Closes the file as it is."""
        self._file.close()
