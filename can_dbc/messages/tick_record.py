"""One controller tick as bytes: all its inputs and outputs, for replay.

Little-endian; bus 0 is crane0, bus 1 is mach0::

    magic u32 | version u16 | frames in u16 | datagrams u16 | frames out u16 | report bytes u16
    now u64 ns | late i64 ns | tick u64 ns | missed u64
    two readings: (state u16, dropped u64, refused u64, errors u64, recoveries u64)
    frames in: (stamp u64, key u32, bus u8, length u8, data 8)
    | datagrams: (length u16, and `OPERATOR` where an operator sent it, bytes), the operator's first
    frames out: (key u32, bus u8, length u8, data 8) | report | vehicle report, all that is left | CRC-32

The controller writes one per tick (`can_dbc.messages.record_ring`); ``decode`` refuses a damaged one as a whole.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from can_dbc.bus.base import BusStats
from can_dbc.frame import Frame
from can_dbc.messages.envelope import is_operator_command
from runtime.errors import InputRefused

MAGIC: Final = 0x52544854  # "THTR"
VERSION: Final = 3
_WITHOUT_OPERATOR: Final = 2
"""Version of the records in which operators and planners sent to one socket: the kind tells whose a datagram was."""
OPERATOR: Final = 0x8000
"""Bit of a datagram's length: an operator sent it."""
MAX_BYTES: Final = 100_000
"""Most bytes of a record: a tick that drains two full buses and 16 of the longest datagrams has less."""

_VERSION: Final = struct.Struct("<IH")
_HEAD: Final = struct.Struct("<I5HQqQQ" + "HQQQQ" * 2)
_IN: Final = struct.Struct("<QIBB8s")
_OUT: Final = struct.Struct("<IBB8s")
_LENGTH: Final = struct.Struct("<H")
_CRC: Final = struct.Struct("<I")


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
        """Copy state and counters of a bus."""
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
    operator: Sequence[bytes] = ()
    """Datagrams of operators; ``datagrams`` are the others."""


class RecordWriter:
    """Writes one record after the other into the same memory, so that a tick allocates next to nothing."""

    __slots__ = ("_buffer", "_view")

    def __init__(self) -> None:
        self._buffer = bytearray(MAX_BYTES)
        self._view = memoryview(self._buffer)

    def write(
        self,
        now_ns: int,
        late_ns: int,
        tick_ns: int,
        missed_ticks: int,
        bus: BusReading,
        machine_bus: BusReading,
        frames_in: Sequence[Frame],
        machine_frames_in: Sequence[Frame],
        datagrams: Sequence[bytes],
        frames_out: Sequence[tuple[int, bytes]],
        machine_frames_out: Sequence[tuple[int, bytes]],
        report: bytes,
        vehicle_report: bytes,
        operator: Sequence[bytes],
    ) -> memoryview:
        """Write the bytes of a tick (the fields of `TickRecord`), valid until the next call.

        Raises:
            InputRefused: it is longer than `MAX_BYTES`.
        """
        buffer, n_in, n_out = self._buffer, len(frames_in) + len(machine_frames_in), len(frames_out)
        n_out += len(machine_frames_out)
        size = _HEAD.size + n_in * _IN.size + n_out * _OUT.size + len(report) + len(vehicle_report) + _CRC.size
        n_datagrams = len(operator) + len(datagrams)
        for datagram in (*operator, *datagrams):
            size += _LENGTH.size + len(datagram)
        if size > MAX_BYTES:
            raise InputRefused("tick-record.too-long", f"the tick's record of {size} bytes is too long")
        _HEAD.pack_into(
            buffer,
            0,
            MAGIC,
            VERSION,
            n_in,
            n_datagrams,
            n_out,
            len(report),
            now_ns,
            late_ns,
            tick_ns,
            missed_ticks,
            bus.state,
            bus.dropped,
            bus.refused,
            bus.errors,
            bus.recoveries,
            machine_bus.state,
            machine_bus.dropped,
            machine_bus.refused,
            machine_bus.errors,
            machine_bus.recoveries,
        )
        at = _HEAD.size
        for stamp_ns, key, data in frames_in:
            _IN.pack_into(buffer, at, stamp_ns, key, 0, len(data), data)
            at += _IN.size
        for stamp_ns, key, data in machine_frames_in:
            _IN.pack_into(buffer, at, stamp_ns, key, 1, len(data), data)
            at += _IN.size
        for datagram in operator:
            _LENGTH.pack_into(buffer, at, len(datagram) | OPERATOR)
            at = self._append(datagram, at + _LENGTH.size)
        for datagram in datagrams:
            _LENGTH.pack_into(buffer, at, len(datagram))
            at = self._append(datagram, at + _LENGTH.size)
        for key, data in frames_out:
            _OUT.pack_into(buffer, at, key, 0, len(data), data)
            at += _OUT.size
        for key, data in machine_frames_out:
            _OUT.pack_into(buffer, at, key, 1, len(data), data)
            at += _OUT.size
        at = self._append(vehicle_report, self._append(report, at))
        _CRC.pack_into(buffer, at, zlib.crc32(self._view[:at]))
        return self._view[:size]

    def _append(self, data: bytes, at: int) -> int:
        end = at + len(data)
        self._view[at:end] = data
        return end


