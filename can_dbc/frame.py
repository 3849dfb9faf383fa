"""The representation of a CAN frame that all of timberhand uses.

A key holds the identifier and the frame kind as in SocketCAN (``linux/can.h``): the low 29 bits are the
identifier, the top three bits mean extended, remote and error.  So ``0x210`` and ``0x210 | EXTENDED`` are two different
frames, and a table of codecs is a plain ``dict`` over keys.
"""

from __future__ import annotations

from typing import Final, NamedTuple

EXTENDED: Final = 0x8000_0000
REMOTE: Final = 0x4000_0000
ERROR: Final = 0x2000_0000
STANDARD_MASK: Final = 0x7FF
EXTENDED_MASK: Final = 0x1FFF_FFFF


class Frame(NamedTuple):
    """A received frame: monotonic receive time [ns], key (identifier and kind bits), 0 to 8 payload bytes."""

    stamp_ns: int
    key: int
    data: bytes


RawFrame = tuple[int, bytes]
"""A frame to send, without a time: key and 0 to 8 payload bytes."""


def identifier(key: int) -> int:
    """Return the identifier of a key without its kind bits."""
    return key & (EXTENDED_MASK if key & EXTENDED else STANDARD_MASK)


def describe(key: int) -> str:
    """Write a key as candump does: three hex digits for 11-bit ids, eight for 29-bit ids and error frames."""
    if key & (EXTENDED | ERROR):
        return f"{key & (EXTENDED_MASK | ERROR):08X}"
    return f"{key & STANDARD_MASK:03X}"
