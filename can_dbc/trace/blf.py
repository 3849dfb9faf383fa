"""Reads BLF: walks containers and objects with bounds, and leaves the contents of whole CAN objects to python-can.

Time, memory and output are bounded by the size of the file: every step moves forward, at most `MAX_OBJECT_BYTES` wait
for the rest of an object, and what is unpacked is at most `MAX_EXPANSION` times the packed bytes read so far.  What was
written without containers is read too.  The file's header holds its size and the count of its objects, so a cut file is
told from a whole one.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final

from can.io import blf

from can_dbc.frame import ERROR, EXTENDED, REMOTE
from can_dbc.trace.records import MalformedRecord, TraceFrame

MAX_EXPANSION: Final = 64
"""Unpacked bytes per byte of the file; equal frames at equal steps, the most regular real traffic, reach 10."""
FREE_EXPANSION_BYTES: Final = 1 << 18
"""Two containers of the usual size."""
MAX_OBJECT_BYTES: Final = 16 << 20
STEP_BYTES: Final = 1 << 16
BATCH: Final = 500
MAX_DATA: Final = 64
CAN_ERROR: Final = 2
NEEDED: Final = {
    blf.CAN_MESSAGE: blf.CAN_MSG_STRUCT.size,
    blf.CAN_MESSAGE2: blf.CAN_MSG_STRUCT.size,
    blf.CAN_ERROR_EXT: blf.CAN_ERROR_EXT_STRUCT.size,
    blf.CAN_FD_MESSAGE: blf.CAN_FD_MSG_STRUCT.size,
    blf.CAN_FD_MESSAGE_64: blf.CAN_FD_MSG_64_STRUCT.size,
    CAN_ERROR: 0,
}
"""Bytes behind the object header, by object type."""
STAMPS: Final = {1: blf.OBJ_HEADER_V1_STRUCT, 2: blf.OBJ_HEADER_V2_STRUCT}
"""The second part of the object header, by header version."""


class _Damaged(Exception):
    """The objects cannot be followed any further."""


def read_blf(content: bytes, notes: list[str]) -> Iterator[TraceFrame | MalformedRecord]:
    """Read a file's frames up to the first damage; a record says where that is, ``notes`` what else is not read."""
    return _Reader(content, notes).records()


