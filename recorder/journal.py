"""Entries for systemd's journal with fields of their own, in its native protocol and without a library.

One datagram to a Unix socket: ``NAME=value`` lines; a value with a line feed is written as its name, a line feed, its
length as u64 little-endian, and the bytes (systemd, "Native Journal Protocol").  The bindings python-systemd and
cysystemd need libsystemd and a compiler to be installed, for the twenty lines below.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from machine.status.explanation import ERROR, message_id, priority
from machine.status.reasons import known
from recorder.stop import Stop

SOCKET: Final = Path("/run/systemd/journal/socket")
_LENGTH: Final = struct.Struct("<Q")


def encode(fields: Mapping[str, str]) -> bytes:
    """The datagram of an entry."""
    data = bytearray()
    for name, value in fields.items():
        text = value.encode()
        if b"\n" in text:
            data += name.encode() + b"\n" + _LENGTH.pack(len(text)) + text + b"\n"
        else:
            data += name.encode() + b"=" + text + b"\n"
    return bytes(data)


def send(fields: Mapping[str, str], path: Path = SOCKET) -> bool:
    """Writes an entry without waiting; False where no journal takes it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        try:
            sender.sendto(encode(fields), str(path))
        except OSError:
            return False
    return True


def stop_fields(stop: Stop, file: Path) -> dict[str, str]:
    """The fields of a stop's entry; ``MESSAGE_ID`` finds the text of `journalctl -x` in timberhand.catalog."""
    fields = {
        "MESSAGE": f"{stop.mode}: {stop.text}",
        "PRIORITY": str(ERROR),
        "SYSLOG_IDENTIFIER": "timberhand",
        "TIMBERHAND_CODE": stop.code,
        "TIMBERHAND_MODE": stop.mode,
        "TIMBERHAND_MODE_BEFORE": stop.mode_before,
        "TIMBERHAND_FILE": str(file),
    }
    reason = known(stop.reason)
    if reason is None:
        return fields
    return fields | {
        "MESSAGE_ID": message_id(reason),
        "PRIORITY": str(priority(reason)),
        "TIMBERHAND_PART": stop.explanation.part or "the machine",
        "TIMBERHAND_MEASURED": stop.explanation.measured or "nothing",
    }
