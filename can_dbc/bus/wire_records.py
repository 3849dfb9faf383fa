"""Frames into and out of the packets of the wire; part of the compiled tick.  Standard library only."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from can_dbc.bus.base import DRAIN_LIMIT, BusStats
from can_dbc.bus.batch import Batch
from can_dbc.frame import ERROR, Frame

RECORD: Final = struct.Struct("=IB3x8sQHHI")
"""key, length, data: struct can_frame; end-of-frame time [ns, CLOCK_MONOTONIC]; flags; done; dropped."""
RECORD_BYTES: Final = 32
STATUS: Final = 2
"""Flag of a record without a frame: counters only."""
_RECEIVED: Final = struct.Struct("=IB3x8sQH6x")
"""A record without the counters; those of the last record of a packet are enough."""
_COUNTERS: Final = struct.Struct("=26xHI")


def read(
    batch: Batch, descriptor: int, frames: list[Frame], first: int, stats: BusStats, error_frames: bool
) -> tuple[int, int] | None:
    """Append the frames that wait in a socket, at most about `DRAIN_LIMIT` behind ``first``.

    Returns the counters done and dropped of the last record, (-1, 0) if none waited, None if the daemon has ended.
    Error frames change ``stats`` and are appended only if ``error_frames``; otherwise a recovery removes all frames
    from ``first`` on.
    """
    counters = (-1, 0)
    for _ in range(DRAIN_LIMIT // batch.count):
        try:
            packets = batch.receive(descriptor)
        except OSError:
            return None
        end = 0
        for i in range(packets):
            size = batch.length(i)
            if not size:
                return None
            end = i * batch.size + size
            _unpack(batch.data, end - size, end, frames, first, stats, error_frames)
        if end:
            done, dropped = _COUNTERS.unpack_from(batch.data, end - RECORD_BYTES)
            counters = (done, dropped)
        if packets < batch.count or len(frames) - first >= DRAIN_LIMIT:
            break
    return counters


def _unpack(
    data: memoryview, at: int, end: int, frames: list[Frame], first: int, stats: BusStats, error_frames: bool
) -> None:
    """Append the frames of the records in ``data`` from ``at`` to ``end``."""
    while at < end:
        key, length, payload, stamp_ns, flags = _RECEIVED.unpack_from(data, at)
        at += RECORD_BYTES
        if flags & STATUS:
            continue
        if key & ERROR:
            recovered = stats.note_error(key, payload)
            if not error_frames:
                if recovered:
                    del frames[first:]
                continue
        # Frame(...) costs half as much again
        frames.append(tuple.__new__(Frame, (stamp_ns, key, payload if length == 8 else payload[:length])))


def pack(frames: Sequence[tuple[int, bytes]], first: int, most: int) -> bytes:
    """Pack at most ``most`` frames from ``first`` on; the packet ends before a frame of more than 8 bytes."""
    records: list[bytes] = []
    for key, data in frames[first : first + most]:
        if len(data) > 8:
            break
        records.append(RECORD.pack(key, len(data), data, 0, 0, 0, 0))
    return b"".join(records)
