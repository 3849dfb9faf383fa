"""The envelope of every UDP datagram between planner, operator and controller (docs/architecture.md, "Setpoints").

All kinds share one header and one trailer, little-endian::

    magic u32 | version u16 | kind u16 | sequence u32 | profile hash u32 | stamp u64 ns
    | body | [HMAC 16] | CRC-32

The CRC-32 (``zlib``) covers everything before it; the optional HMAC-SHA-256, cut to 16 bytes, covers header
and body and is present exactly when both sides are configured with a key.  `signed` adds it to a datagram, `opened`
checks it and takes it away: so a process checks what it receives before anything else sees it.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import secrets
import struct
import zlib
from enum import IntEnum
from pathlib import Path
from typing import Final

from runtime.errors import ConfigError

MAGIC: Final = 0x44524854  # "THRD"
VERSION: Final = 1
MAC_BYTES: Final = 16

_HEADER: Final = struct.Struct("<IHHIIQ")
_CRC: Final = struct.Struct("<I")

Common = tuple[int, int, int]
"""Sequence, profile hash, stamp [ns]."""


class Kind(IntEnum):
    """The kind of a datagram."""

    CRANE = 1
    DRIVE = 2
    OPERATOR = 3
    REPORT = 4
    SPOOL = 5
    VEHICLE = 6
    ORDER = 7
    MISSION = 8
    UPLOAD = 9
    GRASP = 10


class DatagramFault(IntEnum):
    """Why a datagram is refused before its contents are used."""

    LENGTH = 1
    MAGIC = 2
    VERSION = 3
    KIND = 4
    CRC = 5
    AUTHENTICATION = 6
    NOT_FINITE = 7
    VALUE = 8


class DatagramRefused(ValueError):
    """A datagram is refused as a whole; ``fault`` says why."""

    def __init__(self, fault: DatagramFault) -> None:
        super().__init__(f"datagram refused: {fault.name.lower().replace('_', ' ')}")
        self.fault = fault


def sealed(kind: Kind, common: Common, body: bytes, key: bytes | None) -> bytes:
    """Make the datagram with a body."""
    data = _HEADER.pack(MAGIC, VERSION, kind, *common) + body
    if key is not None:
        data += _mac(data, key)
    return data + _CRC.pack(zlib.crc32(data))


def unsealed(data: bytes, key: bytes | None) -> tuple[int, Common, bytes]:
    """Read kind, common fields and body of a datagram; raises DatagramRefused."""
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


def signed(data: bytes, key: bytes) -> bytes:
    """Add an authenticator to a datagram without one."""
    covered = data[: -_CRC.size]
    covered += _mac(covered, key)
    return covered + _CRC.pack(zlib.crc32(covered))


def opened(data: bytes, key: bytes | None) -> bytes:
    """Remove the authenticator, if it is right, from a datagram; with no ``key`` return it as it is, unchecked.

    Raises:
        DatagramRefused: it is not whole, or was not made with this key.
    """
    if key is None:
        return data
    unsealed(data, key)
    return _without_mac(data)


def without_mac(data: bytes) -> bytes:
    """Remove its authenticator, unchecked, from a datagram that is whole by its checksum; or DatagramRefused."""
    unsealed(data, None)
    if len(data) < _HEADER.size + MAC_BYTES + _CRC.size:
        raise DatagramRefused(DatagramFault.LENGTH)
    return _without_mac(data)


def _without_mac(data: bytes) -> bytes:
    covered = data[: -MAC_BYTES - _CRC.size]
    return covered + _CRC.pack(zlib.crc32(covered))


def kind_of(data: bytes) -> int:
    """Read the kind that a datagram says it is, 0 if it is too short; nothing of it is checked."""
    return int(_HEADER.unpack_from(data)[2]) if len(data) >= _HEADER.size else 0


def is_operator_command(data: bytes) -> bool:
    """Tell whether a datagram says that it is an operator's command; nothing of it is checked."""
    return kind_of(data) == Kind.OPERATOR


def _mac(data: bytes, key: bytes) -> bytes:
    return hmac.digest(key, data, hashlib.sha256)[:MAC_BYTES]


def finite(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return `values` when all of them are finite, else DatagramRefused."""
    if not all(map(math.isfinite, values)):
        raise DatagramRefused(DatagramFault.NOT_FINITE)
    return values


# -- The file with the key that authenticates datagrams.

MIN_KEY_BYTES: Final = 16
SERVICE_KEY: Final = Path("/etc/timberhand/key")
"""The key of the installed services; root and the group timberhand-operator may read it."""


def read_key(path: Path) -> bytes:
    """Read the key in a file, without white space around it; raises ConfigError."""
    try:
        key = path.read_bytes().strip()
    except OSError as error:
        raise ConfigError("key.unreadable", f"{path}: the key cannot be read: {error.strerror}.") from error
    if len(key) < MIN_KEY_BYTES:
        raise ConfigError("key.short", f"{path}: a key of {len(key)} bytes is too short; use at least {MIN_KEY_BYTES}.")
    return key


def write_key(path: Path) -> Path:
    """Draw a key for one run and write it to a new file that only this user reads; its path.  Raises OSError."""
    path.unlink(missing_ok=True)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "w") as out:
        out.write(secrets.token_hex(MIN_KEY_BYTES))
    return path


def service_key() -> bytes | None:
    """Read the key of the services that are installed here; None if there is none, or this user may not read it."""
    try:
        return read_key(SERVICE_KEY)
    except ConfigError:
        return None
