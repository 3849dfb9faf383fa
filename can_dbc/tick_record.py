"""One controller tick as bytes: everything that went in and came out, so that a record can be replayed.

Little-endian::

    magic u32 | version u16 | frames in u16 | datagrams u16 | frames out u16 | report bytes u16 | bus state
    u16 now u64 ns | late i64 ns | tick u64 ns | missed u64 | dropped u64 | refused u64 | bus errors u64
    frames in: (stamp u64, key u32, length u8, data 8) | datagrams: (length u16, bytes) | frames out | report
    | CRC-32

The controller sends it as one UDP datagram per tick; ``decode`` refuses a damaged one whole.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from .frame import Frame

MAGIC: Final = 0x52544854  # "THTR"
VERSION: Final = 1
MAX_BYTES: Final = 65_000
"""Most bytes of a record: what one UDP datagram carries."""

_HEAD: Final = struct.Struct("<I6HQqQQQQQ")
_IN: Final = struct.Struct("<QIB8s")
_OUT: Final = struct.Struct("<IB8s")
_LENGTH: Final = struct.Struct("<H")
_CRC: Final = struct.Struct("<I")


class RecordRefused(ValueError):
    """A tick record that is damaged or of another version; the text says which."""


@dataclass(frozen=True, slots=True)
class TickRecord:
    """Inputs and outputs of one tick; ``report`` is empty when none was due.  Counters are totals."""

    now_ns: int
    late_ns: int
    tick_ns: int
    missed_ticks: int
    bus_state: int
    bus_dropped: int
    bus_refused: int
    bus_errors: int
    frames_in: tuple[Frame, ...]
    datagrams: tuple[bytes, ...]
    frames_out: tuple[tuple[int, bytes], ...]
    report: bytes


def encode(
    now_ns: int,
    late_ns: int,
    tick_ns: int,
    missed_ticks: int,
    bus: tuple[int, int, int, int],
    frames_in: Sequence[Frame],
    datagrams: Sequence[bytes],
    frames_out: Sequence[tuple[int, bytes]],
    report: bytes | None,
) -> bytes:
    """The bytes of a tick; ``bus`` is (state, dropped, refused, errors)."""
    report = report or b""
    state, dropped, refused, errors = bus
    parts = [
        _HEAD.pack(
            MAGIC, VERSION, len(frames_in), len(datagrams), len(frames_out), len(report), state,
            now_ns, late_ns, tick_ns, missed_ticks, dropped, refused, errors,
        )
    ]  # fmt: skip
    parts += [_IN.pack(stamp, key, len(data), data) for stamp, key, data in frames_in]
    for datagram in datagrams:
        parts.append(_LENGTH.pack(len(datagram)))
        parts.append(datagram)
    parts += [_OUT.pack(key, len(data), data) for key, data in frames_out]
    parts.append(report)
    body = b"".join(parts)
    return body + _CRC.pack(zlib.crc32(body))


def decode(data: bytes) -> TickRecord:
    """The tick in a record; raises RecordRefused."""
    if len(data) < _HEAD.size + _CRC.size:
        raise RecordRefused(f"a tick record of {len(data)} bytes is too short")
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, len(data) - _CRC.size)[0]:
        raise RecordRefused("a tick record with a wrong checksum")
    magic, version, n_in, n_datagrams, n_out, n_report, state, *times = _HEAD.unpack_from(data)
    if magic != MAGIC or version != VERSION:
        raise RecordRefused(f"not a tick record of version {VERSION}")
    now_ns, late_ns, tick_ns, missed, dropped, refused, errors = times
    at, end = _HEAD.size, len(data) - _CRC.size
    frames_in, datagrams, frames_out = [], [], []
    try:
        for _ in range(n_in):
            stamp, key, length, payload = _IN.unpack_from(data, at)
            frames_in.append(Frame(stamp, key, payload[:length]))
            at += _IN.size
        for _ in range(n_datagrams):
            (length,) = _LENGTH.unpack_from(data, at)
            at += _LENGTH.size + length
            datagrams.append(data[at - length : at])
        for _ in range(n_out):
            key, length, payload = _OUT.unpack_from(data, at)
            frames_out.append((key, payload[:length]))
            at += _OUT.size
    except struct.error:
        raise RecordRefused("a tick record whose counts do not fit its length") from None
    if at + n_report != end:
        raise RecordRefused("a tick record whose counts do not fit its length")
    return TickRecord(
        now_ns, late_ns, tick_ns, missed, state, dropped, refused, errors,
        tuple(frames_in), tuple(datagrams), tuple(frames_out), data[at:end],
    )  # fmt: skip
