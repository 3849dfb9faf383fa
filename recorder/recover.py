"""Repairs a recording whose writer was killed, so that every tool can read it.

Input is a run's directory.  Each MCAP file without a footer is read up to its last complete chunk and rewritten with an
index next to itself, flushed to the disk and put in place by an atomic rename: at any time the file is either the old
or the new one.  Then the candump files of its buses lose their unfinished last lines.  A complete recording, or one
that a running recorder still holds (``flock``), is not changed.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Callable, Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, Writer

from recorder import manifest
from runtime.errors import InputRefused

RUN_NAME = "run.mcap"


class Recovered(NamedTuple):
    """One repaired file and its number of messages."""

    path: Path
    messages: int


def run_files(directory: Path) -> list[Path]:
    """List the MCAP files of a run in the order of recording: ``run.mcap``, ``run-0002.mcap`` and so on."""
    first = directory / RUN_NAME
    return [first] * first.exists() + sorted(directory.glob("run-????.mcap"))


def recover(directory: Path) -> list[Recovered]:
    """Repair the unfinished files in a run's directory; returns the repaired ones.

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
    if recovered:
        for log in directory.glob("*.log"):
            if log.stem in _buses(directory):
                _trim_line(log)
    return recovered


def _buses(directory: Path) -> Collection[str]:
    """List the buses of a recording; none where its manifest cannot be read."""
    try:
        return manifest.read(directory).buses
    except (OSError, msgspec.MsgspecError):
        return ()


def _trim_line(path: Path) -> None:
    with path.open("rb+") as file:
        size = file.seek(0, 2)
        tail = min(size, 256)
        file.seek(-tail, 2)
        end = file.read().rfind(b"\n") + 1
        if end < tail and (end or tail == size):
            file.truncate(size - tail + end)


def rewrite(path: Path) -> Recovered:
    """Rewrite an unfinished MCAP file with an index, up to its last complete chunk; raises OSError."""
    new = path.with_suffix(".recovering")
    try:
        messages = _copy(path, new)
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)
    return Recovered(path, messages)


def _copy(path: Path, new: Path) -> int:
    """Write the valid part of an MCAP file into ``new``; returns its number of messages; raises OSError."""
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
    return messages


# -- Reads an MCAP file from front to back and stops, without an error, where its valid part ends.
#
# The index of an MCAP file is at its end, so it is missing if the writer was killed.  Every record has its length
# and every chunk its CRC, so that all but the unfinished chunk can be read in order (MCAP specification, "Record
# Content" and "Chunk").

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER_BYTES = _RECORD.size + 20
_MAX_CHUNK_BYTES = 256 << 20
"""A chunk that says it is longer is damaged; the recorder's have a few megabytes."""
_DAMAGED = (ValueError, struct.error, McapError, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)
"""What the libraries raise for damaged records and chunks."""


class Stored(NamedTuple):
    """A message as stored in the file: channel id, both times [ns] and the payload."""

    channel_id: int
    log_ns: int
    publish_ns: int
    data: bytes


def is_complete(path: Path) -> bool:
    """Tell whether the file ends with a footer and the closing magic, that is, whether its writer finished."""
    with path.open("rb") as file:
        file.seek(0, 2)
        if file.tell() < 2 * len(MCAP0_MAGIC) + _FOOTER_BYTES:
            return False
        file.seek(-len(MCAP0_MAGIC) - _FOOTER_BYTES, 2)
        return file.read(1)[0] == Opcode.FOOTER and file.read()[-len(MCAP0_MAGIC) :] == MCAP0_MAGIC


def scan(
    path: Path, topics: Collection[str] | None = None, ended: Callable[[int], None] = lambda at_byte: None
) -> Iterator[Schema | Channel | Stored]:
    """Yield every schema, channel and message (of ``topics``; None: all) up to the end of the valid part; ``ended`` is
    told the byte of that end if it is not that of the recording.

    Raises:
        InputRefused: The file does not start like an MCAP file.
    """
    with path.open("rb") as file:
        magic = file.read(len(MCAP0_MAGIC))
        if not MCAP0_MAGIC.startswith(magic):
            raise InputRefused("recording.not-mcap", f"{path} is not an MCAP file; give a run.mcap of the recorder")
        channel_ids: set[int] = set()
        while True:
            at_byte = file.tell()
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                return ended(at_byte)
            opcode, length = _RECORD.unpack(head)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if length > path.stat().st_size - file.tell():
                return ended(at_byte)
            body = file.read(length)
            try:
                records = _chunk(body) if opcode == Opcode.CHUNK else head + body
                parsed_records = list(_records(records, topics, channel_ids))
            except _DAMAGED:
                return ended(at_byte)
            yield from parsed_records


def _chunk(body: bytes) -> bytes:
    """Read the records in a chunk; raises one of `_DAMAGED`."""
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    if chunk.uncompressed_size > _MAX_CHUNK_BYTES:
        raise ValueError("the chunk is too long")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(size) if size else b""


def _records(data: bytes, topics: Collection[str] | None, wanted: set[int]) -> Iterator[Schema | Channel | Stored]:
    """Yield the records in ``data``; ``wanted`` collects the channels to yield messages of.  Raises a `_DAMAGED`."""
    at = 0
    while at < len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise ValueError("a message without its header")
            channel_id, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, at)
            if channel_id in wanted:
                yield Stored(channel_id, log_ns, publish_ns, data[at + _MESSAGE.size : at + length])
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(data[at : at + length])))
            if topics is None or channel.topic in topics:
                wanted.add(channel.id)
                yield channel
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(data[at : at + length])))
        at += length


__all__ = ["Channel", "Schema", "Stored", "is_complete", "scan"]