class _Reader:
    def __init__(self, content: bytes, notes: list[str]) -> None:
        self.content = content
        self.notes = notes
        self.start_ns = 0
        self.budget = FREE_EXPANSION_BYTES
        self.objects = 0
        self.containers = 0
        self.waiting = bytearray()
        self.place = ""
        self.other_types: Counter[int] = Counter()
        self.other_versions: Counter[int] = Counter()

    def records(self) -> Iterator[TraceFrame | MalformedRecord]:
        content = self.content
        if content[:4] != b"LOGG" or len(content) < blf.FILE_HEADER_STRUCT.size:
            yield MalformedRecord(0, "not a BLF file: it does not start with a whole header LOGG")
            return
        head = blf.FILE_HEADER_STRUCT.unpack_from(content)
        head_bytes, file_bytes, object_count = head[1], head[10], head[12]
        self.start_ns = round(blf.systemtime_to_timestamp(head[14:22]) * 1000) * 1_000_000
        damage = ""
        try:
            if head_bytes < blf.FILE_HEADER_STRUCT.size:
                raise _Damaged(f"damaged from byte 4 on: a file header of {head_bytes} bytes")
            yield from self._file(min(head_bytes, len(content)))
            if self.waiting.strip(b"\0"):
                damage = f"{self.place}: the last object is incomplete"
        except _Damaged as error:
            damage = str(error)
        if file_bytes > len(content):
            cut = f"cut off at byte {len(content)} of {file_bytes}"
            damage = f"{damage}; {cut}" if damage.startswith("damaged") else cut
        counted = f"{self.objects} of the {object_count} objects that the header counts are there"
        if damage:
            yield MalformedRecord(0, damage + (f": {counted}" if object_count > self.objects else ""))
        elif object_count > self.objects + self.containers:
            yield MalformedRecord(0, counted)
        for version, count in self.other_versions.most_common(8):
            self.notes.append(f"{count} objects have the unknown header version {version} and are not read")
        if self.other_types:
            types = ", ".join(str(t) for t in sorted(self.other_types)[:8])
            self.notes.append(f"{self.other_types.total()} objects are no CAN frames (object types {types})")

    def _file(self, at: int) -> Iterator[TraceFrame | MalformedRecord]:
        """Read containers, and objects beside them."""
        content = self.content
        while True:
            object_at = content.find(b"LOBJ", at, at + 8)
            if object_at < 0:
                if content[at:].strip(b"\0"):
                    raise _Damaged(f"damaged from byte {at} on: no object starts there")
                return
            at = object_at
            if at + blf.OBJ_HEADER_BASE_STRUCT.size > len(content):
                raise _Damaged(f"the file ends inside the object at byte {at}")
            _, _, _, size, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack_from(content, at)
            body = at + blf.OBJ_HEADER_BASE_STRUCT.size
            if size < blf.OBJ_HEADER_BASE_STRUCT.size:
                raise _Damaged(f"damaged from byte {at} on: an object of {size} bytes")
            end = at + size
            if kind != blf.LOG_CONTAINER:
                if end > len(content):
                    raise _Damaged(f"the file ends inside the object at byte {at}")
                yield from self._objects(content[at:end], f"damaged from byte {at} on", at)
            elif size < blf.OBJ_HEADER_BASE_STRUCT.size + blf.LOG_CONTAINER_STRUCT.size:
                raise _Damaged(f"damaged from byte {at} on: a container of {size} bytes")
            elif body + blf.LOG_CONTAINER_STRUCT.size <= len(content):
                self.containers += 1
                yield from self._container(at, body, min(end, len(content)))
            if end > len(content):
                raise _Damaged(f"the file ends inside the container at byte {at}")
            at = end

    def _container(self, at: int, body: int, end: int) -> Iterator[TraceFrame | MalformedRecord]:
        method, _ = blf.LOG_CONTAINER_STRUCT.unpack_from(self.content, body)
        data_at = body + blf.LOG_CONTAINER_STRUCT.size
        if method == blf.NO_COMPRESSION:
            yield from self._objects(self.content[data_at:end], "damaged", data_at)
        elif method == blf.ZLIB_DEFLATE:
            damage_text = f"damaged inside the container at byte {at}"
            try:
                for data in self._unpacked(data_at, end, at):
                    yield from self._objects(data, damage_text)
            except zlib.error as error:
                raise _Damaged(f"{damage_text}: it cannot be unpacked ({error})") from error
        else:
            yield MalformedRecord(0, f"the container at byte {at} has the unknown compression {method}")

    def _unpacked(self, first: int, end: int, at: int) -> Iterator[bytes]:
        unpacker = zlib.decompressobj()
        for start in range(first, end, STEP_BYTES):
            packed = self.content[start : min(end, start + STEP_BYTES)]
            while packed:
                data = unpacker.decompress(packed, STEP_BYTES)
                self.budget += MAX_EXPANSION * (len(packed) - len(unpacker.unconsumed_tail)) - len(data)
                if self.budget < 0:
                    raise _Damaged(
                        f"damaged inside the container at byte {at}: "
                        f"it unpacks to more than {MAX_EXPANSION} times its size"
                    )
                packed = unpacker.unconsumed_tail
                yield data

    def _objects(self, data: bytes, place: str, origin: int | None = None) -> Iterator[TraceFrame | MalformedRecord]:
        """Yield the frames of the whole objects; what is left waits for the next container."""
        waiting = self.waiting
        offset = None if origin is None else origin - len(waiting)
        waiting += data
        self.place = place if offset is None else f"damaged from byte {offset} on"
        at = 0
        batch: list[tuple[int, bytes]] = []
        damage: _Damaged | None = None
        try:
            while True:
                object_at = waiting.find(b"LOBJ", at, at + 8)
                if object_at < 0 and len(waiting) - at < 8:
                    break
                where = place if offset is None else f"damaged from byte {offset + at} on"
                if object_at < 0:
                    raise _Damaged(f"{where}: no object starts there")
                if object_at + blf.OBJ_HEADER_BASE_STRUCT.size > len(waiting):
                    break
                at = object_at
                size = self._size(at, where if offset is None else f"damaged from byte {offset + at} on")
                if at + size > len(waiting):
                    break
                if (stamp_ns := self._wanted(at, size, where)) is not None:
                    batch.append((stamp_ns, bytes(waiting[at : at + size])))
                at += size
                self.objects += 1
                if len(batch) >= BATCH:
                    yield from _frames(batch)
                    batch = []
        except _Damaged as error:
            damage = error
        del waiting[:at]
        yield from _frames(batch)
        if damage is not None:
            raise damage

    def _size(self, at: int, where: str) -> int:
        size: int = blf.OBJ_HEADER_BASE_STRUCT.unpack_from(self.waiting, at)[3]
        if not blf.OBJ_HEADER_BASE_STRUCT.size <= size <= MAX_OBJECT_BYTES:
            raise _Damaged(f"{where}: an object of {size} bytes")
        return size

    def _wanted(self, at: int, size: int, where: str) -> int | None:
        """Read the stamp of a CAN object; None for an object that is none or has an unknown header."""
        _, head_bytes, version, _, kind = blf.OBJ_HEADER_BASE_STRUCT.unpack_from(self.waiting, at)
        if kind not in NEEDED:
            self.other_types[kind] += 1
            return None
        if version not in STAMPS:
            self.other_versions[version] += 1
            return None
        body = blf.OBJ_HEADER_BASE_STRUCT.size + STAMPS[version].size
        if size < body + NEEDED[kind]:
            raise _Damaged(f"{where}: a CAN object of {size} bytes")
        if kind == blf.CAN_FD_MESSAGE_64:
            valid, outside = self.waiting[at + body + 2], self.waiting[at + body + 35]
            first = body + NEEDED[kind]
            beyond = outside > size and first + valid > size  # else only the offset is wrong
            if valid > MAX_DATA or beyond or 0 < outside < first or head_bytes > size:
                raise _Damaged(f"{where}: a CAN FD object of {valid} bytes")
        flags, _, _, stamp = STAMPS[version].unpack_from(self.waiting, at + blf.OBJ_HEADER_BASE_STRUCT.size)
        if stamp >= 1 << 63:  # before the start: Vector's loggers keep what came before the trigger
            stamp -= 1 << 64
        return self.start_ns + int(stamp) * (10_000 if flags == blf.TIME_TEN_MICS else 1)


