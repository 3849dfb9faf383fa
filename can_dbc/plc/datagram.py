"""The cyclic UDP datagrams between bridge and PLC, 100 Hz in each direction, packed little-endian.

Layout (docs/reference/can-bus.md section 10)::

    header 28: magic 'CRN1' u32 | version u16 | type u16 | seq u32 | time u64 us | echo_seq u32 | mode u16 | arm u16
    command, 96: header | 7 x (reference i32, rate i32; 1e-6) | grapple, grapple %, speed %, reset: 4 x u16 | CRC-32
    reply, 128: header (mode: state; arm: key when it moves) | 7 x (position i32, velocity i32; 1e-6)
        | 8 pressures i16 0.1 bar | E-stop bits, fault, axis, longest cycle us, opening 0.1 %, load kg: 6 x u16
        | 12 reserved | CRC-32

``echo_seq`` is the sequence number of the newest valid datagram from the other side; it gives the round-trip time.
Pure; decoding raises `DatagramRefused` and uses nothing, encoding raises `MapError` for values that do not fit.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final

from can_dbc.plc import map as plc
from can_dbc.plc.map import ARM_KEY, N_AXES, N_PRESSURES, Command, Feedback, Grapple, MapError, Mode, State
from runtime.errors import CodedError

MAGIC: Final = 0x314E5243  # "CRN1"
VERSION: Final = 1
COMMAND_TYPE, REPLY_TYPE = 1, 2
COMMAND_BYTES, REPLY_BYTES = 96, 128
_COMMAND: Final = struct.Struct(f"<IHHIQIHH{2 * N_AXES}i4H")
_REPLY: Final = struct.Struct(f"<IHHIQIHH{2 * N_AXES}i{N_PRESSURES}h6H12x")
_CRC: Final = struct.Struct("<I")
_MICRO: Final = 1e6


class DatagramRefused(CodedError, ValueError):
    """A datagram is refused as a whole; the sentence says why."""


@dataclass(frozen=True, slots=True)
class Header:
    """Own sequence number, own clock [us], and the newest sequence number received from the other side."""

    sequence: int
    time_us: int
    echo: int


def encode_command(header: Header, command: Command) -> bytes:
    """The 96 bytes of a command; raises MapError for a value that does not fit."""
    c = command
    body = [v for pair in zip(_micros(c.reference, "reference"), _micros(c.rate, "rate"), strict=True) for v in pair]
    grapple_pct = plc.whole(c.grapple_pct, 1, 0, 100, "the grapple percentage")
    speed_pct = plc.whole(c.max_speed_pct, 1, 0, 100, "the maximum speed")
    end = (c.grapple, grapple_pct, speed_pct, int(c.reset))
    return _closed(_COMMAND.pack(*_head(header, COMMAND_TYPE), c.mode, ARM_KEY if c.armed else 0, *body, *end))


def decode_command(data: bytes) -> tuple[Header, Command]:
    """Header and command in 96 bytes; raises MapError for an undefined value, so that the PLC can name the fault."""
    header, mode, arm, values = _opened(data, _COMMAND, COMMAND_TYPE)
    *body, grapple, grapple_pct, speed_pct, reset = values
    if mode not in set(Mode) or arm not in (0, ARM_KEY) or grapple not in set(Grapple):
        raise MapError("plc.illegal-value", "mode, arm key or grapple command is not defined")
    if grapple_pct > 100 or speed_pct > 100 or reset > 1:
        raise MapError("plc.illegal-value", "grapple share, speed or reset is out of range")
    reference, rate = _halves(body)
    return header, Command(
        Mode(mode), arm == ARM_KEY, reference, rate, Grapple(grapple), grapple_pct, speed_pct, bool(reset)
    )


def encode_reply(header: Header, feedback: Feedback) -> bytes:
    """The 128 bytes of a reply; ``feedback.heartbeat`` and ``accepted`` are sent as sequence and echo."""
    f = feedback
    body = [
        v for pair in zip(_micros(f.position, "position"), _micros(f.velocity, "velocity"), strict=True) for v in pair
    ]
    pressures = [plc.signed16(p, 10.0, f"pressure {i}") for i, p in enumerate(f.pressure_bar)]
    opening, load = plc.whole(f.opening, 1e3, 0, 1000, "the opening"), plc.whole(f.load_kg, 1, 0, 0xFFFF, "the load")
    end = (f.estop, f.fault, f.fault_axis, min(f.longest_cycle_us, 0xFFFF), opening, load)
    arm = ARM_KEY if f.state is State.EXECUTE else 0
    return _closed(_REPLY.pack(*_head(header, REPLY_TYPE), f.state, arm, *body, *pressures, *end))


def decode_reply(data: bytes) -> tuple[Header, Feedback]:
    """Header and feedback in 128 bytes."""
    header, state, _, values = _opened(data, _REPLY, REPLY_TYPE)
    position, velocity = _halves(values[: 2 * N_AXES])
    pressures = values[2 * N_AXES : 2 * N_AXES + N_PRESSURES]
    estop, fault, axis, longest, opening, load = values[2 * N_AXES + N_PRESSURES :]
    if state not in set(State):
        raise DatagramRefused("plc-datagram.state", f"the PLC's state is {state}, which is not defined")
    return header, Feedback(
        heartbeat=header.sequence & 0xFFFF,
        state=State(state),
        fault=fault,
        fault_axis=axis,
        estop=estop,
        accepted=header.echo & 0xFFFF,
        longest_cycle_us=longest,
        position=position,
        velocity=velocity,
        pressure_bar=tuple(p / 10.0 for p in pressures),
        opening=opening / 1e3,
        load_kg=load,
    )


def _micros(values: tuple[float, ...], what: str) -> list[int]:
    if len(values) != N_AXES:
        raise MapError("plc.axis-count", f"{what} has {len(values)} axes, not {N_AXES}")
    return [plc.micro(value, f"{what} of axis {i}") for i, value in enumerate(values)]


def _halves(body: list[int] | tuple[int, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(v / _MICRO for v in body[::2]), tuple(v / _MICRO for v in body[1::2])


def _head(header: Header, kind: int) -> tuple[int, ...]:
    return MAGIC, VERSION, kind, header.sequence & 0xFFFF_FFFF, header.time_us, header.echo & 0xFFFF_FFFF


def _closed(data: bytes) -> bytes:
    return data + _CRC.pack(zlib.crc32(data))


def _opened(data: bytes, layout: struct.Struct, kind: int) -> tuple[Header, int, int, tuple[int, ...]]:
    if len(data) != layout.size + _CRC.size:
        raise DatagramRefused(
            "plc-datagram.length", f"the datagram has {len(data)} bytes, not {layout.size + _CRC.size}"
        )
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, layout.size)[0]:
        raise DatagramRefused("plc-datagram.checksum", "the datagram has a wrong checksum")
    magic, version, got, sequence, time_us, echo, mode, arm, *values = layout.unpack_from(data)
    if (magic, version, got) != (MAGIC, VERSION, kind):
        raise DatagramRefused(
            "plc-datagram.header",
            f"magic 0x{magic:08X}, version {version}, type {got}: not a datagram of this protocol",
        )
    return Header(sequence, time_us, echo), mode, arm, tuple(values)
