"""One controller tick as bytes: all its inputs and outputs, for replay.

Little-endian; bus 0 is crane0, bus 1 is mach0::

    magic u32 | version u16 | frames in u16 | datagrams u16 | frames out u16 | report bytes u16
    now u64 ns | late i64 ns | tick u64 ns | missed u64
    two readings: (state u16, dropped u64, refused u64, errors u64, recoveries u64)
    frames in: (stamp u64, key u32, bus u8, length u8, data 8) | datagrams: (length u16, bytes)
    frames out: (key u32, bus u8, length u8, data 8) | report | vehicle report, all that is left | CRC-32

The controller sends one UDP datagram per tick; ``decode`` refuses a damaged one as a whole.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from can_dbc.bus.base import BusStats
from can_dbc.frame import Frame
from runtime.errors import CodedError

MAGIC: Final = 0x52544854  # "THTR"
VERSION: Final = 2
MAX_BYTES: Final = 65_000
"""Most bytes of a record: the capacity of one UDP datagram."""

_VERSION: Final = struct.Struct("<IH")
_HEAD: Final = struct.Struct("<I5HQqQQ" + "HQQQQ" * 2)
_IN: Final = struct.Struct("<QIBB8s")
_OUT: Final = struct.Struct("<IBB8s")
_LENGTH: Final = struct.Struct("<H")
_CRC: Final = struct.Struct("<I")


class RecordRefused(CodedError, ValueError):
    """A tick record is damaged or of another version."""


@dataclass(slots=True)
class BusReading:
    """One bus as a tick reads it: state of the own node (`can_dbc.bus.base.BusState`) and counters since start."""

    state: int = 0
    dropped: int = 0
    """Received frames that were lost."""
    refused: int = 0
    """Frames that the bus did not accept."""
    errors: int = 0
    """Error frames."""
    recoveries: int = 0
    """Number of recoveries from OFF or DOWN."""

    def copy_from(self, stats: BusStats) -> None:
        """Copies state and counters of a bus."""
        self.state, self.dropped, self.refused = stats.state, stats.dropped, stats.refused
        self.errors, self.recoveries = stats.error_frames, stats.recoveries


@dataclass(frozen=True, slots=True)
class TickRecord:
    """Inputs and outputs of one tick; a report is empty if none was due.  Counters are totals.

    ``frames_in`` and ``frames_out`` are those of crane0, in send order and with SYNC last.
    """

    now_ns: int
    late_ns: int
    tick_ns: int
    missed_ticks: int
    bus: BusReading
    machine_bus: BusReading
    frames_in: Sequence[Frame]
    machine_frames_in: Sequence[Frame]
    datagrams: Sequence[bytes]
    frames_out: Sequence[tuple[int, bytes]]
    machine_frames_out: Sequence[tuple[int, bytes]]
    report: bytes
    vehicle_report: bytes = b""


def encode(tick: TickRecord) -> bytes:
    """The bytes of a tick."""
    a, b = tick.bus, tick.machine_bus
    pack_in, pack_out, pack_length = _IN.pack, _OUT.pack, _LENGTH.pack
    parts = [
        _HEAD.pack(
            MAGIC, VERSION, len(tick.frames_in) + len(tick.machine_frames_in), len(tick.datagrams),
            len(tick.frames_out) + len(tick.machine_frames_out), len(tick.report),
            tick.now_ns, tick.late_ns, tick.tick_ns, tick.missed_ticks,
            a.state, a.dropped, a.refused, a.errors, a.recoveries,
            b.state, b.dropped, b.refused, b.errors, b.recoveries,
        )
    ]  # fmt: skip
    parts += [pack_in(stamp, key, 0, len(data), data) for stamp, key, data in tick.frames_in]
    parts += [pack_in(stamp, key, 1, len(data), data) for stamp, key, data in tick.machine_frames_in]
    for datagram in tick.datagrams:
        parts.append(pack_length(len(datagram)))
        parts.append(datagram)
    parts += [pack_out(key, 0, len(data), data) for key, data in tick.frames_out]
    parts += [pack_out(key, 1, len(data), data) for key, data in tick.machine_frames_out]
    parts += [tick.report, tick.vehicle_report]
    body = b"".join(parts)
    return body + _CRC.pack(zlib.crc32(body))


def decode(data: bytes) -> TickRecord:
    """The tick in a record; raises RecordRefused."""
    if len(data) < _VERSION.size + _CRC.size:
        raise RecordRefused("tick-record.length", f"a tick record of {len(data)} bytes is too short")
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, len(data) - _CRC.size)[0]:
        raise RecordRefused("tick-record.checksum", "the tick record has a wrong checksum")
    magic, version = _VERSION.unpack_from(data)
    if magic != MAGIC:
        raise RecordRefused("tick-record.magic", "the bytes are not a tick record")
    if version != VERSION:
        raise RecordRefused(
            "tick-record.version", f"the tick record has version {version}, this release reads version {VERSION}"
        )
    end = len(data) - _CRC.size
    frames_in: tuple[list[Frame], list[Frame]] = ([], [])
    frames_out: tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]] = ([], [])
    datagrams = []
    try:
        _, _, n_in, n_datagrams, n_out, n_report, now_ns, late_ns, tick_ns, missed, *counters = _HEAD.unpack_from(data)
        at = _HEAD.size
        for _ in range(n_in):
            stamp, key, bus, length, payload = _IN.unpack_from(data, at)
            frames_in[bus].append(Frame(stamp, key, payload[:length]))
            at += _IN.size
        for _ in range(n_datagrams):
            (length,) = _LENGTH.unpack_from(data, at)
            at += _LENGTH.size + length
            datagrams.append(data[at - length : at])
        for _ in range(n_out):
            key, bus, length, payload = _OUT.unpack_from(data, at)
            frames_out[bus].append((key, payload[:length]))
            at += _OUT.size
    except (struct.error, IndexError):
        raise RecordRefused("tick-record.contents", "the contents of the tick record do not match its counts") from None
    if at + n_report > end:
        raise RecordRefused("tick-record.contents", "the contents of the tick record do not match its counts")
    return TickRecord(
        now_ns, late_ns, tick_ns, missed, BusReading(*counters[:5]), BusReading(*counters[5:]),
        tuple(frames_in[0]), tuple(frames_in[1]), tuple(datagrams), tuple(frames_out[0]), tuple(frames_out[1]),
        data[at : at + n_report], data[at + n_report : end],
    )  # fmt: skip