def _frames(batch: list[tuple[int, bytes]]) -> Iterator[TraceFrame | MalformedRecord]:
    """Convert the frames of whole objects: all at once, one by one if an object among them is damaged."""
    can_objects = [data for _, data in batch if not _is_plain_error(data)]
    messages = _messages(can_objects) if can_objects else []
    if messages is None:
        messages = [parsed[0] if (parsed := _messages([data])) else None for data in can_objects]
    rest = iter(messages)
    for stamp_ns, data in batch:
        if _is_plain_error(data):
            yield _plain_error(stamp_ns, data)
        elif (message := next(rest)) is not None:
            yield converted(message, stamp_ns)
        else:
            yield MalformedRecord(0, "an object holds no CAN frame that can be read")


def _is_plain_error(data: bytes) -> bool:
    return bool(blf.OBJ_HEADER_BASE_STRUCT.unpack_from(data)[4] == CAN_ERROR)


def _plain_error(stamp_ns: int, data: bytes) -> TraceFrame:
    body = blf.OBJ_HEADER_BASE_STRUCT.size + STAMPS[blf.OBJ_HEADER_BASE_STRUCT.unpack_from(data)[2]].size
    channel = data[body : body + 2]
    return TraceFrame(stamp_ns, ERROR, b"", str(int.from_bytes(channel, "little")) if channel else "")


def _messages(objects: list[bytes]) -> list[Any] | None:
    """Read python-can's message of each object; None if there is not one of each."""
    data = b"".join(objects)
    size = blf.OBJ_HEADER_BASE_STRUCT.size + blf.LOG_CONTAINER_STRUCT.size + len(data)
    head = blf.FILE_HEADER_STRUCT.pack(b"LOGG", blf.FILE_HEADER_SIZE, *[0] * 28).ljust(blf.FILE_HEADER_SIZE, b"\0")
    container = blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", 16, 1, size, blf.LOG_CONTAINER)
    file = io.BytesIO(head + container + blf.LOG_CONTAINER_STRUCT.pack(blf.NO_COMPRESSION, len(data)) + data)
    try:
        with blf.BLFReader(file) as reader:
            messages = list(reader)
    except (blf.BLFParseError, struct.error, ValueError, IndexError, OverflowError):
        return None
    return messages if len(messages) == len(objects) else None


def converted(message: Any, stamp_ns: int) -> TraceFrame:
    """Convert a python-can message to a frame; its channel is that of the file less one."""
    key = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
    key |= (REMOTE if message.is_remote_frame else 0) | (ERROR if message.is_error_frame else 0)
    data = b"" if message.is_remote_frame else bytes(message.data)
    return TraceFrame(stamp_ns, key, data, "" if message.channel is None else str(message.channel + 1))
