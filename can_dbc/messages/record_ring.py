"""Tick records on their way out of the controller: a ring in shared memory that the readers poll.

A tick waits for nobody and wakes nobody: it copies its record and goes on, and a reader that is too slow loses the
oldest records and knows how many.  Little-endian, all positions multiples of 8, counted from the start of the ring and
never reset::

    magic u64 | capacity u64 | reserved u64: end of what may be overwritten | written u64: end of what is complete
    | unused, 64 bytes in all | capacity bytes of records

    a record: length u32 | number u32 | data; length `SKIP`: nothing follows up to the end of the capacity

``reserved`` grows before a record is written and ``written`` after it, so a reader knows what it copied in time.  A
record has its own checksum (`can_dbc.messages.tick_record`), which also finds what a processor reordered.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
from pathlib import Path
from typing import Final

from runtime.shared_file import SharedFile, shared_path

MAGIC: Final = 0x31474E5254484D54  # "TMHTRNG1"
HEAD_BYTES: Final = 64
CAPACITY_BYTES: Final = 1 << 21
"""About ten seconds of a forwarder at 200 Hz, two of a crane at 1 kHz."""
SKIP: Final = 0xFFFF_FFFF
_MAGIC, _CAPACITY, _RESERVED, _WRITTEN = range(4)
_RECORD: Final = struct.Struct("<II")


def default_path() -> Path:
    """Return the path of the controller's ring."""
    return shared_path("controller.ticks")


class RecordRing:
    """The writing side; raises OSError if the file cannot be created."""

    __slots__ = ("_data", "_file", "_number", "_words", "_written")

    def __init__(self, path: Path) -> None:
        self._file = SharedFile(path, HEAD_BYTES + CAPACITY_BYTES)
        whole = memoryview(self._file.map)
        self._words, self._data = whole[:HEAD_BYTES].cast("Q"), whole[HEAD_BYTES:]
        self._number = self._written = 0
        self._data[:] = bytes(CAPACITY_BYTES)  # no page fault at the first write
        self._words[_CAPACITY] = CAPACITY_BYTES
        self._words[_MAGIC] = MAGIC

    def append(self, record: bytes | memoryview) -> None:
        """Copy one record, of at most a quarter of the capacity, over the oldest ones."""
        size = len(record)
        room = _RECORD.size + (size + 7 & -8)
        begin = self._written
        at = begin % CAPACITY_BYTES
        if at + room > CAPACITY_BYTES:
            begin += CAPACITY_BYTES - at
        self._words[_RESERVED] = begin + room
        if begin != self._written:
            _RECORD.pack_into(self._data, at, SKIP, 0)
            at = 0
        _RECORD.pack_into(self._data, at, size, self._number & 0xFFFF_FFFF)
        at += _RECORD.size
        self._data[at : at + size] = record
        self._number += 1
        self._written = begin + room
        self._words[_WRITTEN] = self._written

    def close(self) -> None:
        """Remove the ring."""
        self._words.release()
        self._data.release()
        self._file.close()


class RingReader:
    """The reading side.  ``lost``: records that were overwritten before they were read.

    The ring may appear later, and a new one (a restarted controller) is read from its beginning; one that is there
    already is read from now on.
    """

    def __init__(self, path: Path) -> None:
        self.lost = 0
        self._path = path
        self._map: mmap.mmap | None = None
        self._inode = 0
        self._capacity = self._tail = 0
        self._next: int | None = None
        if self._open() and (written := self._word(_WRITTEN)):
            self._tail, self._next = written, None

    def read(self) -> list[bytes]:
        """Read the records since the last call, in order."""
        records: list[bytes] = []
        if self._map is None and not self._open():
            return records
        while self._tail != self._word(_WRITTEN):
            record = self._record()
            if record is not None:
                records.append(record)
        if not records and self._replaced():
            self._open()
        return records

    def close(self) -> None:
        """Unmap the ring; may be called twice."""
        if self._map is not None:
            self._map.close()
            self._map = None

    def _record(self) -> bytes | None:
        """Read the record at the tail; None if there is none, or it was overwritten meanwhile."""
        assert self._map is not None
        at = self._tail % self._capacity
        room = self._capacity - at
        size, number = _RECORD.unpack_from(self._map, HEAD_BYTES + at) if room >= _RECORD.size else (SKIP, 0)
        begin = HEAD_BYTES + at + _RECORD.size
        step = room if size == SKIP else _RECORD.size + (size + 7 & -8)
        written = self._word(_WRITTEN)
        if step > room or self._tail + step > written:  # a length that the writer cannot have written
            self._tail = written
            return None
        data = self._map[begin : begin + size] if size != SKIP else b""
        if max(self._word(_RESERVED), written) - self._tail > self._capacity:
            self._tail = self._word(_WRITTEN)  # the writer is ahead by a whole round: go on with what comes next
            return None
        self._tail += step
        if size == SKIP:
            return None
        self.lost += 0 if self._next is None else number - self._next & 0xFFFF_FFFF
        self._next = number + 1
        return data

    def _word(self, place: int) -> int:
        assert self._map is not None
        value: int = struct.unpack_from("<Q", self._map, 8 * place)[0]
        return value

    def _open(self) -> bool:
        """Map the ring from its beginning; False if it is not there, or not complete yet."""
        with contextlib.suppress(OSError, ValueError), self._path.open("rb", buffering=0) as file:
            made = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
            magic, capacity = struct.unpack_from("<QQ", made) if len(made) > HEAD_BYTES else (0, 0)
            if magic != MAGIC or capacity != len(made) - HEAD_BYTES:
                made.close()
                return False
            self.close()
            self._map, self._inode = made, os.fstat(file.fileno()).st_ino
            self._capacity, self._tail, self._next = capacity, 0, 0
            return True
        return False

    def _replaced(self) -> bool:
        try:
            return self._path.stat().st_ino != self._inode
        except OSError:
            return False
