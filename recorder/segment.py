"""One MCAP file that grows by commits: each one is a chunk with its CRC, complete on the disk or not there at all."""

from __future__ import annotations

import fcntl
import struct
import zlib
from pathlib import Path
from typing import Final, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from recorder.files import CommitFile

# -- Writes the same bytes as ``mcap.writer.Writer`` with chunks and every index, at a fraction of its cost per
# message.
#
# The library packs a message field by field, which took a fifth of a lockstep run.  Here a message is one
# ``struct``; records that come once per chunk or file are written by the library.


_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_BYTES: Final = 22  # of a message's record before its data
_INDEX: Final = struct.Struct("<BQHI")
_FOOTER: Final = struct.Struct("<BQQQ")
_COMPRESSOR: Final = zstandard.ZstdCompressor()


class Stream(Protocol):
    """The output of a file."""

    def write(self, data: bytes) -> int: ...
    def tell(self) -> int: ...


class McapFile:
    """One file; ``flush`` ends a chunk, ``finish`` the file.  Only the stream writes to the disk."""

    def __init__(self, stream: Stream, library: str) -> None:
        self._stream = stream
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}
        """By channel: log time and position of its messages in this chunk, alternating."""
        stream.write(MCAP0_MAGIC + _bytes(Header("", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Adds a schema; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._chunk += _bytes(schema)
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Adds a channel; returns its number."""
        channel = Channel(len(self._channels) + 1, topic, encoding, {}, schema_id)
        self._channels.append(channel)
        self._chunk += _bytes(channel)
        return channel.id

    def add_message(self, channel_id: int, log_ns: int, data: bytes, publish_ns: int) -> None:
        """Adds a message to the open chunk."""
        chunk = self._chunk
        try:
            index = self._index[channel_id]
        except KeyError:
            index = self._index[channel_id] = []
        index += (log_ns, len(chunk))
        chunk += _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_BYTES + len(data), channel_id, 0, log_ns, publish_ns)
        chunk += data

    def flush(self) -> None:
        """Writes the chunk and its indices, unless it has no message."""
        if not self._index:
            return
        stream, data = self._stream, bytes(self._chunk)
        packed = _COMPRESSOR.compress(data)
        start_ns = min(min(index[::2]) for index in self._index.values())
        end_ns = max(max(index[::2]) for index in self._index.values())
        chunk = Chunk("zstd", packed, end_ns, start_ns, zlib.crc32(data), len(data))
        at = stream.tell()
        stream.write(_bytes(chunk))
        indices_at, offsets = stream.tell(), {}
        for channel_id, index in self._index.items():
            offsets[channel_id] = stream.tell()
            size = 8 * len(index)
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel_id, size)
            stream.write(head + struct.pack(f"<{len(index)}Q", *index))
            self._counts[channel_id] = self._counts.get(channel_id, 0) + len(index) // 2
        self._chunks.append(
            ChunkIndex(
                chunk_length=indices_at - at,
                chunk_start_offset=at,
                compression=chunk.compression,
                compressed_size=len(packed),
                message_end_time=end_ns,
                message_index_length=stream.tell() - indices_at,
                message_index_offsets=offsets,
                message_start_time=start_ns,
                uncompressed_size=len(data),
            )
        )
        self._chunk, self._index = bytearray(), {}

    def finish(self) -> None:
        """Writes the open chunk, the summary and the footer."""
        self.flush()
        stream = self._stream
        stream.write(_bytes(DataEnd(0)))
        start = stream.tell()
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        groups: dict[Opcode, list[McapRecord]] = {
            Opcode.SCHEMA: [*self._schemas],
            Opcode.CHANNEL: [*self._channels],
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: [*self._chunks],
            Opcode.ATTACHMENT_INDEX: [],
            Opcode.METADATA_INDEX: [],
        }
        summary, offsets = bytearray(), []
        for opcode, records in groups.items():
            data = b"".join(map(_bytes, records))
            offsets.append(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        offsets_at = start + len(summary)
        summary += b"".join(map(_bytes, offsets))
        footer = _FOOTER.pack(Opcode.FOOTER, _FOOTER.size - 9 + 4, start, offsets_at)
        stream.write(bytes(summary))
        stream.write(_bytes(Footer(start, offsets_at, zlib.crc32(footer, zlib.crc32(summary)))) + MCAP0_MAGIC)


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


# -- One MCAP file that grows by commits


class Segment:
    """One MCAP file, locked (``flock``) while it is open; ``durable``: a commit survives a power cut."""

    def __init__(self, path: Path, durable: bool) -> None:
        """Creates the file; raises OSError, also if it exists already."""
        self.pending = 0
        """Counted messages since the last commit."""
        self._file = CommitFile(path, durable)
        fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._writer = McapFile(self._file, "timberhand")
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
        self._writer.flush()
        self._file.commit()
        self.pending = 0
        return self._file.tell()

    def finish(self) -> None:
        """Writes the index and closes the file; raises OSError."""
        self._writer.finish()
        self._file.commit()
        self._file.close()

    def close(self) -> None:
        """Closes the file as it is."""
        self._file.close()
