"""A recording that can be read from any time on, by the index of its MCAP files: for the page that replays it.

Reports and frames come from the topics of a run; a stop file has tick records only, and these have both.  A chunk has
200 ms of the run, so a look at any time reads a handful of chunks.  The index is read by the mcap library; from a chunk
only the messages that are wanted are taken out, by the chunk's own index.
"""

from __future__ import annotations

import dataclasses
import math
import struct
import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Chunk, ChunkIndex, MessageIndex
from mcap.stream_reader import get_chunk_data_stream

from can_dbc.frame import Frame
from can_dbc.messages import datagrams, tick_record
from can_dbc.messages.crane import StateReport
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.vehicle import VehicleReport
from hil.replay.recording import manifest_of
from host.exit_codes import CommandFailed, ExitCode
from recorder.recorder import REPORT, TICK, TIMING, VEHICLE
from recorder.recover import is_complete

CACHED_CHUNKS: Final = 160
"""About half a minute of a run, some tens of megabytes."""
_RECORD_HEAD: Final = 9
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_CAN_FRAME: Final = struct.Struct("<IB3x8s")
_STATE_FIELDS: Final = tuple(field.name for field in dataclasses.fields(StateReport))
_VEHICLE_FIELDS: Final = tuple(field.name for field in dataclasses.fields(VehicleReport))


class Message(NamedTuple):
    """One message of a recording; the time is monotonic."""

    topic: str
    stamp_ns: int
    data: bytes


class _Place(NamedTuple):
    """A chunk and the file that has it; times are monotonic."""

    begin_ns: int
    end_ns: int
    path: Path
    chunk: ChunkIndex
    topics: dict[int, str]


