"""The UDP datagrams between planner, operator and controller (design section 5).

Six kinds, and two of a mission (`can_dbc.mission_datagrams`), share one header and one trailer, little-endian::

    magic u32 | version u16 | kind u16 | sequence u32 | profile hash u32 | stamp u64 ns
    | body | [HMAC 16] | CRC-32

The CRC-32 (``zlib``) covers everything before it; the optional HMAC-SHA-256, cut to 16 bytes, covers header
and body and is present exactly when both sides are configured with a key.  ``decode`` refuses a datagram
whole, with a reason: length, magic, version, checksum, authentication or a value that is not finite.  What a
value may be on this machine (limits, age, order) is the supervisor's business, not the codec's.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import socket
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from can_dbc.vehicle_datagrams import (
    DriveSetpoint,
    Driving,  # noqa: F401  (for those who import it from here)
    Steering,  # noqa: F401
    VehicleReport,
    drive_body,
    drive_from,
    vehicle_body,
    vehicle_from,
)

MAGIC: Final = 0x44524854  # "THRD"
VERSION: Final = 1
N_AXES: Final = 5
MAX_KNOTS: Final = 16
MAC_BYTES: Final = 16
FULL_PCT: Final = 100.0

_HEADER: Final = struct.Struct("<IHHIIQ")
_CRC: Final = struct.Struct("<I")
_CRANE: Final = struct.Struct("<IBBBB")
_KNOT: Final = struct.Struct(f"<I{2 * N_AXES}d")
_OPERATOR: Final = struct.Struct("<I")
_SPOOL: Final = struct.Struct("<IBB")
_SPOOL_KNOT: Final = struct.Struct("<Id")
_REPORT: Final = struct.Struct(f"<BBHIHHH{3 * N_AXES + 3}d4I")


class Kind(IntEnum):
    """What a datagram says."""

    CRANE = 1
    DRIVE = 2
    OPERATOR = 3
    REPORT = 4
    SPOOL = 5
    VEHICLE = 6
    ORDER = 7
    MISSION = 8


class GrappleCommand(IntEnum):
    """Open-loop grapple command (paper A III-A); the numbers are ``ValveCmdB.GrappleMode``."""

    NEUTRAL = 0
    OPEN = 1
    CLOSE = 2
    HOLD = 3


class OperatorAction(IntEnum):
    """What a human may ask of the controller; every one is an edge, never a level."""

    ARM = 1
    DISARM = 2
    STOP = 3
    RESET = 4


class DatagramFault(IntEnum):
    """Why a datagram was refused before anyone looked at its meaning."""

    LENGTH = 1
    MAGIC = 2
    VERSION = 3
    KIND = 4
    CRC = 5
    AUTHENTICATION = 6
    NOT_FINITE = 7
    VALUE = 8


class DatagramRefused(ValueError):
    """A datagram that was refused whole; ``fault`` says why."""

    def __init__(self, fault: DatagramFault) -> None:
        super().__init__(f"datagram refused: {fault.name.lower().replace('_', ' ')}")
        self.fault = fault


@dataclass(frozen=True, slots=True)
class Knot:
    """Joint positions and velocities (rad, m; per second; ``Joint`` order) at ``after_ns`` past the stamp."""

    after_ns: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CraneSetpoint:
    """A short joint trajectory with a lease: obeyed until ``stamp_ns + lease_ns`` and not a moment longer.

    ``final`` says that the last knot is the end of the motion: once reached, the lease may run out in peace.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    lease_ns: int
    grapple: GrappleCommand
    final: bool
    knots: tuple[Knot, ...]


@dataclass(frozen=True, slots=True)
class SpoolKnot:
    """Command of one valve function [%, + moves the joint in its positive direction] at ``after_ns`` past the stamp."""

    after_ns: int
    percent: float


