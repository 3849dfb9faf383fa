"""Repairs a recording whose writer was killed, so that every tool can read it.

Input is a run's directory.  Each MCAP file without a footer is read up to its last complete chunk and rewritten with an
index next to itself, flushed to the disk and put in place by an atomic rename: at any time the file is either the old
or the new one.  A candump file loses its unfinished last line.  A complete recording, or one that a running recorder
still holds (``flock``), is not changed.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import NamedTuple

from mcap.writer import Writer

from recorder.mcap_scan import Channel, Schema, is_complete, scan

RUN_NAME = "run.mcap"


class Recovered(NamedTuple):
    """One repaired file and its number of messages."""

    path: Path
    messages: int


def run_files(directory: Path) -> list[Path]:
    """The MCAP files of a run in the order of recording: ``run.mcap``, ``run-0002.mcap`` and so on."""
    first = directory / RUN_NAME
    return [first] * first.exists() + sorted(directory.glob("run-????.mcap"))


def recover(directory: Path) -> list[Recovered]:
    """Repairs the unfinished files in a run's directory; returns the repaired ones.

    Raises:
        OSError: The directory cannot be written; nothing is lost.
    """
    recovered: list[Recovered] = []
    for path in run_files(directory):
        with path.open("rb") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return recovered
            if not is_complete(path):
                recovered.append(rewrite(path))
    for log in directory.glob("*.log"):
        _trim_line(log)
    return recovered


def _trim_line(path: Path) -> None:
    with path.open("rb+") as file:
        size = file.seek(0, 2)
        tail = min(size, 256)
        file.seek(-tail, 2)
        end = file.read().rfind(b"\n") + 1
        if end < tail:
            file.truncate(size - tail + end)


def rewrite(path: Path) -> Recovered:
    """Rewrites an unfinished MCAP file with an index, up to its last complete chunk; raises OSError."""
    new = path.with_suffix(".recovering")
    messages = 0
    with new.open("wb") as file:
        writer = Writer(file)
        writer.start(library="timberhand")
        schemas = {0: 0}
        channels: dict[int, int] = {}
        for record in scan(path):
            if isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas.get(record.schema_id, 0), record.metadata
                )
            else:
                writer.add_message(channels[record.channel_id], record.log_ns, record.data, record.publish_ns)
                messages += 1
        writer.finish()  # type: ignore[no-untyped-call]
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, path)
    return Recovered(path, messages)
