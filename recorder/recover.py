"""Makes a recording whose writer was killed readable again, for every tool.

Input is a run's directory.  Each MCAP file without a footer is read up to its last whole chunk and rewritten with an
index beside itself, flushed to the disk and put in place by one atomic rename: at any moment the file is the old one
or the new one.  A candump log loses its unfinished last line.  A recording that is in order, or that a living recorder
still holds (``flock``), is not touched.
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
    """One mended file and how many messages it holds."""

    path: Path
    messages: int


def run_files(directory: Path) -> list[Path]:
    """The MCAP files of a run in the order of recording: ``run.mcap``, ``run-0002.mcap`` and so on."""
    first = directory / RUN_NAME
    return [first] * first.exists() + sorted(directory.glob("run-????.mcap"))


def recover(directory: Path) -> list[Recovered]:
    """Mends what is unfinished in a run's directory; returns what was mended.

    Raises:
        OSError: when the directory cannot be written; nothing is lost then.
    """
    mended = []
    for path in run_files(directory):
        with path.open("rb") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return mended
            if not is_complete(path):
                mended.append(_rewrite(path))
    for log in directory.glob("*.log"):
        _trim_line(log)
    return mended


def _trim_line(path: Path) -> None:
    with path.open("rb+") as file:
        size = file.seek(0, 2)
        tail = min(size, 256)
        file.seek(-tail, 2)
        end = file.read().rfind(b"\n") + 1
        if end < tail:
            file.truncate(size - tail + end)


def _rewrite(path: Path) -> Recovered:
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
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
            else:
                writer.add_message(channels[record.channel_id], record.log_ns, record.data, record.publish_ns)
                messages += 1
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, path)
    return Recovered(path, messages)