@dataclass(frozen=True, slots=True)
class SpoolTest:
    """A spool command for one function (a ``Joint`` number), to find out what its valve does; all others stay neutral.

    Straight lines between the knots, neutral past the last one.  Obeyed until ``stamp_ns + lease_ns``.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    lease_ns: int
    function: int
    knots: tuple[SpoolKnot, ...]


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """One action of a human operator."""

    sequence: int
    profile_hash: int
    stamp_ns: int
    action: OperatorAction


@dataclass(frozen=True, slots=True)
class StateReport:
    """What the controller says of itself, 50 times a second.

    ``position``, ``velocity`` and ``reference`` are in ``Joint`` order; an unknown value is NaN.  ``mode`` is
    a ``machine.modes.Mode``, ``reason`` the supervisor's number; ``refused`` counts setpoints refused since
    start, ``refusal`` is the last reason.  ``tick_ns`` is the longest tick, ``late_ns`` the worst lateness
    since the last report.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    mode: int
    grapple_state: int
    reason: int
    setpoint_sequence: int
    refusal: int
    refused: int
    stale_mask: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    reference: tuple[float, ...]
    opening_pct: float
    clamp_bar: float
    load_kg: float
    tick_ns: int
    late_ns: int
    missed_ticks: int
    frames_received: int


Common = tuple[int, int, int]
"""Sequence, profile hash, stamp [ns]."""
Datagram = CraneSetpoint | SpoolTest | DriveSetpoint | OperatorCommand | StateReport | VehicleReport