def encode(tick: TickRecord) -> bytes:
    """Encode the bytes of a tick; raises InputRefused when they are more than `MAX_BYTES`."""
    return bytes(
        RecordWriter().write(
            tick.now_ns,
            tick.late_ns,
            tick.tick_ns,
            tick.missed_ticks,
            tick.bus,
            tick.machine_bus,
            tick.frames_in,
            tick.machine_frames_in,
            tick.datagrams,
            tick.frames_out,
            tick.machine_frames_out,
            tick.report,
            tick.vehicle_report,
            tick.operator,
        )
    )


def decode(data: bytes) -> TickRecord:
    """Decode the tick in a record; raises InputRefused."""
    if len(data) < _VERSION.size + _CRC.size:
        raise InputRefused("tick-record.length", f"a tick record of {len(data)} bytes is too short")
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, len(data) - _CRC.size)[0]:
        raise InputRefused("tick-record.checksum", "the tick record has a wrong checksum")
    magic, version = _VERSION.unpack_from(data)
    if magic != MAGIC:
        raise InputRefused("tick-record.magic", "the bytes are not a tick record")
    if version not in (VERSION, _WITHOUT_OPERATOR):
        raise InputRefused(
            "tick-record.version", f"the tick record has version {version}, this release reads version {VERSION}"
        )
    end = len(data) - _CRC.size
    frames_in: tuple[list[Frame], list[Frame]] = ([], [])
    frames_out: tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]] = ([], [])
    operator: list[bytes] = []
    datagrams: list[bytes] = []
    try:
        _, _, n_in, n_datagrams, n_out, n_report, now_ns, late_ns, tick_ns, missed, *counters = _HEAD.unpack_from(data)
        at = _HEAD.size
        for _ in range(n_in):
            stamp, key, bus, length, payload = _IN.unpack_from(data, at)
            frames_in[bus].append(Frame(stamp, key, payload[:length]))
            at += _IN.size
        for _ in range(n_datagrams):
            (length,) = _LENGTH.unpack_from(data, at)
            pressed, length = length & OPERATOR, length & ~OPERATOR
            at += _LENGTH.size + length
            datagram = data[at - length : at]
            pressed = pressed or (version == _WITHOUT_OPERATOR and is_operator_command(datagram))
            (operator if pressed else datagrams).append(datagram)
        for _ in range(n_out):
            key, bus, length, payload = _OUT.unpack_from(data, at)
            frames_out[bus].append((key, payload[:length]))
            at += _OUT.size
    except (struct.error, IndexError):
        raise InputRefused("tick-record.contents", "the contents of the tick record do not match its counts") from None
    if at + n_report > end:
        raise InputRefused("tick-record.contents", "the contents of the tick record do not match its counts")
    return TickRecord(
        now_ns,
        late_ns,
        tick_ns,
        missed,
        BusReading(*counters[:5]),
        BusReading(*counters[5:]),
        tuple(frames_in[0]),
        tuple(frames_in[1]),
        tuple(datagrams),
        tuple(frames_out[0]),
        tuple(frames_out[1]),
        data[at : at + n_report],
        data[at + n_report : end],
        tuple(operator),
    )
