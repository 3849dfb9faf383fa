"""AUTOSAR E2E Profile 2: a CRC, a counter and a Data ID protect every frame.

Byte 0 holds the CRC-8H2F (polynomial 0x2F, start and final exclusive-or 0xFF, no reflection) over bytes 1
to the end and then the Data ID ``data_ids[counter]``; the low nibble of byte 1 holds the counter, 0 to 15.
``Status`` distinguishes corruption, repetition, loss, wrong order and frames of another sender or message.  Sources:
AUTOSAR FO R22-11 PRS_E2EProtocol, 6.3; check value ``crc8(b"123456789") == 0xDF``.

Pure; the checking side allocates nothing but small integers.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

MAX_COUNTER_STEP: Final = 2
GOOD_TO_TRUST: Final = 2
BAD_IN_WINDOW: Final = 3
WINDOW_MASK: Final = (1 << 100) - 1


def _table() -> bytes:
    entries = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ 0x2F if value & 0x80 else value << 1
        entries.append(value & 0xFF)
    return bytes(entries)


TABLE: Final = _table()


def crc8(data: bytes, start: int = 0xFF) -> int:
    """Compute the CRC-8H2F of ``data``; ``start`` is the register before the first byte."""
    table, crc = TABLE, start
    for byte in data:
        crc = table[crc ^ byte]
    return crc ^ 0xFF


def frame_crc(data: bytes, data_ids: bytes) -> int:
    """Compute the CRC for byte 0 of a frame whose counter is set."""
    t, crc = TABLE, 0xFF
    if len(data) == 8:  # the usual length; unrolled, this takes three quarters of the loop's time
        _, a, b, c, d, e, f, g = data
        return t[t[t[t[t[t[t[t[crc ^ a] ^ b] ^ c] ^ d] ^ e] ^ f] ^ g] ^ data_ids[a & 0x0F]] ^ 0xFF
    for byte in data[1:]:
        crc = t[crc ^ byte]
    return t[crc ^ data_ids[data[1] & 0x0F]] ^ 0xFF


def protect(payload: bytes, counter: int, data_ids: bytes) -> bytes:
    """Fill counter and CRC into ``payload`` (a whole frame of at least 2 bytes).

    ``data_ids`` are the 16 Data IDs of the message; the high nibble of byte 1 is unchanged.
    """
    counter &= 0x0F
    table, crc = TABLE, TABLE[0xFF ^ (payload[1] & 0xF0 | counter)]
    for byte in payload[2:]:
        crc = table[crc ^ byte]
    crc = table[crc ^ data_ids[counter]] ^ 0xFF
    return bytes((crc, payload[1] & 0xF0 | counter)) + payload[2:]


class Sender:
    """The sending side of one message.  ``counter`` is that of the next frame."""

    __slots__ = ("counter", "data_ids")

    def __init__(self, data_ids: bytes, counter: int = 0) -> None:
        self.data_ids = data_ids
        self.counter = counter & 0x0F

    def protect(self, payload: bytes) -> bytes:
        """Build the frame to send for a payload; increments the counter."""
        counter = self.counter
        self.counter = (counter + 1) & 0x0F
        return protect(payload, counter, self.data_ids)


class Status(IntEnum):
    """Result of checking a received frame; only OK and OK_SOME_LOST are usable."""

    OK = 0
    OK_SOME_LOST = 1
    INITIAL = 2
    REPEATED = 3
    WRONG_SEQUENCE = 4
    ERROR = 5

    @property
    def usable(self) -> bool:
        """Whether the frame may be used."""
        return self <= Status.OK_SOME_LOST


# A module's constant is found faster than an enumeration's member, in every frame.
_OK: Final = Status.OK
_OK_SOME_LOST: Final = Status.OK_SOME_LOST
_INITIAL: Final = Status.INITIAL


class Checker:
    """The receiving side of one message.

    Counter steps of 1 and 2 are accepted, 0 is a repetition, more means lost frames and starts over.  Two good frames
    in a row are needed at first and after the stream has become invalid by a wrong sequence, two bad CRCs in a row, or
    3 among the last 100 frames.  A single bad CRC only drops its frame.  ``trusted`` is whether the stream is valid,
    ``counter`` that of the last frame with a good CRC.  Call ``reset`` after a timeout or when the sender restarts: the
    counter alone cannot show a gap of 16 frames.
    """

    __slots__ = ("_bad", "_good", "_last_bad", "counter", "data_ids", "trusted")

    def __init__(self, data_ids: bytes) -> None:
        self.data_ids = data_ids
        self.reset()

    def reset(self) -> None:
        """Reset the stream: the next two frames must qualify it again."""
        self.counter = -1
        self.trusted = False
        self._good = 0
        self._bad = 0
        self._last_bad = False

    def check(self, data: bytes) -> Status:
        """Check one received frame and update the stream's state."""
        if len(data) < 2 or frame_crc(data, self.data_ids) != data[0]:
            self._bad = (self._bad << 1 | 1) & WINDOW_MASK
            if self._last_bad or self._bad.bit_count() >= BAD_IN_WINDOW:
                self._distrust()
            self._last_bad = True
            self._good = 0
            return Status.ERROR
        if self._bad:
            self._bad = self._bad << 1 & WINDOW_MASK
        self._last_bad = False
        last, self.counter = self.counter, data[1] & 0x0F
        delta = (self.counter - last) & 0x0F
        if last < 0:
            self._good = 1
            return Status.INITIAL
        if delta == 0:
            return Status.REPEATED
        if delta > MAX_COUNTER_STEP:
            self._distrust()
            self._good = 1
            return Status.WRONG_SEQUENCE
        if not self.trusted:
            self._good += 1
            if self._good < GOOD_TO_TRUST:
                return Status.INITIAL
            self.trusted = True
        return _OK if delta == 1 else _OK_SOME_LOST

    def accepts(self, data: bytes) -> bool:
        """Check one received frame as `check` does, and tell whether it may be used."""
        status = self.check(data)
        return status is _OK or status is _OK_SOME_LOST

    def _distrust(self) -> None:
        self.trusted = False
        self._good = 0
        self._bad = 0
