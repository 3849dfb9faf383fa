"""The cyclic UDP datagrams between bridge and PLC, 100 Hz in each direction, packed little-endian.

Layout (docs/reference/can-bus.md section 10)::

    header 32: magic 'CRN1' u32 | version u16 | type u16 | session u32 | seq u32 | time u64 us | echo_seq u32
        | mode u16 | arm u16
    command, 100: header | 7 x (reference i32, rate i32; 1e-6) | grapple, grapple %, speed %, reset: 4 x u16
        | [HMAC 16] | CRC-32
    reply, 144: header (mode: state; arm: key when it moves) | 7 x (position i32, velocity i32; 1e-6)
        | 8 pressures i16 0.1 bar | E-stop bits, fault, axis, longest cycle us, opening 0.1 %, load kg: 6 x u16
        | EstopStat 8 bytes | time of the positions us u16 | 7 x output i16 1e-3 | [HMAC 16] | CRC-32

``session`` is drawn by the PLC and 0 in a request for one (hello).  ``seq`` only ever increases within a session.
``echo_seq`` is the sequence number of the newest valid datagram from the other side: it gives the round-trip time, and
a datagram that echoes an old one is itself old.  The HMAC-SHA-256, cut to 16 bytes, covers all before it and is present
exactly when both sides have a key.  Pure; decoding raises `InputRefused` and uses nothing, encoding raises
`MapError` for values that do not fit.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
import zlib
from dataclasses import dataclass
from typing import Any, Final

from can_dbc.plc import map as plc
from can_dbc.plc.map import (
    ARM_KEY,
    ESTOP_BYTES,
    N_AXES,
    N_PRESSURES,
    Command,
    Feedback,
    Grapple,
    MapError,
    Mode,
    State,
)
from runtime.errors import InputRefused

MAGIC: Final = 0x314E5243  # "CRN1"
VERSION: Final = 3
COMMAND_TYPE, REPLY_TYPE = 1, 2
COMMAND_BYTES, REPLY_BYTES = 100, 144
"""Without the HMAC."""
MAC_BYTES: Final = 16
_COMMAND: Final = struct.Struct(f"<IHHIIQIHH{2 * N_AXES}i4H")
_REPLY: Final = struct.Struct(f"<IHHIIQIHH{2 * N_AXES}i{N_PRESSURES}h6H{ESTOP_BYTES}sH{N_AXES}h")
_CRC: Final = struct.Struct("<I")
_MICRO: Final = 1e6
_U32: Final = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class Header:
    """Session, own sequence number, own clock [us], and the newest sequence number received from the other side."""

    session: int
    sequence: int
    time_us: int
    echo: int


def encode_command(header: Header, command: Command, key: bytes | None = None) -> bytes:
    """Encode the datagram of a command; raises MapError for a value that does not fit."""
    c = command
    body = [v for pair in zip(_micros(c.reference, "reference"), _micros(c.rate, "rate"), strict=True) for v in pair]
    grapple_pct = plc.whole(c.grapple_pct, 1, 0, 100, "the grapple percentage")
    speed_pct = plc.whole(c.max_speed_pct, 1, 0, 100, "the maximum speed")
    end = (c.grapple, grapple_pct, speed_pct, int(c.reset))
    return _closed(_COMMAND.pack(*_head(header, COMMAND_TYPE), c.mode, ARM_KEY if c.armed else 0, *body, *end), key)


def decode_command(data: bytes, key: bytes | None = None) -> tuple[Header, Command]:
    """Decode header and command of a datagram; MapError for an undefined value, so that the PLC can name the fault."""
    header, mode, arm, values = _opened(data, _COMMAND, COMMAND_TYPE, key)
    *body, grapple, grapple_pct, speed_pct, reset = values
    if mode not in set(Mode) or arm not in (0, ARM_KEY) or grapple not in set(Grapple):
        raise MapError("plc.illegal-value", "mode, arm key or grapple command is not defined")
    if grapple_pct > 100 or speed_pct > 100 or reset > 1:
        raise MapError("plc.illegal-value", "grapple share, speed or reset is out of range")
    reference, rate = _halves(body)
    return header, Command(
        Mode(mode), arm == ARM_KEY, reference, rate, Grapple(grapple), grapple_pct, speed_pct, bool(reset)
    )


def encode_reply(header: Header, feedback: Feedback, key: bytes | None = None) -> bytes:
    """Encode the datagram of a reply; ``feedback.heartbeat`` and ``accepted`` are sent as sequence and echo."""
    f = feedback
    body = [
        v for pair in zip(_micros(f.position, "position"), _micros(f.velocity, "velocity"), strict=True) for v in pair
    ]
    pressures = [plc.signed16(p, 10.0, f"pressure {i}") for i, p in enumerate(f.pressure_bar)]
    opening, load = plc.whole(f.opening, 1e3, 0, 1000, "the opening"), plc.whole(f.load_kg, 1, 0, 0xFFFF, "the load")
    plc.estop_words(f.estop_frame)  # checks its length
    end = (f.estop, f.fault, f.fault_axis, min(f.longest_cycle_us, 0xFFFF), opening, load, f.estop_frame)
    outputs = [plc.signed16(u, 1e3, f"output of axis {i}") for i, u in enumerate(f.output)]
    head = (*_head(header, REPLY_TYPE), f.state, ARM_KEY if f.state is State.EXECUTE else 0)
    return _closed(_REPLY.pack(*head, *body, *pressures, *end, f.sampled_us & 0xFFFF, *outputs), key)


def decode_reply(data: bytes, key: bytes | None = None) -> tuple[Header, Feedback]:
    """Decode the header and feedback of a datagram."""
    header, state, _, values = _opened(data, _REPLY, REPLY_TYPE, key)
    position, velocity = _halves(values[: 2 * N_AXES])
    pressures = values[2 * N_AXES : 2 * N_AXES + N_PRESSURES]
    estop, fault, axis, longest, opening, load, estop_frame, sampled_us, *outputs = values[2 * N_AXES + N_PRESSURES :]
    if state not in set(State):
        raise InputRefused("plc-datagram.state", f"the PLC's state is {state}, which is not defined")
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
        estop_frame=estop_frame,
        sampled_us=sampled_us,
        output=tuple(u / 1e3 for u in outputs),
    )


def _micros(values: tuple[float, ...], what: str) -> list[int]:
    if len(values) != N_AXES:
        raise MapError("plc.axis-count", f"{what} has {len(values)} axes, not {N_AXES}")
    return [plc.micro(value, f"{what} of axis {i}") for i, value in enumerate(values)]


def _halves(body: list[int] | tuple[int, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(v / _MICRO for v in body[::2]), tuple(v / _MICRO for v in body[1::2])


def _head(header: Header, kind: int) -> tuple[int, ...]:
    numbers = (header.session & _U32, header.sequence & _U32, header.time_us, header.echo & _U32)
    return MAGIC, VERSION, kind, *numbers


def _closed(data: bytes, key: bytes | None) -> bytes:
    if key is not None:
        data += _mac(data, key)
    return data + _CRC.pack(zlib.crc32(data))


def _mac(data: bytes, key: bytes) -> bytes:
    return hmac.digest(key, data, hashlib.sha256)[:MAC_BYTES]


def _opened(
    data: bytes, layout: struct.Struct, kind: int, key: bytes | None
) -> tuple[Header, int, int, tuple[Any, ...]]:
    expected = layout.size + _CRC.size + (0 if key is None else MAC_BYTES)
    if len(data) != expected:
        raise InputRefused("plc-datagram.length", f"the datagram has {len(data)} bytes, not {expected}")
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, expected - _CRC.size)[0]:
        raise InputRefused("plc-datagram.checksum", "the datagram has a wrong checksum")
    magic, version, got, session, sequence, time_us, echo, mode, arm, *values = layout.unpack_from(data)
    if (magic, version, got) != (MAGIC, VERSION, kind):
        raise InputRefused(
            "plc-datagram.header",
            f"magic 0x{magic:08X}, version {version}, type {got}: not a datagram of this protocol",
        )
    if key is not None and not hmac.compare_digest(_mac(data[: layout.size], key), data[layout.size : -_CRC.size]):
        raise InputRefused("plc-datagram.authentication", "the datagram was not made with our key")
    return Header(session, sequence, time_us, echo), mode, arm, tuple(values)