def udp_address(text: str) -> tuple[str, int]:
    """A command line's HOST:PORT as numbers, so that sending never waits for a name server.

    Raises:
        ValueError: one sentence that says what to write.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"{text}: write HOST:PORT, as in 127.0.0.1:5006")
    try:
        return socket.gethostbyname(host), int(port)
    except OSError:
        raise ValueError(f"{text}: there is no host {host}; write an address, as in 127.0.0.1:5006") from None


def _body(message: Datagram) -> tuple[Kind, bytes]:
    match message:
        case CraneSetpoint():
            head = _CRANE.pack(
                message.lease_ns // 1000, message.grapple, int(message.final), len(message.knots), N_AXES
            )
            knots = (_KNOT.pack(k.after_ns // 1000, *k.position, *k.velocity) for k in message.knots)
            return Kind.CRANE, head + b"".join(knots)
        case SpoolTest():
            head = _SPOOL.pack(message.lease_ns // 1000, message.function, len(message.knots))
            return Kind.SPOOL, head + b"".join(_SPOOL_KNOT.pack(k.after_ns // 1000, k.percent) for k in message.knots)
        case DriveSetpoint():
            return Kind.DRIVE, drive_body(message)
        case VehicleReport():
            return Kind.VEHICLE, vehicle_body(message)
        case OperatorCommand():
            return Kind.OPERATOR, _OPERATOR.pack(message.action)
        case StateReport():
            return Kind.REPORT, _REPORT.pack(
                message.mode,
                message.grapple_state,
                message.reason,
                message.setpoint_sequence,
                message.refusal,
                message.refused & 0xFFFF,
                message.stale_mask,
                *message.position,
                *message.velocity,
                *message.reference,
                message.opening_pct,
                message.clamp_bar,
                message.load_kg,
                message.tick_ns & 0xFFFFFFFF,
                message.late_ns & 0xFFFFFFFF,
                message.missed_ticks & 0xFFFFFFFF,
                message.frames_received & 0xFFFFFFFF,
            )


def encode(message: Datagram, key: bytes | None = None) -> bytes:
    """The bytes of a datagram; times finer than 1 us are cut.  With ``key`` it is authenticated."""
    kind, body = _body(message)
    return sealed(kind, (message.sequence, message.profile_hash, message.stamp_ns), body, key)


def sealed(kind: Kind, common: Common, body: bytes, key: bytes | None) -> bytes:
    """A body in its envelope."""
    data = _HEADER.pack(MAGIC, VERSION, kind, *common) + body
    if key is not None:
        data += _mac(data, key)
    return data + _CRC.pack(zlib.crc32(data))


def decode(data: bytes, key: bytes | None = None) -> Datagram:
    """The message in a datagram.

    Raises:
        DatagramRefused: with the reason; nothing of a refused datagram is used.
    """
    kind, common, body = unsealed(data, key)
    try:
        match kind:
            case Kind.CRANE:
                return _crane(common, body)
            case Kind.SPOOL:
                return _spool(common, body)
            case Kind.DRIVE:
                return _drive(common, body)
            case Kind.OPERATOR:
                return OperatorCommand(*common, OperatorAction(*_OPERATOR.unpack(body)))
            case Kind.REPORT:
                return _report(common, body)
            case Kind.VEHICLE:
                return vehicle_from(common, body)
    except struct.error:
        raise DatagramRefused(DatagramFault.LENGTH) from None
    except DatagramRefused:
        raise
    except ValueError:
        raise DatagramRefused(DatagramFault.VALUE) from None
    raise DatagramRefused(DatagramFault.KIND)


def unsealed(data: bytes, key: bytes | None) -> tuple[int, Common, bytes]:
    """Kind, common fields and body of a datagram; raises DatagramRefused."""
    trailer = _CRC.size + (MAC_BYTES if key is not None else 0)
    if len(data) < _HEADER.size + trailer:
        raise DatagramRefused(DatagramFault.LENGTH)
    magic, version, kind, sequence, profile_hash, stamp_ns = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise DatagramRefused(DatagramFault.MAGIC)
    if version != VERSION:
        raise DatagramRefused(DatagramFault.VERSION)
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, len(data) - _CRC.size)[0]:
        raise DatagramRefused(DatagramFault.CRC)
    signed = data[: len(data) - trailer]
    if key is not None and not hmac.compare_digest(_mac(signed, key), data[len(signed) : len(signed) + MAC_BYTES]):
        raise DatagramRefused(DatagramFault.AUTHENTICATION)
    return kind, (sequence, profile_hash, stamp_ns), signed[_HEADER.size :]


def _mac(data: bytes, key: bytes) -> bytes:
    return hmac.digest(key, data, hashlib.sha256)[:MAC_BYTES]


def _finite(values: tuple[float, ...]) -> tuple[float, ...]:
    if not all(map(math.isfinite, values)):
        raise DatagramRefused(DatagramFault.NOT_FINITE)
    return values


def _crane(common: Common, body: bytes) -> CraneSetpoint:
    lease_us, grapple, final, n_knots, axes = _CRANE.unpack_from(body)
    if len(body) != _CRANE.size + n_knots * _KNOT.size or axes != N_AXES:
        raise DatagramRefused(DatagramFault.LENGTH)
    if not 1 <= n_knots <= MAX_KNOTS or final > 1:
        raise DatagramRefused(DatagramFault.VALUE)
    knots = []
    for i in range(n_knots):
        after_us, *values = _KNOT.unpack_from(body, _CRANE.size + i * _KNOT.size)
        numbers = _finite(tuple(values))
        knots.append(Knot(after_us * 1000, numbers[:N_AXES], numbers[N_AXES:]))
        if i and knots[i].after_ns <= knots[i - 1].after_ns:
            raise DatagramRefused(DatagramFault.VALUE)
    return CraneSetpoint(*common, lease_us * 1000, GrappleCommand(grapple), bool(final), tuple(knots))


def _spool(common: Common, body: bytes) -> SpoolTest:
    lease_us, function, n_knots = _SPOOL.unpack_from(body)
    if len(body) != _SPOOL.size + n_knots * _SPOOL_KNOT.size:
        raise DatagramRefused(DatagramFault.LENGTH)
    if not 1 <= n_knots <= MAX_KNOTS or function >= N_AXES:
        raise DatagramRefused(DatagramFault.VALUE)
    knots: list[SpoolKnot] = []
    for i in range(n_knots):
        after_us, percent = _SPOOL_KNOT.unpack_from(body, _SPOOL.size + i * _SPOOL_KNOT.size)
        _finite((percent,))
        if abs(percent) > FULL_PCT or (knots and after_us * 1000 <= knots[-1].after_ns):
            raise DatagramRefused(DatagramFault.VALUE)
        knots.append(SpoolKnot(after_us * 1000, percent))
    return SpoolTest(*common, lease_us * 1000, function, tuple(knots))


def _drive(common: Common, body: bytes) -> DriveSetpoint:
    drive = drive_from(common, body)
    _finite((drive.latitude_deg, drive.longitude_deg, drive.articulation_rad, drive.articulation_rate_rad_s))
    _finite((drive.speed_m_s, *drive.heights_m))
    return drive


def _report(common: Common, body: bytes) -> StateReport:
    values = _REPORT.unpack(body)
    joints = values[7 : 7 + 3 * N_AXES]
    fields: list[Any] = [*common, *values[:7]]
    fields += [joints[:N_AXES], joints[N_AXES : 2 * N_AXES], joints[2 * N_AXES :]]
    return StateReport(*fields, *values[7 + 3 * N_AXES :])