class SeekableRecording:
    """``files`` are those of one run, or one stop file."""

    def __init__(self, files: list[Path]) -> None:
        """Read the index.

        Raises:
            CommandFailed: a file is not an MCAP file, or is still being written.
        """
        self.manifest = manifest_of(files)
        self.buses = self.manifest.buses
        self._lock = threading.Lock()
        self._chunks: OrderedDict[tuple[Path, int], bytes] = OrderedDict()
        chunk_locations = [chunk_location for path in files for chunk_location in self._places_of(path)]
        self._places = sorted(chunk_locations, key=lambda place: place.begin_ns)
        topics = {
            topic
            for chunk_location in self._places
            for i, topic in chunk_location.topics.items()
            if _has(chunk_location, i)
        }
        self._ticks_only = REPORT not in topics
        timed = {TICK} if self._ticks_only else {REPORT}
        within = [p for p in self._places if any(t in timed and _has(p, i) for i, t in p.topics.items())]
        if not within:
            raise CommandFailed(
                "replay.no-reports",
                f"{files[0]} has no report of the controller, so there is nothing to show; give another recording",
                ExitCode.CONFIGURATION,
            )
        first_message = next(self.messages(timed, within[0].begin_ns, within[0].end_ns + 1))
        self.begin_ns, self.end_ns = first_message.stamp_ns, max(p.end_ns for p in within)

    def messages(self, topics: Collection[str], begin_ns: int, end_ns: int) -> Iterator[Message]:
        """Yield the messages with a time from ``begin_ns`` until before ``end_ns``, in their order within 200 ms."""
        for chunk_location in self._places:
            if chunk_location.end_ns < begin_ns or chunk_location.begin_ns >= end_ns:
                continue
            channels = [i for i, topic in chunk_location.topics.items() if topic in topics and _has(chunk_location, i)]
            if channels:
                matching_messages = [
                    m for m in self._taken(chunk_location, channels) if begin_ns <= m.stamp_ns < end_ns
                ]
                yield from sorted(matching_messages, key=lambda message: message.stamp_ns)

    def reports(self, begin_ns: int, end_ns: int) -> Iterator[StateReport | VehicleReport]:
        """Yield the controller's reports of a time."""
        if self._ticks_only:
            for message in self.messages({TICK}, begin_ns, end_ns):
                tick = tick_record.decode(message.data)
                for data in filter(None, (tick.report, tick.vehicle_report)):
                    try:
                        report = datagrams.decode(data)
                    except DatagramRefused:
                        continue
                    if isinstance(report, StateReport | VehicleReport):
                        yield report
            return
        for message in self.messages({REPORT, VEHICLE}, begin_ns, end_ns):
            fields = _VEHICLE_FIELDS if message.topic == VEHICLE else _STATE_FIELDS
            values = _values(message.data, fields)
            yield VehicleReport(**values) if message.topic == VEHICLE else StateReport(**values)

    def frames(self, bus: str, begin_ns: int, end_ns: int) -> list[Frame]:
        """Return the frames of a bus; of a stop file those that the controller received and sent."""
        if not self._ticks_only:
            bus_frames = []
            for message in self.messages({f"/{bus}/raw"}, begin_ns, end_ns):
                key, length, data = _CAN_FRAME.unpack_from(message.data)
                bus_frames.append(Frame(message.stamp_ns, key, data[:length]))
            return bus_frames
        frames: list[Frame] = []
        for message in self.messages({TICK}, begin_ns, end_ns):
            tick = tick_record.decode(message.data)
            is_first_bus = bus == self.buses[0]
            sent = tick.frames_out if is_first_bus else tick.machine_frames_out
            frames += tick.frames_in if is_first_bus else tick.machine_frames_in
            frames += [Frame(tick.now_ns, key, data) for key, data in sent]
        return sorted(frames)

    def timing(self, at_ns: int) -> dict[str, Any] | None:
        """Return the newest state of the timing page before a time, as the recorder stored it."""
        timing_messages = list(self.messages({TIMING}, at_ns - 3_000_000_000, at_ns))
        return msgspec.json.decode(timing_messages[-1].data) if timing_messages else None

    def _places_of(self, path: Path) -> Iterator[_Place]:
        try:
            if not is_complete(path):
                raise CommandFailed(
                    "replay.unfinished",
                    f"{path} is still being written, or was cut off; give the directory of its run once it has ended",
                    ExitCode.CONFIGURATION,
                )
            with path.open("rb") as file:
                summary = SeekingReader(file).get_summary()
        except (OSError, McapError) as error:
            raise CommandFailed(
                "replay.unreadable", f"{path} cannot be read: {error}; give another recording", ExitCode.CONFIGURATION
            ) from error
        if summary is None:
            return
        topics = {channel.id: channel.topic for channel in summary.channels.values()}
        shift_ns = self.manifest.utc_offset_ns
        for index in summary.chunk_indexes:
            yield _Place(index.message_start_time - shift_ns, index.message_end_time - shift_ns, path, index, topics)

    def _taken(self, place: _Place, channels: list[int]) -> list[Message]:
        """Read the messages of the channels in a chunk."""
        chunk_messages = []
        with self._lock, place.path.open("rb") as file:
            data = self._chunk(place, file)
            for channel in channels:
                file.seek(place.chunk.message_index_offsets[channel] + _RECORD_HEAD)
                for _, at in MessageIndex.read(ReadDataStream(file)).records:
                    _, length, _, _, _, stamp_ns = _MESSAGE.unpack_from(data, at)
                    body = data[at + _MESSAGE.size : at + _RECORD_HEAD + length]
                    chunk_messages.append(Message(place.topics[channel], stamp_ns, body))
        return chunk_messages

    def _chunk(self, place: _Place, file: Any) -> bytes:
        name = (place.path, place.chunk.chunk_start_offset)
        if name in self._chunks:
            self._chunks.move_to_end(name)
            return self._chunks[name]
        file.seek(place.chunk.chunk_start_offset + _RECORD_HEAD)
        stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(file)), validate_crc=True)
        data = self._chunks[name] = stream.read(size)
        if len(self._chunks) > CACHED_CHUNKS:
            self._chunks.popitem(last=False)
        return data


def _has(place: _Place, channel: int) -> bool:
    return channel in place.chunk.message_index_offsets


def _values(data: bytes, fields: Collection[str]) -> dict[str, Any]:
    """Read a report's fields from its JSON, in which an unknown number is null; an absent one keeps its default."""
    decoded_report, values = msgspec.json.decode(data), {}
    for name in fields:
        if name in decoded_report:
            value = decoded_report[name]
            if isinstance(value, list):
                value = tuple(math.nan if v is None else v for v in value)
            values[name] = math.nan if value is None else value
    return values
