"""Frames into and out of the packets of the wire; part of the compiled tick.  Standard library only."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from can_dbc.bus.base import BusStats
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


def unpack(
    batch: Batch, packets: int, frames: list[Frame], first: int, stats: BusStats, error_frames: bool
) -> tuple[int, int] | None:
    """Append the frames of the packets in ``batch``; returns the counters done and dropped of the last record.

    Error frames change ``stats`` and are appended only if ``error_frames``; otherwise a recovery removes all frames
    from ``first`` on.  None: the daemon has ended.
    """
    data, done, dropped = batch.data, 0, 0
    for i in range(packets):
        at, size = i * batch.size, batch.length(i)
        if not size:
            return None
        for key, length, payload, stamp_ns, flags in _RECEIVED.iter_unpack(data[at : at + size]):
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
        done, dropped = _COUNTERS.unpack_from(data, at + size - RECORD_BYTES)
    return done, dropped


def pack(frames: Sequence[tuple[int, bytes]], first: int, most: int) -> bytes:
    """A packet of at most ``most`` frames from ``first`` on; it ends before a frame of more than 8 bytes."""
    records: list[bytes] = []
    for key, data in frames[first : first + most]:
        if len(data) > 8:
            break
        records.append(RECORD.pack(key, len(data), data, 0, 0, 0, 0))
    return b"".join(records)
